"""ReLUs of an ONNX file in any spelling: quantisers have been seen to drop them without a word."""

import onnx
from onnx import numpy_helper

from quant.saturation import Rounded, rounded_tensors
from quant.untrusted import contradictions


def relu_count(model: onnx.ModelProto) -> int:
    """ReLUs in any spelling: Relu, the larger of a value and zero, a convolution whose 8 bits begin at zero.

    Raises:
        ModelError: nodes that contradict it.
    """
    with contradictions("model"):
        return _count(model)


def _count(model: onnx.ModelProto) -> int:
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    rounded = {tensor.name: tensor for tensor in rounded_tensors(model)}
    convolved = {name for node in model.graph.node if "Conv" in node.op_type for name in node.output}
    count = 0
    for node in model.graph.node:
        if node.op_type == "Max":
            count += _zero_is_the_floor(node, constants, rounded)
        else:
            count += node.op_type == "Relu" or _begins_at_zero(node, rounded, convolved)
    return count


def _zero_is_the_floor(
    node: onnx.NodeProto, constants: dict[str, onnx.TensorProto], rounded: dict[str, Rounded]
) -> bool:
    """Whether a Max cuts off what is below zero, which in 8 bits is the zero point."""
    value, floor = rounded.get(node.input[0]), constants.get(node.input[-1])
    zero = 0 if value is None else value.zero_point
    return floor is not None and bool((numpy_helper.to_array(floor) == zero).all())


def _begins_at_zero(node: onnx.NodeProto, rounded: dict[str, Rounded], convolved: set[str]) -> bool:
    """Whether a convolution's result is rounded to numbers of which none is below zero."""
    value = rounded.get(node.output[0])
    if value is None or not (node.op_type == "QLinearConv" or node.input[0] in convolved):
        return False
    return bool((value.zero_point == value.lowest).all())
