"""Tests of several boards in one table, and of networks that run on whole images."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import tifffile

import beers_deploy as bd
from beers_deploy.dpu.board import boards_of, load_dpu
from beers_deploy.model.raster.images import read_acquisition
from beers_deploy.model.shipped import SHIPPED
from beers_deploy.network import Network
from beers_deploy.performance import traditional
from beers_deploy.performance.board import Bench, Question, bench_board, boards_for
from beers_deploy.performance.swath import Swath
from beers_deploy.performance.tables import sweep_rows, within_words
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import board_names, npu_names
from tests.deploy.dpu.graphs import integer_convbeers
from tests.profiles.own_sensor import departing
from tests.quant.simplify.networks import parsed


def bench(model: Path | onnx.ModelProto, target: str = "vck190", **options: Any) -> Bench:
    """Predict a small swath in small tiles; the traditional pipeline is not measured."""
    usual: dict[str, Any] = {"size": "300x260", "tile": 128, "traditional": False}
    return bd.bench(model, target=target, **{**usual, **options})


def question(size: tuple[int, int] | None = None) -> Question:
    """Return the question of one board, with the consistency step, in tiles of 128 pixels."""
    boards, _ = boards_for(boards_of("vck190"), None, None)
    return Question(boards, [], size, [128], "exact", None, None, consistency=True)


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return integer_convbeers(tmp_path_factory.mktemp("net") / "net.onnx", 2, 16)


def classifier() -> onnx.ModelProto:
    """Build a classifier of images of 32 x 32 pixels into ten classes."""
    half = "pads=[1,1,1,1], strides=[2,2]"
    nodes = f"""
        a = Conv<{half}>(image, first) b = Relu(a)
        c = Conv<{half}, group=16>(b, deep) d = Clip(c, zero, six)
        e = Conv(d, wide) f = Clip(e, zero, six)
        mean = GlobalAveragePool(f) line = Flatten(mean) y = Gemm(line, last)
    """
    shapes = {"first": (16, 1, 3, 3), "deep": (16, 1, 3, 3), "wide": (64, 16, 1, 1)}
    weights = {name: np.ones(shape) for name, shape in shapes.items()}
    constants = {**weights, "last": np.ones((64, 10)), "zero": 0.0, "six": 6.0}
    return parsed(nodes, "float[1,1,32,32] image => float[1,10] y", constants=constants)


def names(rows: Sequence[Row]) -> list[str]:
    return [row.name for row in rows]


def test_one_table_has_all_boards_their_processors_and_the_papers_rows(
    network: Path,
) -> None:
    result = bench(network, "all")
    swept = [row for row in result.rows if row.table == "sweep"]
    assert [name.split()[0] for name in names(swept)] == board_names()
    for row in swept:
        low, high = row.figures["latency"].interval or (0.0, 0.0)
        assert 0 < low < (row.figures["latency"].value or 0) < high
        assert {"throughput", "power", "efficiency"} <= set(row.figures)
    processors = [row for row in result.rows if "processor of" in row.name]
    assert len(processors) == len(board_names())
    for row in processors:
        low, high = row.figures["latency"].interval or (0.0, 0.0)
        assert 0 < low < (row.figures["latency"].value or 0) < high < 4 * low
    assert sum(name.startswith("paper") for name in names(result.rows)) == 2


def test_the_smallest_dpu_that_meets_a_time_is_named(network: Path) -> None:
    boards = [load_dpu("vck190", name) for name in ("C32B1", "C32B3", "C32B6")]
    rows = sweep_rows(network, [Swath(3000, 2600, tile, 5) for tile in (256, 128)], boards)
    times_s = [row.figures["latency"].value or math.inf for row in rows]
    slowest = max(times_s)
    fastest = min(times_s)
    assert "C32B1" in within_words(rows, boards, 10 * slowest)
    assert within_words(rows, boards, fastest / 1000).endswith("none of these")
    words = within_words(rows, boards, fastest)
    name = rows[int(np.argmin(times_s))].name
    assert f"by the prediction {name}" in words
    assert "by the whole interval" not in words


def test_one_row_is_counted_as_the_paper_counts(network: Path) -> None:
    """It is that of the default configuration, even if whole tiles of all are compared."""
    one = bench(network, dpu="C32B3").rows
    (alike,) = [row for row in one if "as the paper counts" in row.name]
    (same,) = [row for row in bench(network, dpu="all").rows if "as the paper counts" in row.name]
    assert same == alike
    others = bench(network, "zcu102,kv260").rows
    assert not [row for row in others if "paper" in row.name]


@pytest.mark.parametrize(("target", "warned"), [("vck190,vek280", True), ("vck190", False)])
def test_the_first_line_warns_of_a_board_of_which_little_is_known(
    network: Path, target: str, warned: bool
) -> None:
    result = bench(network, target)
    assert ("Of vek280 little is known" in result.headings[result.rows[0].table]) is warned
    assert "Of vck190" not in str(result.headings)


@pytest.mark.parametrize(("others", "warned"), [(0.5, True), (0.1, False)])
def test_the_first_line_warns_if_other_programs_load_the_machine(
    network: Path, monkeypatch: pytest.MonkeyPatch, others: float, warned: bool
) -> None:
    monkeypatch.setattr(traditional, "load_of_others", lambda *_: others)
    monkeypatch.setattr(traditional, "CROP_PX", 48)
    result = bench(network, traditional=True)
    heading = result.headings[result.rows[0].table]
    assert ("other programs took 50%" in heading) is warned


def test_a_network_that_is_not_tiled_is_predicted_by_the_frame() -> None:
    # The traditional pipeline restores only swaths, so `traditional` has no effect here.
    result = bench(classifier(), size=None, traditional=True)
    (frame,) = [row for row in result.rows if row.table == "frames"]
    assert (frame.figures["throughput"].interval or (0, 0))[0] > 0
    layers = result.layers
    work = math.fsum(row.figures["work"].value or 0 for row in layers if "work" in row.figures)
    assert frame.figures["work"].value == pytest.approx(work)
    assert "frames of 32 x 32" in result.headings["frames"]
    assert any("whole images" in note and "GlobalAveragePool" in note for note in result.notes)
    assert not any("traditional" in name for name in names(result.rows))
    with pytest.raises(ModelError, match=r"GlobalAveragePool.*by the frame, leave out `size`\."):
        # A size describes a swath.
        bench(classifier(), size="300x260")


@pytest.mark.parametrize("target", ["all", "kv260,vck190"])
def test_one_configuration_or_runs_of_several_boards_are_refused(
    target: str, network: Path, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match="`dpu` 'C32B3' cannot be combined with several boards"):
        bench(network, target, dpu="C32B3")
    with pytest.raises(OptionError, match="`measured` cannot be combined with several boards"):
        bench(network, target, measured=tmp_path / "runs.json")


@pytest.mark.parametrize("npu", npu_names())
def test_an_npu_is_refused_next_to_boards_that_are_predicted(npu: str, network: Path) -> None:
    for target in (f"{npu},vck190", f"vck190,{npu}"):
        with pytest.raises(OptionError, match=f"target '{npu}' has no DPU"):
            bench(network, target)


@pytest.mark.parametrize("bits", [12, 14])
def test_the_exposures_of_an_image_are_counted_whatever_the_bits_of_the_sensor(
    network: Path, bits: int, tmp_path: Path
) -> None:
    sensor = Sensor.load("pleiades-degraded")
    gain = sensor.gain_dn_per_radiance.low * 2 ** (bits - 12)
    sensor = sensor.replace(bits=bits, gain_dn_per_radiance=gain)
    # These pixels are too bright for x4, unless full scale is that of 14 bits.
    pixels = np.full((128, 256), 2000, np.uint16)
    # These pixels are dark enough for x16, also far from bright ground.
    pixels[:, :128] = 200
    tifffile.imwrite(tmp_path / "image.tif", pixels)
    dn = read_acquisition(tmp_path / "image.tif", 4095, None)
    result = bench_board(Network.load(network), question(), dn, sensor)
    (words,) = (note for note in result.notes if "by exposure" in note)
    shares = dict(re.findall(r"(x\d+) (\d+)%", words))
    assert shares.keys() == {"x1", "x4", "x16"}
    assert int(shares["x1"]) > 0
    assert int(shares["x16"]) > 0
    assert int(shares["x4"]) == 0


def test_the_exposures_of_an_image_are_those_of_each_tile_size(tmp_path: Path) -> None:
    """A small tile needs fewer exposures, whatever sizes are compared and in which order."""
    pixels = np.full((200, 300), 2000, np.uint16)
    pixels[:80, :80] = 200
    tifffile.imwrite(tmp_path / "image.tif", pixels)
    runs = []
    for tile in ("96,200", "200,96"):
        network = SHIPPED / "convbeers-half-xs-int8.onnx"
        table = bench(network, image=tmp_path / "image.tif", size=None, tile=tile)
        swept = [row for row in table.rows if row.table == "sweep"]
        runs.append({row.name: row.figures["network runs"].value for row in swept})
        assert [note.split("tiles of ")[1][:3].strip() for note in table.notes[:2]] == tile.split(
            ","
        )
    assert runs[0] == runs[1]
    small, large = runs[0].values()
    assert (small or 0) < (large or 0)


def test_the_bands_that_a_network_restores_together_all_take_the_processor_s_time() -> None:
    step_s = {}
    pipeline_s = {}
    for bands in (1, 4):
        nodes = "a = Conv<pads=[1,1,1,1]>(image, weights) b = Relu(a) y = Add(image, b)"
        weights = np.ones((bands, bands, 3, 3))
        sides = f"float[1,{bands},h,w]"
        model = parsed(nodes, f"{sides} image => {sides} y", constants={"weights": weights})
        network, comparison, *_ = bench(model, "zcu104").rows[1:]
        step_s[bands] = network.figures["consistency step"].value or math.nan
        pipeline_s[bands] = comparison.figures["latency"].value or math.nan
    assert step_s[4] == pytest.approx(4 * step_s[1])
    assert pipeline_s[4] == pytest.approx(4 * pipeline_s[1])


def test_a_file_for_every_sensor_has_the_exposures_of_its_name(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "dark.tif", np.full((128, 128), 200, np.uint16))
    name = "convbeers-half-xs-int8"
    notes = [
        bd.bench(each, image=tmp_path / "dark.tif", tile=128, traditional=False).notes
        for each in (name, SHIPPED / f"{name}.onnx")
    ]
    assert notes[0] == notes[1]
    assert any("x16 100%" in note for note in notes[0])


def test_a_curve_of_another_shape_takes_the_host_longer(network: Path) -> None:
    """Where the MTF departs from the formula's curve the consistency step corrects detail too."""
    sensor = Sensor.load("pleiades-degraded")
    times = []
    for profile in (sensor, departing(sensor)):
        rows = bench_board(Network.load(network), question((700, 600)), sensor=profile).rows
        step, *_ = [r.figures["consistency step"] for r in rows if "consistency step" in r.figures]
        assert step.interval is not None
        times.append(step.interval[1])
    assert 2 < times[1] / times[0] < 4
