"""Tests of the report of `quantize`: its integer layers, and where INT8 differs most."""

import base64
import json
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.raster.writer import write_tiff
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.gate import Spread
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_session
from beers_deploy.quantization import steps_of
from beers_deploy.report.plots import FONT_PX, MOST_BARS, bins, histogram_url
from beers_deploy.report.sensitivity_page import worst_picture
from tests.deploy.command_line import done
from tests.deploy.documents import valid
from tests.deploy.report.svg import style_of, text_width
from tests.model.networks import plain
from tests.quant.quick import uniform
from tests.quant.simplify.networks import parsed

PHONE_PX = 358
"""The width of a window of 390 pixels without the page's margins."""


def float_file(path: Path) -> str:
    """Write a small float network and return its path."""
    save_onnx(to_onnx(plain(), {}), path)
    return str(path)


@pytest.mark.parametrize("text", ["-1", "many", "2.5"])
def test_steps_of_fine_tuning_are_whole_or_auto(text: str) -> None:
    """The option `finetune` is 'auto' or a number of steps. Any other text is refused."""
    assert (steps_of("auto"), steps_of(20), steps_of("0")) == (None, 20, 0)
    with pytest.raises(
        OptionError, match="`finetune` must be 'auto' or a whole number of steps from 0"
    ):
        steps_of(text)


def test_the_patch_of_a_network_that_enlarges_is_shown_at_the_result_s_size() -> None:
    """The picture shows the patch next to both results, which may have more pixels."""
    image = uniform(1, 1, 9, 7)
    ends = "float[1,1,H,W] x => float[1,1,P,Q] y"
    sizes = [1.0, 1.0, 2.0, 2.0]
    session = open_session(
        parsed('y = Resize<mode="nearest">(x, , s)', ends, constants={"s": sizes})
    )
    picture = worst_picture(0, Patches([], [image]), (session, session), 1.0)
    assert picture.caption.startswith("MAE 0.00 DN, at most 0 DN")


@pytest.mark.slow
def test_a_network_fixed_to_one_tile_is_quantized_reported_and_gated(tmp_path: Path) -> None:
    """A network of one tile size is accepted by both commands, and its INT8 file keeps the size."""
    floating = tmp_path / "f.onnx"
    int8 = tmp_path / "i.onnx"
    save_onnx(to_onnx(plain(), {}, tile_px=80), floating)
    options = ["--out", int8, "--patches", "2", "--patch", "64", "--report", tmp_path / "r"]
    done("quantize", floating, *options)
    done("gate --patches 3 --max-mae 0.1", floating, int8)
    assert fixed_tile_px(load_onnx(int8)) == 80


@pytest.mark.slow
def test_quantize_reports_layers(tmp_path: Path) -> None:
    """The report has the tables that its page names, and the same numbers in JSON, HTML and node
    data.

    Node data are for viewers of ONNX files, so their names must be names in both files.
    """
    float_file(tmp_path / "f.onnx")
    dn = procedural_scene(640, 700, np.random.default_rng(0)).radiance * 4095 / 400
    write_tiff(tmp_path / "scenes" / "drawn.tif", np.rint(dn).astype(np.uint16))
    outputs = f"--out {tmp_path}/i.onnx --board-file {tmp_path}/core.onnx --json {tmp_path}/q.json"
    patches = f"--images {tmp_path}/scenes --patches 4 --patch 96"
    done(f"quantize {tmp_path}/f.onnx {outputs} --report {tmp_path}/r {patches}")
    document = valid(tmp_path / "q.json")
    tables = [row["table"] for row in document["rows"]]
    assert tables.count("integer layers") == 7
    for row in document["rows"]:
        if row["table"] == "integer layers":
            figures = row["figures"]
            assert (
                figures["accumulator, seen"]["value"]
                <= figures["accumulator, proven"]["value"]
                < 31
            )
    assert tables.count("price") == 6
    assert "one scale for the weights of a layer" in (tmp_path / "r" / "report.html").read_text()
    layers = [row for row in document["rows"] if row["table"] == "layers"]
    assert [row["name"] for row in layers][-1] == "all layers"
    shares = [row["figures"]["share of squared error"]["value"] for row in layers[:-1]]
    assert sum(shares) == pytest.approx(100)
    assert tables.count("worst patches") == 4
    data = json.loads((tmp_path / "r" / "node-data.json").read_text())
    assert [result["value"] for result in data["results"].values()] == shares
    for path in (tmp_path / "i.onnx", tmp_path / "core.onnx"):
        names = {node.name for node in load_onnx(path).graph.node}
        assert set(data["results"]) <= names
    assert valid(tmp_path / "r" / "report.json")["rows"] == document["rows"]
    page = (tmp_path / "r" / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 4
    assert page.count("data:image/svg+xml;base64,") == 1
    assert "std / MAE is" in page


def spread(difference_dn: np.ndarray) -> Spread:
    """Return the spread of given differences in digital numbers."""
    counts = np.bincount(difference_dn.astype(int) + MAX_DN, minlength=2 * MAX_DN + 1)
    return Spread(counts, np.array([0.1]), np.array([0.2]))


@pytest.mark.parametrize("farthest", [0, 1, 40, 41, 137, 4095])
def test_the_histogram_shows_every_error_in_few_bars(farthest: int) -> None:
    """Every error is in one of few bars, and 0 is in the middle one, whatever the largest error
    is.
    """
    dn = np.array([0, 0, 0, 1, -farthest, farthest])
    centres, shares, wide = bins(spread(dn))
    assert len(centres) <= MOST_BARS
    assert shares.sum() == pytest.approx(1)
    assert centres[-1] + wide // 2 >= farthest
    middle = len(centres) // 2
    assert centres[middle] == 0
    assert shares[middle] == pytest.approx(float((np.abs(dn) <= wide // 2).mean()))


def test_the_histogram_is_a_picture_for_light_and_dark() -> None:
    """The histogram is valid SVG whose colours follow the reader's theme."""
    dn = np.rint(np.random.default_rng(0).normal(0, 4, 5000))
    url = histogram_url(spread(dn))
    picture = base64.b64decode(url.removeprefix("data:image/svg+xml;base64,")).decode()
    root = ET.fromstring(picture)  # noqa: S314 - our own picture
    assert root.tag.endswith("svg")
    assert picture.count("fill: var(--mark2)") > 20
    assert "prefers-color-scheme: dark" in picture


@pytest.mark.parametrize("farthest", [1, 40, 137, 4095])
def test_labels_of_the_histogram_can_be_read_on_the_narrowest_page(farthest: int) -> None:
    """The picture is not scaled down to fit, and no label is cut or hides another."""
    dn = np.array([0] * 3_000_000 + [-farthest, farthest])
    url = histogram_url(spread(dn))
    root = ET.fromstring(base64.b64decode(url.removeprefix("data:image/svg+xml;base64,")))  # noqa: S314
    width = float(root.get("width") or 0)
    assert width <= PHONE_PX
    assert FONT_PX >= 12
    across = list[tuple[float, float]]()
    for text in (element for element in root.iter() if element.tag.endswith("text")):
        # The width of upright text is no horizontal extent.
        if text.get("transform"):
            continue
        wide = text_width(text.text or "")
        x = float(text.get("x") or 0)
        anchor = style_of(text).get("text-anchor")
        left = x - wide if anchor == "end" else x - wide / 2
        assert left >= 0
        assert left + wide <= width
        if (text.text or "").lstrip("-").replace(",", "").isdigit():
            across.append((left, left + wide))
    assert len(across) >= 3
    assert all(one[1] < other[0] for one, other in pairwise(across))


def test_a_report_on_samples_shows_the_worst_of_them(tmp_path: Path) -> None:
    """A report on a user's samples names them, and has no PSNR if they have no references."""
    float_file(tmp_path / "f.onnx")
    np.save(tmp_path / "s.npy", uniform(8, 1, 40, 48))
    options = f"--samples {tmp_path}/s.npy --out {tmp_path}/i.onnx --report {tmp_path}/r"
    output = " ".join(done(f"quantize {tmp_path}/f.onnx {options}").split())
    document = valid(tmp_path / "r" / "report.json")
    # Samples without references have no PSNR.
    *_, losses = document["notes"]
    assert "dB" not in losses
    assert output.endswith(losses)
    rows = document["rows"]
    assert [entry["name"] for entry in document["inputs"]] == ["f.onnx", "samples s.npy"]
    worst = {row["name"] for row in rows if row["table"] == "worst samples"}
    assert worst == {"sample 0", "sample 1"}
