"""Small ONNX files built node by node, for the tests of the checker and the cost model."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper

from tests.quant.simplify.networks import parsed

Value = int | float | str | list[int]


class Sketch:
    """A network under construction; every method returns the name of its result."""

    def __init__(self, channels: int = 8) -> None:
        self.input = helper.make_tensor_value_info(
            "image", TensorProto.FLOAT, ["N", channels, "H", "W"]
        )
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, value: np.ndarray) -> str:
        name = f"constant{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(value, name))
        return name

    def node(self, op_type: str, *inputs: str, domain: Value = "", **attributes: Value) -> str:
        name = f"{op_type.lower()}{len(self.nodes)}"
        node = helper.make_node(op_type, list(inputs), [name], name=name, domain=str(domain))
        node.attribute.extend(
            helper.make_attribute(key, value) for key, value in attributes.items()
        )
        self.nodes.append(node)
        return name

    def weight(self, *shape: int) -> str:
        return self.constant(np.zeros(shape, np.float32))

    def conv(self, source: str, weight: tuple[int, ...] = (8, 8, 3, 3), **attributes: Value) -> str:
        padded: Mapping[str, Value] = {"pads": [weight[2] // 2, weight[3] // 2] * 2, **attributes}
        return self.node("Conv", source, self.weight(*weight), **padded)

    def model(self, *results: str) -> onnx.ModelProto:
        ends = [
            helper.make_tensor_value_info(r, TensorProto.FLOAT, ["N", "C", "H2", "W2"])
            for r in results
        ]
        graph = helper.make_graph(self.nodes, "sketch", [self.input], ends, self.constants)
        opsets = [helper.make_opsetid("", 17), helper.make_opsetid("com.microsoft", 1)]
        return helper.make_model(graph, opset_imports=opsets, ir_version=8)

    def save(self, path: Path, *results: str) -> Path:
        onnx.save_model(self.model(*results), path)
        return path


SAME = "Conv<pads=[1,1,1,1]>"
NUMBERS: dict[str, ArrayLike] = {
    "two": [1.0, 1.0, 2.0, 2.0],
    "three": [1.0, 1.0, 3.0, 3.0],
    "eight": [1.0, 1.0, 8.0, 8.0],
    "around": [0, 0, 2, 2, 0, 0, 2, 2],
}
MYSTERY = f"a = {SAME}(image, w) b = com.microsoft.Mystery(a) y = {SAME}(b, w)"
"""An operator that nobody knows, between two convolutions."""


def written(nodes: str, channels: int = 8, results: tuple[str, ...] = ("y",)) -> onnx.ModelProto:
    """Return a float network from `image`, in ONNX's text format.

    Args:
        nodes: they may read weights of zeros that are named by their shape, such as `w4x8x3x3`, or
            `w` for `w8x8x3x3`, and the factors and pads of NUMBERS.
        channels: the number of channels of the image.
        results: the names of the outputs.
    """
    constants = {**NUMBERS, "w": np.zeros((8, 8, 3, 3))}
    for name in re.findall(r"\bw[0-9x]+\b", nodes):
        constants[name] = np.zeros([int(size) for size in name[1:].split("x")])
    outputs = ", ".join(f"float[N,C,P,Q] {name}" for name in results)
    return parsed(nodes, f"float[N,{channels},H,W] image => {outputs}", constants=constants)


def float_convbeers(path: Path, blocks: int, features: int) -> Path:
    """Write ConvBEERS in float: head, residual blocks, body end, tail, global add."""
    wide = f"w{features}x{features}x3x3"
    body = " ".join(
        f"a{k} = {SAME}(s{k}, {wide}) r{k} = Relu(a{k}) b{k} = {SAME}(r{k}, {wide}) "
        f"s{k + 1} = Add(s{k}, b{k})"
        for k in range(blocks)
    )
    nodes = f"""
        s0 = {SAME}(image, w{features}x1x3x3) {body}
        end = {SAME}(s{blocks}, {wide}) deep = Add(s0, end)
        tail = {SAME}(deep, w1x{features}x3x3) y = Add(image, tail)
    """
    onnx.save_model(written(nodes, 1), path)
    return path


class IntegerSketch(Sketch):
    """A sketch whose nodes are onnxruntime's integer kernels."""

    def __init__(self, channels: int = 1, scale: float = 2.0**-7, zero: int = 0) -> None:
        super().__init__(channels)
        self.numbers = (
            self.constant(np.array(scale, np.float32)),
            self.constant(np.array(zero, np.int8)),
        )

    def quantized(self, source: str) -> str:
        return self.node("QuantizeLinear", source, *self.numbers)

    def qconv(
        self,
        source: str,
        weight: tuple[int, ...],
        weight_scale: float = 2.0**-7,
        bias: np.ndarray | None = None,
    ) -> str:
        pads = [weight[2] // 2, weight[3] // 2] * 2
        kernel = self.constant(np.ones(weight, np.int8))
        scale = self.constant(np.array(weight_scale, np.float32))
        zero = self.numbers[1]
        start = [] if bias is None else [self.constant(bias)]
        feeds = (source, *self.numbers, kernel, scale, zero, *self.numbers, *start)
        return self.node("QLinearConv", *feeds, pads=pads)

    def qadd(self, one: str, other: str) -> str:
        feeds = (one, *self.numbers, other, *self.numbers, *self.numbers)
        return self.node("QLinearAdd", *feeds, domain="com.microsoft")


def integer_convbeers(
    path: Path, blocks: int, features: int, weight_scale: float = 2.0**-7
) -> Path:
    """Write ConvBEERS in the host's integer encoding, which adds a correction to the image."""
    s = IntegerSketch()
    wide = (features, features, 3, 3)
    stream = head = s.qconv(s.quantized("image"), (features, 1, 3, 3), weight_scale)
    for _ in range(blocks):
        inner = s.node("Relu", s.qconv(stream, wide, weight_scale))
        stream = s.qadd(stream, s.qconv(inner, wide, weight_scale))
    deep = s.qadd(head, s.qconv(stream, wide, weight_scale))
    correction = s.node(
        "DequantizeLinear", s.qconv(deep, (1, features, 3, 3), weight_scale), *s.numbers
    )
    return s.save(path, s.node("Add", "image", correction))


def board_convbeers(path: Path, blocks: int, features: int) -> Path:
    """Write the core alone in the board's QDQ encoding, with weights and biases of int8."""
    s = QdqSketch(1)

    def conv(source: str, *weight: int) -> str:
        feeds = (s.stored(np.ones(shape, np.int8)) for shape in (weight, weight[:1]))
        return s.node("Conv", source, *feeds, pads=[1] * 4)

    wide = (features, features, 3, 3)
    stream = head = s.pair(conv(s.pair("image"), features, 1, 3, 3))
    for _ in range(blocks):
        inner = s.pair(s.node("Relu", conv(stream, *wide)))
        stream = s.pair(s.node("Add", stream, s.pair(conv(inner, *wide))))
    deep = s.pair(s.node("Add", head, s.pair(conv(stream, *wide))))
    return s.save(path, s.pair(conv(deep, 1, features, 3, 3)))


class QdqSketch(Sketch):
    """A sketch in QDQ encoding, where each tensor has its own scale: 2^-frac_bits."""

    def scale(
        self, frac_bits: float | list[float], zero: int = 0, kind: type = np.int8
    ) -> tuple[str, str]:
        scales = 2.0 ** -np.array(frac_bits, np.float64)
        return self.constant(scales.astype(np.float32)), self.constant(
            np.full(scales.shape, zero, kind)
        )

    def pair(
        self,
        source: str,
        frac_bits: float = 7,
        zero: int = 0,
        read: tuple[float, int] | None = None,
    ) -> str:
        """Quantise and dequantise a tensor.

        `read` holds the fractional bits and the zero point of a reader that differs.
        """
        numbers = self.scale(frac_bits, zero)
        read_numbers = numbers if read is None else self.scale(*read)
        return self.node(
            "DequantizeLinear", self.node("QuantizeLinear", source, *numbers), *read_numbers
        )

    def stored(self, value: np.ndarray, frac_bits: float | list[float] = 7) -> str:
        """Return a constant as float: integers are dequantised, float32 stays as it is."""
        name = self.constant(value)
        if value.dtype == np.float32:
            return name
        return self.node(
            "DequantizeLinear", name, *self.scale(frac_bits, 0, value.dtype.type), axis=0
        )

    def qdq_conv(
        self,
        source: str,
        channels: int = 4,
        weight: float | list[float] = 7,
        bias: float = 7,
        output: float = 7,
        bias_kind: type = np.int8,
        weight_kind: type = np.int8,
    ) -> str:
        kernel = self.stored(np.ones((4, channels, 3, 3), weight_kind), weight)
        start = self.stored(np.ones(4, bias_kind), bias)
        return self.pair(self.node("Conv", source, kernel, start, pads=[1] * 4), output)


def behind_qdq_conv(draw: Callable[[QdqSketch, str], str]) -> onnx.ModelProto:
    """Build a network with `draw` behind a convolution."""
    sketch = QdqSketch(4)
    return sketch.model(draw(sketch, sketch.qdq_conv(sketch.pair("image"))))
