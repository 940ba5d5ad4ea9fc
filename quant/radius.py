"""The receptive radius of an ONNX network, from its graph: how much context a tile needs.

Only graphs that compute the same thing at every pixel have one. Refused is what does not: ranges measured on the
image (dynamic quantisation), means over it (global pooling, instance normalisation), resampling, and constants that
are not the same at every pixel.
"""

from typing import Any

import onnx

from profiles.errors import ModelError
from quant.untrusted import contradictions

CONVOLUTIONS = {"Conv": 1, "QLinearConv": 3}
"""Operator and the index of its weights among the inputs."""

POOLS = {"AveragePool", "MaxPool"}
POINTWISE = {
    "Abs", "Add", "Cast", "Clip", "Div", "Elu", "Exp", "Greater", "HardSigmoid", "HardSwish", "Identity",
    "LeakyRelu", "Less", "LessOrEqual", "Max", "Min", "Mul", "Neg", "PRelu", "Pow", "QLinearAdd", "Relu", "Round",
    "Sigmoid", "Sqrt", "Sub", "Tanh", "Where",
}  # fmt: skip
PER_CHANNEL = {"BatchNormalization", "DequantizeLinear", "QuantizeLinear"}
"""Point-wise, with vectors of one number a channel."""
OVER_CHANNELS = {"Concat", "Split"}
"""Point-wise where they work along the channels."""


def receptive_radius_px(model: onnx.ModelProto) -> int:
    """The farthest input pixel that an output pixel depends on, in pixels.

    Raises:
        ModelError: an operator that is no same-size convolution or pool of stride 1 and not point-wise.
    """
    with contradictions("tiled model"):
        return _radius_px(model)


def _radius_px(model: onnx.ModelProto) -> int:
    constants = {t.name: tuple(t.dims) for t in model.graph.initializer}
    reach = {tensor.name: 0 for tensor in model.graph.input if tensor.name not in constants}
    for node in model.graph.node:
        radii = [reach[name] for name in node.input if name in reach]
        if radii:
            reach.update(dict.fromkeys(node.output, max(radii) + _node_radius(node, constants)))
        else:
            constants.update(dict.fromkeys(node.output, _constant_shape(node, constants)))
    return reach.get(model.graph.output[0].name, 0)


def _constant_shape(node: onnx.NodeProto, constants: dict[str, tuple[int, ...]]) -> tuple[int, ...]:
    """The shape of what is made of constants alone, such as weights dequantised in a board file."""
    if node.op_type == "Constant":
        return next((tuple(a.t.dims) for a in node.attribute if a.name == "value"), ())
    _require(node, node.op_type in PER_CHANNEL | {"Cast", "Identity"})
    return constants[node.input[0]]


def _node_radius(node: onnx.NodeProto, constants: dict[str, tuple[int, ...]]) -> int:
    """What one operator adds to the radius."""
    given = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
    if node.op_type in CONVOLUTIONS:
        weights = constants.get(node.input[CONVOLUTIONS[node.op_type]], ())
        _require(node, len(weights) == 4)
        return _window_radius(node, given, weights[2:])
    if node.op_type in POOLS:
        _require(node, len(node.output) == 1)  # MaxPool's indices count from the corner of the window
        return _window_radius(node, given, given["kernel_shape"])
    if node.op_type in OVER_CHANNELS:
        _require(node, given.get("axis", 0) == 1)
    elif node.op_type in PER_CHANNEL:
        _require(node, given.get("axis", 1) == 1)
    else:
        _require(node, node.op_type in POINTWISE)
        _require(node, all(set(constants.get(name, ())[-2:]) <= {1} for name in node.input))
    return 0


def _window_radius(node: onnx.NodeProto, given: dict[str, Any], kernel: tuple[int, ...]) -> int:
    """The wider side of a window that keeps the image's size."""
    extents = [(k - 1) * d for k, d in zip(kernel, given.get("dilations", [1, 1]), strict=True)]
    _require(node, set(given.get("strides", [1])) == {1})
    if given.get("auto_pad", b"NOTSET") in (b"SAME_UPPER", b"SAME_LOWER"):
        return int(max((extent + 1) // 2 for extent in extents))
    pads = given.get("pads", [0, 0, 0, 0])
    _require(node, [pads[0] + pads[2], pads[1] + pads[3]] == extents)
    return int(max(pads))


def _require(node: onnx.NodeProto, sound: bool) -> None:
    if not sound:
        raise ModelError(
            "tiled model",
            expected="operators that do the same at every pixel, from near pixels alone",
            got=f"{node.op_type} {node.name}".strip(),
            remedy="run it on the whole image instead",
        )
