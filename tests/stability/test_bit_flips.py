"""Tests of bit flips: the loss by injections, the gain by guards, and their cost on the board."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from beers_deploy.dpu.board import load_dpu
from beers_deploy.performance.swath import predict_network
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import TILE_PX
from beers_deploy.quant.core import IntConv
from beers_deploy.quant.graph import Activation
from beers_deploy.quant.integer.reference import NO_FAULTS
from beers_deploy.quant.samples.simulated import Calibration
from beers_deploy.studies.stress import faults
from beers_deploy.studies.stress.bit_flips import (
    FaultTarget,
    curve_rows,
    flip_curves_svg,
    guard_rows,
    make_target,
    name_of,
)
from beers_deploy.studies.stress.faults import (
    MEMORIES,
    Guards,
    Injected,
    as_stored,
    checksums,
    map_channels,
    restored,
)
from beers_deploy.studies.stress.networks import Subject, open_subject
from docs.make import bit_flips as maker
from tests.deploy.command_line import done, refused
from tests.deploy.documents import valid
from tests.shipped import shipped_pair

pytestmark = pytest.mark.slow

SVG = "{http://www.w3.org/2000/svg}"
CURVES = f".//{SVG}g[@class='curve']"
SOURCE = Calibration(Sensor.load("pleiades-degraded"), None, patches=2, patch_px=48, seed=3)


@pytest.fixture(scope="module")
def target() -> FaultTarget:
    """Return a trained network; flipped bits hardly change the quality of an untrained one."""
    return make_target(open_subject("convbeers-xs"), SOURCE)


@pytest.fixture(scope="module")
def rows(target: FaultTarget) -> dict[str, Row]:
    return {row.name: row for row in curve_rows(target, 2, seed=0)}


def db(row: Row, guards: str) -> float:
    value = row.figures[guards].value
    assert value is not None
    return value


def test_few_flips_cost_nothing_and_many_lower_the_psnr(rows: dict[str, Row]) -> None:
    clean = db(rows["none"], "no guard")
    for memory in ("weights", "maps", "image"):
        levels_db = [db(rows[name_of(memory, rate)], "no guard") for rate in MEMORIES[memory].rates]
        assert levels_db[0] == pytest.approx(clean, abs=0.2)
        assert levels_db[-1] < clean - 0.1
    assert db(rows[name_of("shifts", 10_000)], "no guard") <= clean


def test_scrubbing_and_majority_restore_the_fault_free_network(rows: dict[str, Row]) -> None:
    for rate in MEMORIES["weights"].rates:
        assert db(rows[name_of("weights", rate)], "all guards") == db(rows["none"], "all guards")
    assert db(rows[name_of("shifts", 1000)], "all guards") == db(rows["none"], "all guards")


def test_the_same_seed_flips_the_same_bits(
    target: FaultTarget, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = {name: replace(each, rates=each.rates[-1:], times=1) for name, each in MEMORIES.items()}
    monkeypatch.setattr(faults, "MEMORIES", few)
    first, repeated, other = (curve_rows(target, 1, seed) for seed in (0, 0, 1))
    assert repeated == first
    assert other != first


@pytest.mark.parametrize("memory", list(MEMORIES))
def test_an_injection_leaves_the_target_alone(memory: str, target: FaultTarget) -> None:
    image = target.pairs[0][0]
    before = image.copy()
    fault_free = restored(Injected(target.core, NO_FAULTS, image, 0))
    injected = MEMORIES[memory].inject(target.core, image, 50_000, np.random.default_rng(0))
    assert injected.flips > 0
    assert not np.array_equal(restored(injected), fault_free)
    assert_array_equal(restored(injected), restored(injected))
    assert_array_equal(image, before)
    assert_array_equal(
        restored(Injected(target.core, NO_FAULTS, target.pairs[0][0], 0)), fault_free
    )


def test_at_half_resolution_maps_have_8_bits_per_channel_and_place(coarse: Subject) -> None:
    target = make_target(coarse, SOURCE)
    image, _ = target.pairs[0]
    result = restored(Injected(target.core, NO_FAULTS, target.pairs[0][0], 0))
    assert result.shape == image.shape
    assert np.abs(result - image).max() > 0
    every = MEMORIES["maps"].inject(target.core, image, 1e6, np.random.default_rng(0))
    assert every.flips == 8 * image.size // 4 * sum(map_channels(target.core).values())
    assert (restored(every) != result).mean() > 0.5


@pytest.mark.parametrize("variant", ["convbeers-xs", "convbeers-s", "convbeers"])
def test_all_guards_cost_under_two_per_cent_on_the_board(variant: str) -> None:
    core = as_stored(open_subject(variant).core)
    relus = {
        op.output: 96
        for op in core.ops
        if isinstance(op, IntConv) and op.activation is Activation.relu
    }
    dpu = load_dpu("vck190", None)
    target = FaultTarget(core, Guards(relus, 1024.0, checksums(core)), (), ())
    prices = guard_rows(target, predict_network(shipped_pair(variant)[1], dpu, TILE_PX), dpu)
    *parts, together = (db(row, "time") for row in prices)
    assert together == pytest.approx(sum(parts))
    assert 0 < db(prices[-1], "of a tile, if nothing hides") < 2
    assert db(prices[-1], "frame rate lost beside the DPU") == 0
    for row in prices:
        assert all(figure.mode == "predicted" for figure in row.figures.values())
        assert all(figure.interval for figure in row.figures.values())


def test_the_command(pair: list[Path], tmp_path: Path) -> None:
    files = ["--json", str(tmp_path / "f.json"), "--out", str(tmp_path / "f.md")]
    few = ["--bit-flips", "--draws", "1", "--side", "32"]
    done("stress", *pair, *few, *files)
    document = valid(tmp_path / "f.json")
    assert {row["table"] for row in document["rows"]} == {"bit flips", "guards"}
    page = (tmp_path / "f.md").read_text(encoding="utf-8")
    assert "## What guards cost on the board" in page
    picture = ET.fromstring((tmp_path / "f.svg").read_text(encoding="utf-8"))  # noqa: S314 - written above
    assert len(picture.findall(CURVES)) == 2 * len(MEMORIES)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["FLOAT", "--bit-flips"], "INT8 network"),
        (["FLOAT", "INT8", "--bit-flips", "--sensor", "nobody"], "nobody"),
        (["FLOAT", "INT8", "--bit-flips", "--target", "nobody"], "nobody"),
        (["FLOAT", "INT8", "--bit-flips", "--images", "nowhere"], "nowhere"),
        (["FLOAT", "INT8", "--bit-flips", "--out", "x.svg"], "x.svg"),
        (
            ["FLOAT", "INT8", "--bit-flips", "--out", "x.md", "--json", "x.svg"],
            "x.svg is the path of another output",
        ),
    ],
)
def test_wrong_arguments(
    arguments: list[str],
    message: str,
    pair: list[Path],
    working_folder: Path,
) -> None:
    files = {"FLOAT": str(pair[0]), "INT8": str(pair[1])}
    assert message in refused("stress", *(files.get(text, text) for text in arguments))
    assert not list(working_folder.iterdir())


def test_the_page_is_fresh() -> None:
    """Costs on the board are predicted again; the rows of measurements are only counted."""
    page = (maker.DOCS / "explanation" / "bit-flips.md").read_text(encoding="utf-8")
    assert page.startswith(maker.OPENING + maker.FINDINGS)
    dpu = load_dpu("vck190", None)
    for variant in maker.VARIANTS:
        target = make_target(open_subject(variant), maker.SOURCE)
        rows = guard_rows(target, predict_network(shipped_pair(variant)[1], dpu, TILE_PX), dpu)
        assert all(line in page for line in maker.price_lines({variant: rows}))
    for name, memory in MEMORIES.items():
        assert page.count(f"\n| {name}, ") == len(memory.rates)


def test_the_points_of_a_curve_ascend_in_x(rows: dict[str, Row]) -> None:
    picture = ET.fromstring(flip_curves_svg({"a": list(rows.values())}))  # noqa: S314 - our own
    lines = picture.findall(f"{CURVES}/{SVG}path[1]")
    assert lines
    for line in lines:
        numbers = line.attrib["d"].replace("M", " ").replace("L", " ").split()
        places = [float(number) for number in numbers[::2]]
        assert len(places) > 2
        assert all(a < b for a, b in pairwise(places))
