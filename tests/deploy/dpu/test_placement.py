from collections.abc import Callable
from pathlib import Path

import pytest

from beers_deploy.dpu.checker.placement import FLOAT_NOTE
from beers_deploy.dpu.checker.remarks import remarks_on
from tests.deploy.dpu.draws import DPU, placed, placed_file
from tests.deploy.dpu.graphs import (
    SAME,
    IntegerSketch,
    board_convbeers,
    float_convbeers,
    integer_convbeers,
    written,
)


@pytest.mark.parametrize(
    ("make", "host"),
    [
        (float_convbeers, ["Add"]),
        (integer_convbeers, ["QuantizeLinear", "DequantizeLinear", "Add"]),
        (board_convbeers, ["QuantizeLinear", "DequantizeLinear"]),
    ],
)
def test_the_core_of_each_encoding_is_one_subgraph_between_host_parts(
    tmp_path: Path, make: Callable[..., Path], host: list[str]
) -> None:
    placement = placed_file(make(tmp_path / "n.onnx", 2, 8), 53)
    assert [node.op.op_type for node in placement.nodes if node.device == "host"] == host
    assert (placement.dpu_subgraphs, placement.failed) == (1, ())
    assert placement.note == (FLOAT_NOTE if make is float_convbeers else "")
    cuts = [(cut.size_bytes, cut.onto_dpu) for cut in placement.cuts]
    assert cuts == [(53 * 53, True), (53 * 53, False)]
    remarks = remarks_on(placement, DPU, 53)
    assert placement.cuts[1].tensor in remarks["fix2float"]
    assert "subgraphs" not in remarks


def test_a_branch_past_the_cpu_does_not_join_the_two_subgraphs() -> None:
    """The skip ends in the second subgraph. If both were one, it would wait for itself."""
    nodes = f"a = {SAME}(image, w) b = Sigmoid(a) c = {SAME}(b, w) y = Add(a, c)"
    assert placed(written(nodes), 21).dpu_subgraphs == 2


def test_scaling_in_front_is_the_hosts_but_other_operators_are_refused() -> None:
    placement = placed(written(f"a = Div(image, w1) y = {SAME}(a, w)"), 21)
    assert [node.part for node in placement.nodes] == ["host-front", "dpu-core"]
    placement = placed(written(f"a = Softmax<axis=1>(image) y = {SAME}(a, w)"), 21)
    assert [node.device for node in placement.nodes] == ["CPU", "DPU"]


def test_pixels_are_moved_to_channels_and_back_by_the_host_at_the_ends_alone() -> None:
    nodes = f"""
        a = SpaceToDepth<blocksize=2>(image) b = {SAME}(a, w) c = DepthToSpace<blocksize=2>(b)
        d = {SAME}(c, w8x2x3x3) y = DepthToSpace<blocksize=2>(d)
    """
    placement = placed(written(nodes, 2), 20)
    assert [node.part for node in placement.nodes] == ["host-front", *["dpu-core"] * 3, "host-back"]
    assert placement.failed == ()
    assert remarks_on(placement, DPU, 20)["shuffles"].startswith(placement.nodes[2].op.name)


def test_the_host_computes_the_end_of_a_classifier() -> None:
    nodes = f"a = {SAME}(image, w) b = GlobalAveragePool(a) c = Flatten(b) d = Gemm(c, w8x3)"
    model = written(f"{nodes} y = Softmax<axis=1>(d)")
    del model.graph.output[0].type.tensor_type.shape.dim[2:]
    kinds = [(node.op.op_type, node.part) for node in placed(model, 21).nodes]
    assert kinds[:3] == [(kind, "dpu-core") for kind in ("Conv", "GlobalAveragePool", "Conv")]
    assert kinds[3:] == [("Softmax", "host-back"), ("Flatten", "host-back")]


def test_a_relu_behind_the_last_convolution_stays_on_the_dpu() -> None:
    sketch = IntegerSketch()
    last = sketch.node("Relu", sketch.qconv(sketch.quantized("image"), (4, 1, 3, 3)))
    model = sketch.model(sketch.node("DequantizeLinear", last, *sketch.numbers))
    devices = [node.device for node in placed(model, 21).nodes]
    assert devices == ["host", "DPU", "DPU", "host"]


def test_maps_stream_from_the_tile_on_that_the_remark_names(tmp_path: Path) -> None:
    path = integer_convbeers(tmp_path / "i.onnx", 1, 32)
    text = remarks_on(placed_file(path, 640), DPU, 640)["streaming"]
    # Maps of 32 channels at 181 x 181 are the largest below 1 MiB.
    assert "tiles of 181 px and less" in text
    assert "streaming" not in remarks_on(placed_file(path, 181), DPU, 181)
    assert "streaming" in remarks_on(placed_file(path, 182), DPU, 182)
