"""A network as the DPU sees it: a short list of operations, whatever encoding its ONNX file is written in."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import onnx
from onnx import TensorProto, helper, shape_inference

from beers_deploy.profiles.errors import ModelError

Kind = Literal[
    "conv", "grouped conv", "depthwise", "transposed", "add", "mul", "pool", "activation", "concat", "pad", "resize",
    "pixel shuffle", "argmax", "quantise", "dequantise", "other",
]  # fmt: skip
Shape = tuple[int, int, int]
"""Channels, height, width."""

CONVOLUTIONS = frozenset({"conv", "grouped conv", "depthwise", "transposed"})


@dataclass(frozen=True)
class Scale:
    """How a quantised tensor is to be read: value = scale * (q - zero_point)."""

    scales: tuple[float, ...]
    zero_points: tuple[int, ...]
    integer_type: str

    @property
    def symmetric(self) -> bool:
        """Whether zero stands for zero: int8 around 0, or the same numbers as uint8 around 128."""
        middle = 128 if self.integer_type == "uint8" else 0
        return self.integer_type in ("int8", "uint8", "int32") and set(self.zero_points) == {middle}

    @property
    def frac_bits(self) -> int | None:
        """The p of a scale 2^-p, None for any other scale."""
        if len(self.scales) != 1:
            return None
        fraction, exponent = math.frexp(self.scales[0])
        return 1 - exponent if fraction == 0.5 else None


@dataclass(frozen=True)
class Window:
    """What a convolution or a pool reads for one output pixel; pairs are (height, width)."""

    kernel: tuple[int, int] = (1, 1)
    stride: tuple[int, int] = (1, 1)
    pads: tuple[int, int, int, int] = (0, 0, 0, 0)  # top, left, bottom, right
    dilation: tuple[int, int] = (1, 1)
    output_padding: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Operation:
    """One node: what it computes, on which activations, with which numbers.

    `inputs` and `outputs` name activations; `integer` says that the file already computes it on integers.
    """

    name: str
    op_type: str
    kind: Kind
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    in_shapes: tuple[Shape | None, ...] = ()
    out_shape: Shape | None = None
    window: Window = Window()
    channels: tuple[int, int] = (0, 0)  # input, output
    weight_bytes: int = 0
    constant_shape: tuple[int, ...] | None = None
    attributes: Mapping[str, object] = field(default_factory=dict)
    follows: Kind | None = None  # what computes the first input
    integer: bool = False
    scales: Mapping[str, Scale] = field(default_factory=dict)  # of "input 0", ..., "weight", "bias", "output"
    disputed: Mapping[str, tuple[Scale, ...]] = field(default_factory=dict)  # where the file gives several
    constants: Mapping[str, np.ndarray | None] = field(default_factory=dict, compare=False)  # None: computed

    @property
    def output(self) -> str:
        """The first result."""
        return self.outputs[0]

    @property
    def operations(self) -> int:
        """int8 operations for one image: 2 kh kw ic oc h w, per group; 0 where no product is summed."""
        if self.kind not in CONVOLUTIONS:
            return 0
        shape = self.in_shapes[0] if self.kind == "transposed" else self.out_shape
        return 2 * self.weight_bytes * _pixels(self.name, shape)  # a weight has one byte, and is used once a pixel

    @property
    def out_bytes(self) -> int:
        """Size of the result as int8."""
        return _pixels(self.name, self.out_shape) * (self.out_shape or (0,))[0]


@dataclass(frozen=True)
class Network:
    """Operations in order; the names and shapes of the inputs; the names of the outputs."""

    operations: tuple[Operation, ...]
    inputs: Mapping[str, Shape]
    outputs: tuple[str, ...]
    quantised: bool


def _pixels(name: str, shape: Shape | None) -> int:
    if shape is None:
        remedy = "replace the node before it that hides the shape"
        raise ModelError(name, expected="a shape that can be computed from the input's", got="none", remedy=remedy)
    return shape[1] * shape[2]


def out_shape(
    node: onnx.NodeProto,
    kind: Kind,
    shapes: Sequence[Shape | None],
    window: Window,
    channels: int,
    constants: dict[str, TensorProto],
) -> Shape | None:
    """Shape (C, H, W) of a node's first result; None where it cannot be known.

    Args:
        node: the node.
        kind: what it computes.
        shapes: of its activation inputs.
        window: of a convolution or pool.
        channels: output channels of a convolution.
        constants: the file's constants, for operators that read sizes from them.
    """
    known = [shape for shape in shapes if shape is not None]
    if not known or len(known) != len(shapes):
        return None
    first = known[0]
    if kind in ("conv", "grouped conv", "depthwise"):
        return _slide(first, window, channels)
    if kind == "transposed":
        return _grow(first, window, channels)
    if kind == "pool":
        up = any(a.name == "ceil_mode" and a.i for a in node.attribute)
        return (first[0], 1, 1) if "Global" in node.op_type else _slide(first, window, first[0], up)
    if node.op_type in ("QLinearConcat", "Concat") and len(known) > 1:
        return (sum(shape[0] for shape in known), first[1], first[2])
    if kind in ("add", "mul") or node.op_type == "Where":
        return (max(s[0] for s in known), max(s[1] for s in known), max(s[2] for s in known))
    if kind in ("activation", "quantise", "dequantise"):
        return first
    return _infer(node, known, constants)


def padding(node_attributes: dict[str, object], shape: Shape | None, window: Window) -> Window:
    """The window with the pads that `auto_pad` asks for (ONNX, operator Conv)."""
    auto = node_attributes.get("auto_pad", b"NOTSET")
    if auto not in (b"SAME_UPPER", b"SAME_LOWER") or shape is None:
        return window
    total = [
        max((math.ceil(size / s) - 1) * s + (k - 1) * d + 1 - size, 0)
        for size, s, k, d in zip(shape[1:], window.stride, window.kernel, window.dilation, strict=True)
    ]
    small, large = [t // 2 for t in total], [t - t // 2 for t in total]
    begin, end = (small, large) if auto == b"SAME_UPPER" else (large, small)
    return Window(window.kernel, window.stride, (begin[0], begin[1], end[0], end[1]), window.dilation)


def _slide(shape: Shape, window: Window, channels: int, up: bool = False) -> Shape | None:
    """floor((size + pads - dilation (kernel - 1) - 1) / stride) + 1, or rounded up in a pool's ceil mode."""
    sizes = []
    for axis in (0, 1):
        padded = shape[1 + axis] + window.pads[axis] + window.pads[axis + 2]
        room = padded - window.dilation[axis] * (window.kernel[axis] - 1) - 1
        sizes.append((-(-room // window.stride[axis]) if up else room // window.stride[axis]) + 1)
    return (channels, sizes[0], sizes[1]) if min(sizes) > 0 else None


def _grow(shape: Shape, window: Window, channels: int) -> Shape | None:
    """Size = stride (size - 1) + output padding + dilation (kernel - 1) + 1 - pads."""
    height, width = (
        window.stride[axis] * (shape[1 + axis] - 1)
        + window.output_padding[axis]
        + window.dilation[axis] * (window.kernel[axis] - 1)
        + 1
        - window.pads[axis]
        - window.pads[axis + 2]
        for axis in (0, 1)
    )
    return (channels, height, width) if min(height, width) > 0 else None


def _infer(node: onnx.NodeProto, known: list[Shape], constants: dict[str, TensorProto]) -> Shape | None:
    """What onnx knows of one standard operator."""
    shapes = iter(known)
    types, data = {}, {}
    for name in filter(None, node.input):
        if name in constants:
            data[name] = constants[name]
            types[name] = helper.make_tensor_type_proto(data[name].data_type, list(data[name].dims))
        elif (shape := next(shapes, None)) is not None:
            types[name] = helper.make_tensor_type_proto(TensorProto.FLOAT, [1, *shape])
        else:  # a scale or a size that is no constant of the file
            return None
    try:
        schema = onnx.defs.get_schema(node.op_type, 17, node.domain)
        opsets = [helper.make_opsetid("", 17)]
        found = shape_inference.infer_node_outputs(schema, node, types, data, opset_imports=opsets)
        sizes = [d.dim_value for d in found[node.output[0]].tensor_type.shape.dim]
    except Exception:  # noqa: BLE001 - an unknown operator and whatever its own inference raises mean: unknown
        return None
    return (sizes[1], sizes[2], sizes[3]) if len(sizes) == 4 and min(sizes) > 0 else None
