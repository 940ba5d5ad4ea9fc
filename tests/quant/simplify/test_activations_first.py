"""Tests that activations move past operators that only move values, into convolutions."""

from typing import Any

import numpy as np
import onnx
import pytest

from beers_deploy.quant.onnx.image_input import image_info
from beers_deploy.quant.onnx_file import GraphWriter, make_model
from beers_deploy.quant.simplify.activations_first import activations_first
from tests.quant.quick import assert_same

CHANNELS = 8
IMAGE = np.random.default_rng(0).normal(0, 4, (2, 1, 10, 14)).astype(np.float32)


def moving(writer: GraphWriter, kind: str, source: str, beside: str) -> str:
    """Write an operation that moves values of `source`, and return its result."""
    result = f"{source}.{kind}"
    if kind == "Concat":
        return writer.node(kind, result, [source, beside], result, axis=1)
    if kind == "DepthToSpace":
        return writer.node(kind, result, [source], result, blocksize=2)
    if kind in ("MaxPool", "AveragePool"):
        window: dict[str, Any] = {"kernel_shape": [3, 3], "pads": [1, 1, 1, 1], "strides": [2, 1]}
        return writer.node(kind, result, [source], result, **window)
    scales = writer.constant("scales", np.array([1, 1, 2, 2], np.float32))
    none = writer.constant("none", np.array([], np.float32))
    feeds = [source, none, scales]
    return writer.node("Resize", result, feeds, result, mode=kind)


def network(kinds: list[str], activation: str, read_twice: bool = False) -> onnx.ModelProto:
    """Build two convolutions, operations that move values, an activation and a last convolution."""
    generator = np.random.default_rng(1)
    writer = GraphWriter()

    def conv(name: str, source: str, shape: tuple[int, ...]) -> str:
        weight = writer.constant(f"{name}.w", generator.normal(0, 1, shape).astype(np.float32))
        return writer.node("Conv", name, [source, weight], name)

    last, beside = (conv(name, "image", (CHANNELS, 1, 1, 1)) for name in ("a", "b"))
    first = last
    channels = CHANNELS
    for kind in kinds:
        last = moving(writer, kind, last, beside)
        channels = {"Concat": 2 * channels, "DepthToSpace": channels // 4}.get(kind, channels)
    feeds = [last]
    if activation == "Clip":
        ends = {"zero": 0.0, "six": 6.0}
        feeds += [
            writer.constant(name, np.array(value, np.float32)) for name, value in ends.items()
        ]
    last = writer.node(activation, "active", feeds, "active")
    writer.node("Identity", "restored", [conv("c", last, (1, channels, 1, 1))], "end")
    results = ["restored", *([first] if read_twice else [])]
    infos = [
        onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["N", None, None, None])
        for name in results
    ]
    return make_model(writer.graph("g", [image_info("image", 1, None)], infos), {})


@pytest.mark.parametrize("activation", ["Relu", "LeakyRelu", "Clip", "HardSwish"])
@pytest.mark.parametrize(
    "kinds", [["Concat"], ["DepthToSpace"], ["nearest"], ["MaxPool"], ["Concat", "nearest"]]
)
def test_an_activation_reaches_its_convolutions(kinds: list[str], activation: str) -> None:
    model = network(kinds, activation)
    before = model.SerializeToString()
    moved = activations_first(model)
    assert model.SerializeToString() == before
    assert_same(model, moved, IMAGE)
    writers = {node.output[0]: node.op_type for node in moved.graph.node}
    reads = [writers[n.input[0]] for n in moved.graph.node if n.op_type == activation]
    if activation == "HardSwish" and "MaxPool" in kinds:
        assert reads == ["MaxPool"]
        assert moved is model
    else:
        assert set(reads) == {"Conv"}


@pytest.mark.parametrize("kind", ["AveragePool", "linear"])
def test_an_activation_stays_behind_operators_that_compute_means(kind: str) -> None:
    model = network([kind], "Relu")
    assert activations_first(model) is model


def test_an_activation_stays_where_its_convolution_is_read_elsewhere() -> None:
    model = network(["DepthToSpace"], "Relu", read_twice=True)
    assert activations_first(model) is model
