"""Tests that `restore --dry-run` shows what `restore` would do, without restoring a pixel."""

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from beers_deploy.network import Network, NetworkLike
from beers_deploy.performance.dry_run import preview_row
from beers_deploy.profiles.errors import MachineError
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.restoration.plan import Tiles
from beers_deploy.restoration.prepare import NetworkPipeline
from beers_deploy.restoration.radiometry import Reading
from beers_deploy.verbs.restore import restore
from tests.deploy.command_line import done
from tests.deploy.documents import valid
from tests.shipped import shipped_pair

TAGS = [
    (33550, "d", 3, (0.5, 0.25, 0.0), True),
    (33922, "d", 6, (0.0, 0.0, 0.0, 3e5, 4.8e6, 0.0), True),
    (34735, "H", 8, (1, 1, 0, 1, 3072, 0, 1, 32631), True),
    (42113, "s", 0, "7", True),
    (50844, "d", 92, tuple(np.linspace(-1, 1, 92)), True),
]


def about(
    image: Path,
    network: NetworkLike,
    tile_px: int = 640,
    full_scale: float | None = None,
) -> Row:
    """Return the facts of an image and of its restoration by a network."""
    pipeline = NetworkPipeline({"": Network.load(network)}, Tiles(tile_px))
    return preview_row(
        image, pipeline, Reading(full_scale=full_scale), TargetProfile.load("vck190")
    )


@pytest.mark.parametrize(
    ("tags", "system"), [(TAGS, "EPSG:32631"), (TAGS[:2] + TAGS[3:], "no coordinate system")]
)
def test_it_shows_the_facts_of_the_header(
    tags: Any, system: str, model: Path, tmp_path: Path
) -> None:
    tifffile.imwrite(tmp_path / "in.tif", np.ones((90, 70), np.uint16), extratags=tags)
    row = about(tmp_path / "in.tif", model, 23)
    assert [row.figures[key].value for key in ("width", "height", "bands")] == [70, 90, 1]
    assert row.text["pixels"] == "uint16"
    assert (row.text["full scale"], row.text["full scale from"]) == ("4095", "assumed: 12 bits")
    assert (
        row.text["georeference"]
        == f"{system}, first corner (300000, 4800000), pixels of 0.5 x 0.25"
    )
    assert (row.text["nodata"], row.text["rational polynomials"]) == ("7", "yes")


def test_its_plan_is_that_of_the_restoration(model: Path, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", np.ones((90, 70), np.uint16))
    plan = about(tmp_path / "in.tif", model, 23)
    (row,) = restore(tmp_path / "in.tif", tmp_path / "out.tif", network=model, tile=23)
    for key in ("tiles", "work factor"):
        assert plan.figures[key].value == row.figures[key].value
    for key in ("halo", "full scale", "full scale from"):
        assert plan.text[key] == row.text[key]


@pytest.mark.parametrize("kind", ["uint8", "float32"])
def test_an_unknown_full_scale_is_reported_as_open(kind: str, model: Path, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", np.ones((40, 40), kind))
    text = about(tmp_path / "in.tif", model).text
    assert text["full scale"] == "open"
    assert "full scale" in text["full scale from"]
    text = about(tmp_path / "in.tif", model, full_scale=200).text
    assert text["full scale from"] == "asked for"


def test_time_on_the_board_is_the_cost_model_s(tmp_path: Path) -> None:
    """Twice the height needs twice the tiles, and twice the time except for the last batch."""
    times = []
    for height in (600, 1200):
        tifffile.imwrite(tmp_path / f"{height}.tif", np.ones((height, 600), np.uint16))
        row = about(tmp_path / f"{height}.tif", shipped_pair()[1], 64)
        times.append(row.figures["time on vck190"])
    assert all(figure.mode == "predicted" for figure in times)
    first, second = (figure.value or math.nan for figure in times)
    assert second / first == pytest.approx(2, abs=0.1)


def test_it_says_that_the_times_count_one_exposure(model: Path, tmp_path: Path) -> None:
    """Most runs need several, and take that many times as long."""
    image = tmp_path / "in.tif"
    tifffile.imwrite(image, np.ones((40, 40), np.uint16))
    (planned,) = restore(image, network="convbeers-half-xs-int8", dry_run=True)
    (run,) = restore(image, tmp_path / "out.tif", network="convbeers-half-xs-int8")
    assert (
        planned.text["exposures"] == f"{run.text['exposures']}; the times count one for each tile"
    )
    assert "exposures" not in about(image, model).text


@pytest.mark.skipif(sys.platform != "linux", reason="other systems write its zeros")
def test_it_reads_none_of_a_file_of_ten_gigabytes(model: Path, tmp_path: Path) -> None:
    image = tifffile.memmap(
        tmp_path / "big.tif", shape=(73_000, 73_000), dtype="uint16", bigtiff=True
    )
    del image
    out = tmp_path / "a.json"
    done(f"restore {tmp_path}/big.tif --dry-run --network {model} --json {out}")
    (row,) = valid(out)["rows"]
    assert row["figures"]["width"]["value"] == 73_000
    # No pixel of it has light.
    assert row["figures"]["2 x 2 pattern"]["reason"] == "too few pixels"
    assert [entry["name"] for entry in valid(out)["inputs"]] == [model.name]


@pytest.mark.parametrize("name", ["old.tif", "out.png"])
def test_an_output_that_the_run_refuses_is_refused_in_the_same_words(
    name: str, model: Path, tmp_path: Path
) -> None:
    tifffile.imwrite(tmp_path / "raw.tif", np.full((20, 30), 900, np.uint16))
    (tmp_path / "old.tif").write_bytes(b"old")
    command = f"restore {tmp_path}/raw.tif {tmp_path / name} --network {model} --quiet"
    assert done(f"{command} --dry-run", code=2) == done(command, code=2)


def test_a_plan_that_the_memory_does_not_allow_is_refused(model: Path, tmp_path: Path) -> None:
    """The run would refuse it too, and a plan that cannot be kept is none."""
    tifffile.imwrite(tmp_path / "in.tif", np.ones((90, 70), np.uint16))
    with pytest.raises(MachineError, match=r"The run may use .* of memory"):
        restore(tmp_path / "in.tif", network=str(model), memory=0.001, dry_run=True)
