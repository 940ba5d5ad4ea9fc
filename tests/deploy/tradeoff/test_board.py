"""Ratios of predictions, and tiles whose maps stay on chip."""

import math
from dataclasses import replace

import onnx
import pytest

from deploy.bench.tables import Swath
from deploy.dpu.board import load_dpu
from deploy.networks import shipped_pair
from deploy.tradeoff.board import (
    DpuRun,
    cpu_run,
    energy_ratio,
    kept_tiles_px,
    latency_ratio,
    pair_error,
    predict_model,
)
from profiles import load_target
from profiles.errors import ModelError
from quant.encodings import board_model, read_core
from quant.onnx_file import load_onnx

SWATH, BOARD = Swath(2600, 1900), load_target("vck190")


@pytest.fixture(scope="module")
def model() -> onnx.ModelProto:
    return load_onnx(shipped_pair()[1])


def run(model: onnx.ModelProto, tile_px: int = 640, halo_px: int = 19, configuration: str = "C32B3") -> DpuRun:
    dpu = load_dpu("vck190", configuration)
    swath = replace(SWATH, tile_px=tile_px, halo_px=halo_px)
    return DpuRun("net", dpu, predict_model(model, dpu, tile_px), swath)


def test_of_one_network_tile_and_configuration_only_the_tiles_count(model: onnx.ModelProto) -> None:
    some, more = run(model, 176, 0), run(model, 176, 19)
    assert more.batches > some.batches
    expected = more.batches / some.batches
    assert latency_ratio(more, some) == pytest.approx((expected, expected))
    assert energy_ratio(more, some) == pytest.approx((expected, expected))


def test_another_tile_or_configuration_widens_the_ratio_and_the_power_the_energy(model: onnx.ModelProto) -> None:
    base = run(model)
    for other in (run(model, 176), run(model, configuration="C32B6")):
        low, high = latency_ratio(other, base)
        value = (other.figures()["board latency"].value or 0) / (base.figures()["board latency"].value or 1)
        assert low < value < high
        assert high / low >= math.exp(2 * pair_error("vck190")) * (1 - 1e-9)
    (low, high), (least, most) = (f(run(model, configuration="C32B6"), base) for f in (latency_ratio, energy_ratio))
    watts = base.dpu.limit("power", "dpu_range_w")
    assert (least, most) == pytest.approx((low * watts.low / watts.high, high * watts.high / watts.low))


def test_a_ratio_read_the_other_way_is_its_inverse(model: onnx.ModelProto) -> None:
    chain, peer = cpu_run("traditional-fast", (40.0, 60.0), SWATH, BOARD), cpu_run("peer", (10.0, 12.0), SWATH, BOARD)
    for a, b in ((run(model), run(model, 176)), (run(model), chain), (chain, peer)):
        low, high = latency_ratio(a, b)
        assert latency_ratio(b, a) == pytest.approx((1 / high, 1 / low))


def test_the_prediction_lies_between_the_two_extremes(model: onnx.ModelProto) -> None:
    base = run(model)
    serial = base.prediction.structure.serial
    assert base.latency_s(serial) == pytest.approx(base.figures()["board latency"].value)
    assert base.latency_s(0.0) <= base.latency_s(serial) <= base.latency_s(1.0)
    assert base.latency_s(0.0) < base.latency_s(1.0)


def test_chains_compare_without_the_factor_and_against_the_dpu_with_it(model: onnx.ModelProto) -> None:
    slow, fast = (
        cpu_run(f"traditional-{name}", cpu_s, SWATH, BOARD)
        for name, cpu_s in (("standard", (40.0, 44.0)), ("fast", (20.0, 22.0)))
    )
    assert latency_ratio(slow, fast) == pytest.approx((40 / 22, 44 / 20))
    assert energy_ratio(slow, fast) == latency_ratio(slow, fast)
    assert latency_ratio(slow, slow) == (1.0, 1.0)
    low, high = latency_ratio(slow, run(model))
    assert high / low > 2  # what is known of the board's processor


def test_a_method_of_unknown_kinds_shares_no_factor_and_is_known_worse() -> None:
    chain, peer = (
        cpu_run("traditional-fast", (20.0, 22.0), SWATH, BOARD),
        cpu_run("wiener", (20.0, 22.0), SWATH, BOARD),
    )
    (low, high), (least, most) = (each.figures()["board latency"].interval or (0.0, 0.0) for each in (chain, peer))
    assert least < low < high < most
    assert latency_ratio(chain, peer) == pytest.approx((low / most, high / least))


def test_figures_of_the_board_hang_together(model: onnx.ModelProto) -> None:
    figures = run(model).figures()
    latency, power, energy = (figures[f"board {key}"].value or 0 for key in ("latency", "power", "energy"))
    assert energy == pytest.approx(latency * power)
    assert figures["board efficiency"].value == pytest.approx(SWATH.pixels / energy)
    assert figures["board throughput"].value == pytest.approx(SWATH.pixels / 640**2 / latency)


def test_published_pairs_disagree_by_some_tens_of_percent() -> None:
    assert 0.1 < pair_error("vck190") < 0.5


@pytest.mark.slow
def test_tiles_stay_on_chip_up_to_where_the_memory_traffic_jumps(model: onnx.ModelProto) -> None:
    """32 features of 1 MiB: 181 x 181 pixels, so 176 in steps of 16."""
    dpu = load_dpu("vck190")
    found = kept_tiles_px(model, dpu, 16, 640)
    assert found[-1] == 176
    streamed = {side: predict_model(model, dpu, side).streamed_bytes / side**2 for side in range(16, 641, 16)}
    assert found == [side for side in list(streamed)[:-1] if streamed[side + 16] > 1.05 * streamed[side]]


def test_more_banks_keep_larger_tiles(model: onnx.ModelProto) -> None:
    dpu = load_dpu("vck190")
    tables = dict(dpu.target.tables)
    size = tables["memory"]["feature_map_bytes"]
    tables["memory"] = {**tables["memory"], "feature_map_bytes": replace(size, value=4 * size.low)}
    wide = replace(dpu, target=replace(dpu.target, tables=tables))
    assert kept_tiles_px(model, wide, 16, 640)[-1] == 352


def test_a_network_that_the_dpu_cannot_run_is_refused(model: onnx.ModelProto) -> None:
    spoilt = board_model(read_core(model), {})
    relu = next(node for node in spoilt.graph.node if node.op_type == "Relu")
    relu.op_type = "Pow"
    with pytest.raises(ModelError):
        kept_tiles_px(spoilt, load_dpu("vck190"), 16, 640)
