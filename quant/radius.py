"""The receptive radius of an ONNX network, from its graph: how much context a tile needs."""

import onnx
from onnx import numpy_helper

from profiles.errors import ModelError

CONVOLUTIONS = {"Conv": 1, "QLinearConv": 3}
"""Operator and the index of its weights among the inputs."""

POINTWISE = {
    "Abs", "Add", "Cast", "Clip", "DequantizeLinear", "Div", "Identity", "LessOrEqual", "Max", "Min", "Mul",
    "QLinearAdd", "QuantizeLinear", "Relu", "Round", "Sub", "Where",
}  # fmt: skip
OVER_CHANNELS = {"Concat", "Split"}
"""Point-wise where they work along the channels."""


def receptive_radius_px(model: onnx.ModelProto) -> int:
    """The farthest input pixel that an output pixel depends on, in pixels.

    Raises:
        ModelError: an operator that is neither point-wise nor a same-size convolution of stride 1.
    """
    weights = {t.name: t for t in model.graph.initializer}
    reach = {tensor.name: 0 for tensor in model.graph.input}
    for node in model.graph.node:
        radius = max((reach.get(name, 0) for name in node.input), default=0)
        if node.op_type in CONVOLUTIONS:
            radius += _kernel_radius(node, weights)
        elif node.op_type not in POINTWISE and not (node.op_type in OVER_CHANNELS and _axis(node) == 1):
            raise _refuse(node, "operators that keep a pixel's neighbourhood local")
        reach.update(dict.fromkeys(node.output, radius))
    return reach[model.graph.output[0].name]


def _axis(node: onnx.NodeProto) -> int:
    return next((int(a.i) for a in node.attribute if a.name == "axis"), 0)


def _kernel_radius(node: onnx.NodeProto, weights: dict[str, onnx.TensorProto]) -> int:
    name = node.input[CONVOLUTIONS[node.op_type]]
    name = name if name in weights else name.removesuffix(".float")  # behind a DequantizeLinear in a board file
    given = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
    if name not in weights or set(given.get("strides", [1])) != {1}:
        raise _refuse(node, "convolutions of stride 1 with constant weights")
    kernel = numpy_helper.to_array(weights[name]).shape[2:]
    return int(max(k // 2 * d for k, d in zip(kernel, given.get("dilations", [1, 1]), strict=True)))


def _refuse(node: onnx.NodeProto, expected: str) -> ModelError:
    return ModelError(
        "tiled model",
        expected=expected,
        got=f"{node.op_type} {node.name}",
        remedy="run it on the whole image instead",
    )
