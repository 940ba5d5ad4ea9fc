"""Tests of the operators that the DPU refuses at a network's ends, and of their cost."""

import onnx
import pytest

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.cost.host import FloatWork, float_interval_s, refused_interval_s
from beers_deploy.dpu.cost.latency import Prediction, predict
from beers_deploy.dpu.cost.model import between
from beers_deploy.network import Network
from beers_deploy.performance.swath import float_work, predict_network
from beers_deploy.performance.tables import host_words
from beers_deploy.profiles.errors import ModelError
from tests.deploy.dpu.draws import DPU, placed
from tests.deploy.dpu.graphs import SAME, IntegerSketch, written
from tests.quant.quick import patches_of, quickly, uniform
from tests.quant.test_host_end import float_network


def segmenter(where: str, behind: str = "") -> onnx.ModelProto:
    """Build a network that enlarges scores of 19 classes from an eighth of the size."""
    nodes = "a = Conv<pads=[1,1,1,1], strides=[8,8]>(image, w32x3x3x3) b = Conv(a, w19x32x1x1)"
    large = f'Resize<mode="linear", coordinate_transformation_mode="{where}">(b, , eight)'
    end = f"c = {large} y = {behind}(c)" if behind else f"y = {large}"
    return written(f"{nodes} {end}", 3)


def predicted(where: str) -> Prediction:
    return predict_network(segmenter(where), DPU, 128)


def test_an_enlargement_on_the_dpu_costs_the_processor_nothing() -> None:
    """UG1414: the DPU enlarges eight times in mode asymmetric, but not in mode half_pixel."""
    on_dpu, on_cpu = (predicted(where) for where in ("asymmetric", "half_pixel"))
    assert (on_dpu.refused, on_dpu.refused_s) == ((), (0.0, 0.0))
    assert len(on_cpu.refused) == 1
    assert 0 < on_cpu.refused_s[0] < on_cpu.refused_s[1]
    assert on_cpu.fps_interval[0] < on_dpu.fps_interval[0]
    assert on_cpu.host_interval_s[1] > on_cpu.refused_s[1]


def test_nodes_behind_a_refused_node_stay_on_the_processor() -> None:
    placement = placed(segmenter("half_pixel", behind="GlobalMaxPool"), 128)
    assert [node.device for node in placement.nodes] == ["DPU", "DPU", "CPU", "host"]
    assert [cut.onto_dpu for cut in placement.cuts] == [True, False]


def test_a_refused_node_in_front_also_runs_on_the_processor() -> None:
    model = written(f"a = Softmax<axis=1>(image) y = {SAME}(a, w)")
    assert predict_network(model, DPU, 20).refused == (model.graph.node[0].name,)


def test_between_two_convolutions_of_the_dpu_there_is_no_prediction() -> None:
    nodes = f"a = {SAME}(image, w) b = Softmax<axis=1>(a) c = Add(a, b) y = {SAME}(c, w)"
    with pytest.raises(ModelError, match="Softmax"):
        predict_network(written(nodes), DPU, 20)


def test_numbers_that_the_dpu_refuses_are_no_work_for_the_processor() -> None:
    sketch = IntegerSketch()
    first = sketch.qconv(sketch.quantized("image"), (4, 1, 3, 3))
    last = sketch.qconv(first, (4, 4, 3, 3), weight_scale=0.3)
    model = sketch.model(sketch.node("DequantizeLinear", last, *sketch.numbers))
    with pytest.raises(ModelError, match="check"):
        predict_network(model, DPU, 20)


@pytest.mark.parametrize("board", ["vck190", "zcu102", "kv260"])
def test_time_is_in_proportion_to_the_work_and_lies_between_peak_and_plain_code(
    board: str,
) -> None:
    dpu = load_dpu(board)
    ops = [placed(segmenter("half_pixel"), px).nodes[-1].op for px in (128, 256)]
    (low, high), larger = (refused_interval_s([op], dpu) for op in ops)
    assert larger == pytest.approx((4 * low, 4 * high))
    assert refused_interval_s(ops[:1] * 3, dpu) == pytest.approx((3 * low, 3 * high))
    clock = dpu.limit("cpu", "clock_ghz")
    cores = dpu.whole("cpu", "cores")
    moved_bytes = 4 * ops[0].out_bytes
    assert low * cores > moved_bytes / dpu.limit("cpu", "moved_bytes_per_s").high
    assert high * cores > ops[0].out_bytes / (1e9 * clock.low)
    assert low < between((low, high)) < high
    assert refused_interval_s([], dpu) == (0.0, 0.0)


def test_the_notes_name_the_nodes_that_the_processor_runs() -> None:
    prediction = predicted("half_pixel")
    _, sentence = host_words(prediction)
    assert "vck190" in sentence
    assert prediction.refused[0] in sentence
    assert len(host_words(predicted("asymmetric"))) == 1


def heads() -> onnx.ModelProto:
    """Build a network of two maps of 255 channels, at a half and a quarter of the size.

    It first moves the image's pixels to channels.
    """
    nodes = f"""
        a = SpaceToDepth<blocksize=2>(image) b = {SAME}(a, w16x12x3x3)
        c = Conv<pads=[1,1,1,1], strides=[2,2]>(b, w32x16x3x3)
        d = Conv(b, w255x16x1x1) y = Sigmoid(d) e = Conv(c, w255x32x1x1) z = Sigmoid(e)
    """
    return written(nodes, 3, ("y", "z"))


def test_several_heads_are_copied_and_are_no_image() -> None:
    placement = placed(heads(), 64)
    assert placement.failed == ()
    assert sum(cut.size_bytes or 0 for cut in placement.cuts if not cut.onto_dpu) == 255 * (
        32**2 + 16**2
    )
    prediction = predict_network(heads(), DPU, 64)
    assert (prediction.task, prediction.refused) == ("copy", ())


@pytest.mark.parametrize(("channels", "task"), [(12, "image"), (76, "copy")])
def test_results_of_few_bands_become_an_image_and_scores_do_not(channels: int, task: str) -> None:
    nodes = f"a = {SAME}(image, w{channels}x3x3x3) y = DepthToSpace<blocksize=2>(a)"
    assert predict_network(written(nodes, 3), DPU, 64).task == task


def test_what_the_host_computes_in_float_takes_time_in_both_files() -> None:
    """The INT8 file states it in its description, and the float file by its operators."""
    network = float_network("Tanh of the correction of the enlarged image")
    raw = uniform(1, 2, 40, 40)
    int8 = quickly(network, patches_of([raw])).host
    work = float_work(Network.load(int8))
    assert work == FloatWork(("nearest", "Tanh"), copies=2)
    placement = placed(int8, 64)
    low, high = float_interval_s(placement, "image", work, DPU)
    assert 0 < low < high
    assert float_interval_s(placement, "image", FloatWork(), DPU) == (0, 0)
    of_float = float_interval_s(placed(network, 64), "image", FloatWork(), DPU)
    assert of_float == pytest.approx((low, high))
    with_it, without = (predict(placement, DPU, float_work=each) for each in (work, FloatWork()))
    assert with_it.latency_s > without.latency_s
    assert with_it.host_interval_s[1] - without.host_interval_s[1] > high
