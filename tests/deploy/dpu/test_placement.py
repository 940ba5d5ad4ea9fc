from collections.abc import Callable
from pathlib import Path

import pytest

from beers_deploy.dpu.checker.placement import FLOAT_NOTE
from beers_deploy.dpu.checker.remarks import remarks_on
from tests.deploy.dpu.draws import DPU, placed, placed_file
from tests.deploy.dpu.graphs import (
    IntegerSketch,
    Sketch,
    board_convbeers,
    float_convbeers,
    integer_convbeers,
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
    sketch = Sketch(8)
    first = sketch.conv("image")
    end = sketch.node("Add", first, sketch.conv(sketch.node("Sigmoid", first)))
    assert placed(sketch.model(end), 21).dpu_subgraphs == 2


def test_scaling_in_front_is_the_hosts_but_other_operators_are_refused() -> None:
    sketch = Sketch(8)
    scaled = sketch.node("Div", "image", sketch.weight(1))
    placement = placed(sketch.model(sketch.conv(scaled)), 21)
    assert [node.part for node in placement.nodes] == ["host-front", "dpu-core"]

    sketch = Sketch(8)
    apart = sketch.node("Softmax", "image", axis=1)
    placement = placed(sketch.model(sketch.conv(apart)), 21)
    assert [node.device for node in placement.nodes] == ["CPU", "DPU"]


def test_pixels_are_moved_to_channels_and_back_by_the_host_at_the_ends_alone() -> None:
    sketch = Sketch(2)
    apart = sketch.conv(sketch.node("SpaceToDepth", "image", blocksize=2))
    inside = sketch.conv(sketch.node("DepthToSpace", apart, blocksize=2), (8, 2, 3, 3))
    placement = placed(sketch.model(sketch.node("DepthToSpace", inside, blocksize=2)), 20)
    assert [node.part for node in placement.nodes] == ["host-front", *["dpu-core"] * 3, "host-back"]
    assert placement.failed == ()
    assert remarks_on(placement, DPU, 20)["shuffles"].startswith(placement.nodes[2].op.name)


def test_the_host_computes_the_end_of_a_classifier() -> None:
    sketch = Sketch(8)
    pooled = sketch.node("GlobalAveragePool", sketch.conv("image"))
    scores = sketch.node("Gemm", sketch.node("Flatten", pooled), sketch.weight(8, 3))
    model = sketch.model(sketch.node("Softmax", scores, axis=1))
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
