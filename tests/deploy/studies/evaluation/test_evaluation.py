"""Tests of the command `evaluate`, of the images on its page, and of its tables."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beers_deploy.model.raster.writer import write_tiff
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.studies.evaluation.compression import GAIN, LOSSLESS
from beers_deploy.studies.evaluation.methods import Method
from beers_deploy.studies.evaluation.run import strip_of
from beers_deploy.verbs.evaluate import evaluate, numbers_of
from beers_deploy.verbs.simulate import simulate
from tests.deploy.command_line import done
from tests.deploy.documents import figures_of, valid
from tests.deploy.studies.evaluation.small_pairs import (
    IDENTITY,
    few_targets,
    pair,
    write_pairs,
)


@pytest.fixture(autouse=True)
def _few_targets(monkeypatch: pytest.MonkeyPatch) -> None:
    few_targets(monkeypatch)


def test_strips_show_every_method_and_black_below_the_reference() -> None:
    one = pair()
    strip, white = strip_of(one, [IDENTITY, Method("zero", np.zeros_like, "blind")])
    side = 37 * 2
    assert strip.shape == (22 + 2 * (side + 4), 3 * (side + 4) - 4)
    assert white > 1
    errors = strip[22 + side + 4 :][:side]
    assert errors[:, 2 * (side + 4) :].max() == 0
    assert errors[:, :side].max() == 255


def test_the_command_on_a_folder_of_pairs(tmp_path: Path) -> None:
    folder = write_pairs(tmp_path / "pairs", [pair("a_1.tif", 1), pair("b_1.tif", 2)])
    files = "--json", tmp_path / "e.json", "--out", tmp_path / "out"
    done("evaluate --methods traditional-fast --bits-per-pixel 6 --pairs", folder, *files)
    document = valid(tmp_path / "e.json")
    assert [entry["name"] for entry in document["inputs"]] == ["a_1.tif", "b_1.tif"] * 2
    assert document["arguments"]["methods"] == "degraded,traditional-fast"
    names = [row["name"] for row in document["rows"] if row["table"] == "mean"]
    assert names == ["degraded", "traditional-fast", "paper: traditional", "paper: ConvBEERS"]
    of_paper = [row for row in document["rows"] if row["name"].startswith("paper")]
    modes = {figure["mode"] for figure in figures_of(of_paper)}
    assert modes == {"published", "unavailable"}
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("data:image/png") == 2
    assert "Gain of restoring before compression" in page
    compressed = [row["name"] for row in document["rows"] if row["table"] in (GAIN, LOSSLESS)]
    assert compressed == ["traditional-fast, 6 bit/px", "traditional-fast"]
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.png", "b.png", "report.html"]


def test_a_function_that_returns_another_shape_or_no_numbers_is_refused() -> None:
    image: Any = simulate(size=64, progress=False)
    functions: dict[str, Any] = {
        "no array": lambda _: None,
        "5 x 64": lambda dn: dn[:5],
        "64 x 64 of complex": lambda dn: dn + 1j,
        "64 x 64 of float": lambda dn: dn * np.nan,
    }
    for words, function in functions.items():
        with pytest.raises(ImageError, match=f"function mine must return .* 64 x 64, got {words}"):
            evaluate(methods={"mine": function}, pairs=[image])


def test_a_name_that_is_no_text_is_refused() -> None:
    methods: Any = {1: np.asarray}
    with pytest.raises(OptionError, match="`methods` must be names, or a mapping of names"):
        evaluate(methods=methods)


def test_no_pair_at_all_is_refused() -> None:
    with pytest.raises(OptionError, match="no `pairs`"):
        evaluate(methods=["degraded"], pairs=[])


@pytest.mark.parametrize("number", [0.0, 12.5, float("nan"), "x"])
@pytest.mark.parametrize(("option", "most"), [("brightness", 1), ("bits_per_pixel", 12)])
def test_a_number_out_of_range_is_refused(number: Any, option: str, most: int) -> None:
    numbers: Any = {option: (1, number)}
    with pytest.raises(OptionError, match=f"`{option}` .* above 0 and at most {most},"):
        evaluate(methods=["wiener"], **numbers)


def test_a_number_that_is_given_twice_counts_once() -> None:
    assert numbers_of("bits_per_pixel", "2,12,2", 12, "1,2,3") == [2, 12]


def test_the_command_at_two_brightnesses_on_photographs(tmp_path: Path) -> None:
    scene = np.random.default_rng(0).integers(200, 3000, (270, 300)).astype(np.uint16)
    write_tiff(tmp_path / "scenes" / "zebra_DJI_0005.tif", scene)
    write_tiff(tmp_path / "scenes" / "zebra_DJI_0013.tif", scene[::-1])
    dim = ", radiance x 0.05"
    files = ("--images", tmp_path / "scenes", "--json", tmp_path / "e.json")
    done("evaluate", *files, "--methods", "degraded", "--brightness", "0.05")
    document = valid(tmp_path / "e.json")
    assert document["arguments"]["brightness"] == "1,0.05"
    names = [row["table"] for row in document["rows"]]
    assert list(dict.fromkeys(names))[:3] == ["mean", f"mean{dim}", "targets"]
    assert names.count("images") == names.count(f"images{dim}") == 2
    assert document["rows"][names.index("PSNR by site")]["name"] == "zebra"
    means = [document["rows"][names.index(f"mean{end}")]["figures"] for end in ("", dim)]
    # PSNR is over the same full scale at both brightnesses, and noise falls with the light.
    assert means[1]["PSNR"]["value"] > means[0]["PSNR"]["value"] + 10
    assert {"MTF at Nyquist", "SNR at 10 W/m2/sr/um"} <= set(means[0]) - set(means[1])
