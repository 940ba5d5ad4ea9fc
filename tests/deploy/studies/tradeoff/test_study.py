"""Tests of a whole study of a tiny network, from Python and by its command."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from beers_deploy.dpu.board import boards_of
from beers_deploy.model.convbeers import save_network
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.variants import Variant as Shape
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import board_names
from beers_deploy.studies.tradeoff.advice import parse_constraints
from beers_deploy.studies.tradeoff.front import TOO_FEW, Measured
from beers_deploy.studies.tradeoff.measure import (
    SEAM_ERROR,
)
from beers_deploy.studies.tradeoff.page import Tradeoff
from beers_deploy.studies.tradeoff.run import Study, run_tradeoff
from beers_deploy.verbs.tradeoff import tradeoff
from tests.deploy.command_line import done
from tests.deploy.documents import valid
from tests.deploy.studies.tradeoff.small import small_studies
from tests.model.networks import plain

pytestmark = pytest.mark.slow

SITES = 2
SENSOR = "pleiades-degraded"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a network, two scenes to judge it on, and one to calibrate it on."""
    folder = tmp_path_factory.mktemp("tiny")
    save_network(folder / "narrow.safetensors", plain(Shape(1, 2), seed=3), {"degraded": SENSOR})
    for number in range(SITES + 1):
        scene = procedural_scene(300, 340, np.random.default_rng(number)).radiance
        place = (
            folder / ("images" if number < SITES else "calibration") / f"site{'abc'[number]}.png"
        )
        place.parent.mkdir(exist_ok=True)
        Image.fromarray(np.clip(scene, 0, 255).astype(np.uint8)).save(place)
    return folder


@pytest.fixture(scope="module", autouse=True)
def small() -> Iterator[None]:
    with small_studies():
        yield


@pytest.fixture(scope="module")
def study(folder: Path, small: None) -> Tradeoff:  # noqa: ARG001
    """Run a study of the tiny network on all boards, for the paper's swath."""
    degraded = Sensor.load(SENSOR)
    asked = Study(
        networks=[str(folder / "narrow.safetensors")],
        boards=boards_of("all"),
        sensors=(degraded, degraded.reference),
        scenes=folder / "images",
        lpips=None,
        calibration=folder / "calibration",
        size=(13600, 9016),
        budget=parse_constraints("budget", "latency<=60s,power<=18W"),
        need=[],
        seed=0,
    )
    return run_tradeoff(asked)


def own(study: Tradeoff) -> list[Measured]:
    """Return the points that were measured here, without the published ones."""
    return [point for point in study.points if point.point is not None]


def test_points_have_names_and_all_figures_but_those_of_absent_weights(
    study: Tradeoff,
) -> None:
    points = own(study)
    assert len({point.name for point in points}) == len(points) > 12
    published = [point for point in study.points if point.point is None]
    assert sorted(point.figures["board latency"].value or 0 for point in published) == [42, 1724]
    assert all(math.isnan(point.value("board latency")) for point in published)
    on_board = next(point for point in points if point.text["configuration"] == "C32B3")
    assert {key for key, figure in on_board.figures.items() if figure.value is None} == {
        "LPIPS-squeeze"
    }
    assert {point.text["sensor"] for point in points} == {"known"}


def test_exact_halos_give_one_picture_and_smaller_ones_show_seams(
    study: Tradeoff,
) -> None:
    points = [point for point in own(study) if "INT8" in point.name]
    exact = [point for point in points if point.text["halo"] == "exact"]
    (psnr_db,) = {point.value("PSNR") for point in exact}
    assert not any(SEAM_ERROR in point.figures for point in exact)
    for point in points:
        if point.text["halo"] == "0":
            assert point.value("PSNR") != psnr_db
            assert point.value(SEAM_ERROR) > 0


def test_two_sites_give_no_interval_but_a_note(study: Tradeoff) -> None:
    assert all(point.figures["PSNR"].interval is None for point in own(study))
    assert {row.text["gain over the next cheaper"] for row in study.front_rows} <= {
        "cheapest",
        TOO_FEW,
    }
    notes = " ".join(study.notes)
    assert "No interval over sites is shown: of 2, fewer than 5" in notes
    assert "Scene pixels per pixel: 2, where pleiades-degraded states 5" in notes


def test_a_budget_in_watts_chooses_another_board(study: Tradeoff) -> None:
    """The VCK190 is faster, and takes more power than this budget allows."""
    assert {row.name for row in study.board_rows} == set(board_names())
    assert study.best is not None
    assert study.best.text["board"] != "vck190"
    reason = "vck190: no point keeps board latency <= 60 s and board power <= 18 W; nearest is"
    assert any(note.startswith(reason) for note in study.notes)
    assert all("board power" in row.figures for row in study.front_rows)


def test_a_board_named_twice_is_refused(folder: Path) -> None:
    with pytest.raises(OptionError, match=r"`target` .* two are named 'vck190'"):
        tradeoff(network=str(folder / "narrow.safetensors"), target="vck190,vck190")


def test_the_command_writes_its_files_where_nothing_is_recommended(
    folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "study"
    network = ("--network", folder / "narrow.safetensors", "--size", "1500x1200")
    images = ("--images", folder / "images", "--calibration", folder / "calibration")
    outputs = ("--out", out, "--json", tmp_path / "figures.json")
    budget = ("--budget", "latency<=1e-3s, power <=20")
    output = done("tradeoff", *network, *images, *outputs, *budget, code=1)
    document = valid(tmp_path / "figures.json")
    line = document["rows"][0]["text"]["line"]
    assert line.startswith("nothing to recommend for board latency <= ")
    assert [text for text in output.splitlines() if "recommend" in text] == [line]
    assert document["verdict"] == "failed"
    assert document["arguments"]["budget"] == "board latency <= 0.001 s, board power <= 20 W"
    # The paper's runs are of its own swath.
    assert not any("paper" in row["name"] for row in document["rows"])
    assert {path.suffix for path in out.iterdir()} == {".html", ".svg", ".json"}
    assert valid(out / "tradeoff.json")["rows"][0]["text"]["line"] == line


def test_a_preview_counts_what_is_measured_and_writes_nothing(
    folder: Path, study: Tradeoff, working_folder: Path
) -> None:
    table = tradeoff(
        network=str(folder / "narrow.safetensors"),
        images=folder / "images",
        calibration=folder / "calibration",
        size=(1500, 1200),
        target="all",
        dry_run=True,
        progress=False,
    )
    (row,) = table.rows
    assert row.figures["points"].value == len(own(study))
    assert row.figures["images"].value == SITES
    assert row.figures["time here"].mode == "predicted"
    assert (row.figures["time here"].value or 0.0) > 0
    # It says what it leaves out and changes, as the study does.
    assert any("Scene pixels per pixel" in note for note in table.notes)
    assert set(table.notes) <= set(study.notes)
    assert list(working_folder.iterdir()) == []
