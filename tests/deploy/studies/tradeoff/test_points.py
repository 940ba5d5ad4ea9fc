"""Tests of the operating points that a study compares, their figures, and times on this machine."""

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.variants import Variant as Shape
from beers_deploy.network import Network
from beers_deploy.performance.swath import Swath
from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import TILE_PX
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.studies.evaluation.pairs import NamedPair
from beers_deploy.studies.tradeoff.measure import (
    ROUNDS,
    Benchmark,
    host_figures,
    host_times,
)
from beers_deploy.studies.tradeoff.points import (
    FLOAT,
    HALOS_PX,
    INT8,
    TILE_STEP_PX,
    UNITS,
    Point,
    Variant,
    board_figures,
    dpu_latency,
    exact_halo_px,
    fastest_tile_px,
    network_points,
    network_variants,
)
from beers_deploy.studies.tradeoff.run import require_quantizable
from tests.deploy.dpu.graphs import integer_convbeers
from tests.deploy.studies.tradeoff.synthetic import DPU
from tests.model.networks import plain
from tests.quant.quick import fix_sizes

WHOLE = Swath(13600, 9016)
SENSOR = Sensor.load("pleiades-degraded")


@pytest.fixture(scope="module")
def variant(tmp_path_factory: pytest.TempPathFactory) -> Variant:
    """Write an INT8 network of four blocks of 16 features."""
    path = integer_convbeers(tmp_path_factory.mktemp("net") / "net.onnx", 4, 16)
    return Variant("net", INT8, Network.load(path))


def refused(_: Network) -> Network:
    raise ModelError("net has a sigmoid. Leave it out.")


def float_file(path: Path) -> Path:
    save_onnx(to_onnx(plain(Shape(1, 2)), {}), path)
    return path


def test_an_own_network_is_quantized_and_one_that_cannot_be_stays_float(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model = onnx.load(float_file(tmp_path / "net.onnx"))
    variants = network_variants([str(tmp_path / "net.onnx")], SENSOR, require_quantizable)
    assert [variant.precision for variant in variants] == [FLOAT, INT8]
    assert not caplog.records
    model.graph.node.append(onnx.helper.make_node("Elu", [model.graph.output[0].name], ["s"]))
    model.graph.output[0].name = "s"
    onnx.save(model, tmp_path / "elu.onnx")
    variants = network_variants([str(tmp_path / "elu.onnx")], SENSOR, require_quantizable)
    assert [variant.precision for variant in variants] == [FLOAT]
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert re.search("is compared in float32 alone: .*Elu", record.getMessage())


def test_other_names_and_two_files_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="a shipped network"):
        network_variants(["convbeers-xl"], SENSOR, refused)
    variants = network_variants(["convbeers-xs"], SENSOR, refused)
    assert [variant.name for variant in variants] == ["convbeers-xs float32", "convbeers-xs INT8"]
    taken = network_variants([variants[1].network or ""], SENSOR, refused)
    assert [variant.precision for variant in taken] == [INT8]
    (tmp_path / "other").mkdir()
    paths = [str(float_file(folder / "net.onnx")) for folder in (tmp_path, tmp_path / "other")]
    with pytest.raises(OptionError, match="must differ, but two are named 'net float32'"):
        network_variants(paths, SENSOR, lambda file: file)


def test_a_network_of_one_tile_size_is_refused(tmp_path: Path) -> None:
    model = onnx.load(float_file(tmp_path / "net.onnx"))
    fix_sizes(model.graph.input[0], 64, 64)
    onnx.save(model, tmp_path / "fixed.onnx")
    with pytest.raises(OptionError, match="fixed to one tile size"):
        network_variants([str(tmp_path / "fixed.onnx")], SENSOR, refused)


def test_the_fastest_tile_is_a_multiple_of_the_step_and_no_other_is_faster(
    variant: Variant,
) -> None:
    tile_px = fastest_tile_px(variant, DPU, WHOLE)
    radius = exact_halo_px(variant)
    assert tile_px % TILE_STEP_PX == 0
    assert 2 * radius < tile_px <= TILE_PX

    def seconds(side: int) -> float:
        return dpu_latency(variant, DPU, replace(WHOLE, tile_px=side, halo_px=radius)).value or 0.0

    assert seconds(tile_px) == min(
        seconds(side) for side in range(2 * radius + TILE_STEP_PX, 641, 1) if side % 16 == 0
    )


def test_int8_is_compared_on_every_board_and_configuration_in_several_tiles_and_halos(
    variant: Variant,
) -> None:
    boards = [TargetProfile.load("vck190"), TargetProfile.load("zcu102")]
    points = network_points(variant, boards, WHOLE)
    assert len({point.name for point in points}) == len(points)
    for board in boards:
        on_board = [point for point in points if point.board == board]
        assert {point.dpu.name for point in on_board if point.dpu} == set(board.configurations)
        assert {point.halo_px for point in on_board} == {
            None,
            *(halo for halo in HALOS_PX if halo < exact_halo_px(variant)),
        }
        assert TILE_PX in {point.tile_px for point in on_board}
    other = network_points(variant, boards[::-1], WHOLE)
    assert {point.name for point in other} == {point.name for point in points}


def test_a_float_network_has_no_board_but_a_reason(variant: Variant) -> None:
    board = TargetProfile.load("vck190")
    (point,) = network_points(replace(variant, precision=FLOAT), [board], WHOLE)
    assert point.board is None
    figures = board_figures(point, WHOLE)
    assert {figure.reason for figure in figures.values()} == {"the DPU takes INT8 alone"}


def test_a_smaller_halo_takes_less_time_and_figures_follow_from_the_latency(
    variant: Variant,
) -> None:
    def at(halo_px: int | None) -> dict[str, float]:
        figures = board_figures(Point(variant, DPU.target, DPU, 128, halo_px), WHOLE)
        assert {key: figure.unit for key, figure in figures.items()} == UNITS
        return {key: figure.value or 0.0 for key, figure in figures.items()}

    exact = at(None)
    none = at(0)
    assert none["board latency"] < exact["board latency"]
    assert exact["board energy"] == pytest.approx(exact["board latency"] * exact["board power"])
    assert exact["board throughput"] == pytest.approx(
        WHOLE.pixels / 640**2 / exact["board latency"]
    )
    assert exact["board efficiency"] == pytest.approx(WHOLE.pixels / exact["board energy"])


def test_the_halo_of_a_point_does_not_change_the_number_of_its_exposures() -> None:
    """The images are small, so a point's own cut of them would say little of its tiles."""
    image = np.full((150, 250), 2000)
    image[:, :110] = 100
    network = Network.load("convbeers-half-xs", sensor=SENSOR, int8=True)
    variant = Variant(network.name, INT8, network)
    benchmark = Benchmark([NamedPair("scene", image, image)], SENSOR, SENSOR, None, 0)
    halos = (None, *HALOS_PX)
    runs = {benchmark.runs(Point(variant, DPU.target, DPU, halo_px=halo)) for halo in halos}
    assert len(runs) == 1
    assert runs.pop() > 1


def test_a_chain_on_a_boards_processor_takes_the_stated_time_by_the_measured_ratio() -> None:
    chain = Variant("traditional-best")
    time_s_per_mpx = Constant((10.0, 40.0), "inferred", "a test")
    tables = {
        **DPU.target.tables,
        "cpu": {**DPU.target.tables["cpu"], "pipeline_s_per_mpx": time_s_per_mpx},
    }
    board = replace(DPU.target, tables=tables)
    swath = Swath(1000, 2000)
    latency = board_figures(Point(chain, board), swath, slower=3.0)["board latency"]
    assert latency.value == pytest.approx(2 * 3 * 20)
    assert latency.interval == pytest.approx((60, 240))
    untimed = replace(DPU.target, tables={"cpu": {}})
    assert (
        board_figures(Point(chain, untimed), swath, slower=3.0)["board latency"].mode
        == "unavailable"
    )


def test_a_method_is_timed_for_a_million_pixels_after_a_run_for_warm_up() -> None:
    runs = list[np.ndarray]()

    def restore(dn: np.ndarray) -> np.ndarray:
        runs.append(dn)
        return dn

    (times_s,) = host_times([restore], np.zeros((4, 4)))
    assert (len(times_s), len(runs)) == (ROUNDS, ROUNDS + 1)
    figures = host_figures([0.1, 0.2, 0.3], 100_000)
    assert figures["host p50"].value == 2.0
    assert (figures["host p90"].value or 0.0) > 2.0
