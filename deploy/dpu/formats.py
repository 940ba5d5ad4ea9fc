"""The scales and zero points that a node names: for which tensor, and how they are to be read."""

from collections.abc import Iterator, Mapping

import onnx
from onnx import TensorProto, numpy_helper

from deploy.dpu.graph import Scale

FORMATS: dict[str, dict[int, tuple[int, int]]] = {
    "QLinearConv": {0: (1, 2), 3: (4, 5), -1: (6, 7)},
    "QLinearAdd": {0: (1, 2), 3: (4, 5), -1: (6, 7)},
    "QLinearMul": {0: (1, 2), 3: (4, 5), -1: (6, 7)},
    "QLinearAveragePool": {0: (1, 2), -1: (3, 4)},
    "QLinearGlobalAveragePool": {0: (1, 2), -1: (3, 4)},
    "QLinearLeakyRelu": {0: (1, 2), -1: (3, 4)},
    "QuantizeLinear": {-1: (1, 2)},
    "DequantizeLinear": {0: (1, 2)},
}
"""Where an operator names the scale and zero point of input i, or (-1) of its result."""

NO_POINT = "uint8"
"""ONNX's type of what QuantizeLinear writes where no zero point is given."""


def stated(node: onnx.NodeProto, constants: Mapping[str, TensorProto]) -> Iterator[tuple[str, Scale]]:
    """The tensors whose format a node names, constants among them, each with that format."""
    places = FORMATS.get(node.op_type, {})
    if node.op_type == "QLinearConcat":
        places = {-1: (0, 1)} | {i: (i + 1, i + 2) for i in range(2, len(node.input), 3)}
    for place, (scale, zero_point) in places.items():
        name = node.output[0] if place == -1 else node.input[place]
        zero = node.input[zero_point] if len(node.input) > zero_point else ""
        kind = str(numpy_helper.to_array(constants[name]).dtype) if name in constants else NO_POINT
        yield name, _scale(constants.get(node.input[scale]), constants.get(zero), kind)


def _scale(values: TensorProto | None, zeros: TensorProto | None, kind: str) -> Scale:
    scales = tuple(map(float, numpy_helper.to_array(values).ravel())) if values is not None else ()
    if zeros is None:
        return Scale(scales, (0,), kind)
    array = numpy_helper.to_array(zeros)
    return Scale(scales, tuple(map(int, array.ravel())), str(array.dtype))
