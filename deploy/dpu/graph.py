"""A network as the DPU sees it: a short list of operations, whatever spelling its ONNX file is written in."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from profiles.errors import ModelError

Kind = Literal[
    "conv",
    "grouped conv",
    "depthwise",
    "transposed",
    "add",
    "mul",
    "pool",
    "activation",
    "concat",
    "pad",
    "resize",
    "pixel shuffle",
    "quantise",
    "dequantise",
    "other",
]
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
    def position(self) -> int | None:
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
        weights_per_output = self.weight_bytes  # one byte each, and each is used once a pixel
        shape = self.in_shapes[0] if self.kind == "transposed" else self.out_shape
        return 2 * weights_per_output * _pixels(self.name, shape)

    @property
    def out_bytes(self) -> int:
        """Size of the result as int8."""
        return _pixels(self.name, self.out_shape) * (self.out_shape or (0,))[0]

    @property
    def in_bytes(self) -> int:
        """Size of the first input as int8."""
        shape = self.in_shapes[0] if self.in_shapes else None
        return _pixels(self.name, shape) * (shape or (0,))[0]


@dataclass(frozen=True)
class Network:
    """Operations in order; the names and shapes of the inputs; the names of the outputs."""

    operations: tuple[Operation, ...]
    inputs: Mapping[str, Shape]
    outputs: tuple[str, ...]
    quantised: bool

    def consumers(self, tensor: str) -> Iterator[Operation]:
        """The operations that read a tensor."""
        return (op for op in self.operations if tensor in op.inputs)


def _pixels(name: str, shape: Shape | None) -> int:
    if shape is None:
        raise ModelError(
            name,
            expected="a shape that can be computed from the input's",
            got="none",
            remedy="replace the node before it that hides the shape",
        )
    return shape[1] * shape[2]
