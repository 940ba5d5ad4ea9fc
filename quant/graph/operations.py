"""Define the short list of operations that a DPU computes, on which quantisation works: a network
is a tuple of them.

Every operation reads and writes tensors (N, C, H, W) by their names, and each tensor is written
once.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Protocol, runtime_checkable

import numpy as np

from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.onnx.window import Sides, Window

IMAGE = "image"
CORRECTION = "correction"
"""The names of the input of a network and of the output of its last operation."""

LEAKY_SLOPE = 26 / 256
"""The only slope of LeakyReLU that a DPU computes."""
SIX = 6
"""The value at which ReLU6 clips."""
SIXTH = 2731 / 2**14
"""The DPU's fixed-point value of 1/6 in HardSigmoid (UG1414)."""


class Activation(StrEnum):
    """An activation function that a DPU applies to the result of an operation; values are ONNX's
    names.
    """

    none = ""
    relu = "Relu"
    relu6 = "Clip"
    leaky_relu = "LeakyRelu"
    hard_sigmoid = "HardSigmoid"
    hard_swish = "HardSwish"

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Apply the activation to values of any shape, as the DPU computes it, in their
        own type.
        """
        return _FUNCTIONS[self](values)

    @property
    def homogeneous(self) -> bool:
        """True if f(k x) = k f(x) for each k above 0, so that factors of channels pass through.

        They also pass through ReLU6 if its limit of 6 is scaled by the same factor, which
        `Conv.ceiling` allows.
        """
        return self in (Activation.none, Activation.relu, Activation.leaky_relu)


def _hard_sigmoid(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(values + 3, 0, 6) * values.dtype.type(SIXTH))


_FUNCTIONS: Mapping[Activation, Callable[[np.ndarray], np.ndarray]] = {
    Activation.none: lambda values: values,
    Activation.relu: lambda values: np.maximum(values, 0),
    Activation.relu6: lambda values: np.clip(values, 0, 6),
    Activation.leaky_relu: lambda values: np.where(
        values < 0, values * values.dtype.type(LEAKY_SLOPE), values
    ),
    Activation.hard_sigmoid: _hard_sigmoid,
    Activation.hard_swish: lambda values: values * _hard_sigmoid(values),
}


class Op(Protocol):
    """The properties that every operation of a graph has."""

    @property
    def name(self) -> str:
        """The unique name of the operation."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """The names of the tensors that the operation reads."""

    @property
    def output(self) -> str:
        """The name of the tensor that the operation writes."""


@runtime_checkable
class HasWeight(Op, Protocol):
    """A convolution, either a `Conv` with float weights or an `IntConv` of the integer core."""

    @property
    def weight(self) -> np.ndarray:
        """The weights, (O, I / groups, kh, kw)."""

    @property
    def groups(self) -> int:
        """The number of groups: 1, or the number of channels of a depthwise convolution."""


Graph = tuple[Op, ...]


def same(weight: np.ndarray) -> Window:
    """Return the window of stride 1 with which a convolution's result has the size of its input.

    Args:
        weight: (O, I, kh, kw) with odd kh and kw, which are all that counts.
    """
    rows = weight.shape[2] // 2
    columns = weight.shape[3] // 2
    return Window(pads=(rows, columns, rows, columns))


@dataclass(frozen=True)
class OneInput:
    """Base class of the operations that read one tensor.

    Attributes:
        name: the unique name of the operation.
        input: the name of the tensor that it reads.
        output: the name of the tensor that it writes.
    """

    name: str
    input: str
    output: str

    @property
    def inputs(self) -> tuple[str, ...]:
        """The name of the one tensor that the operation reads, as a tuple."""
        return (self.input,)


@dataclass(frozen=True)
class Conv(OneInput):
    """A convolution in float with zero padding, and the activation behind it.

    Attributes:
        weight: (O, I / groups, kh, kw) float32, with O the channels that it writes, also if
            transposed.
        bias: (O,) float32.
        activation: the activation of the result.
        window: strides, pads and dilations. If transposed, it has ONNX's meaning: the strides
            enlarge, and the pads crop.
        groups: 1, or the number of channels of a depthwise convolution.
        transposed: True for a transposed convolution.
        ceiling: (O,) the upper limits of a ReLU6 whose channels were scaled; None for 6.
        scalable: False if its results already use int8 as they should, so that equalisation must
            not scale them.
    """

    weight: np.ndarray
    bias: np.ndarray
    activation: Activation = Activation.none
    window: Window = field(default_factory=Window)
    groups: int = 1
    transposed: bool = False
    # (O,) where ReLU6 clips each channel once they are scaled; None at 6.
    ceiling: np.ndarray | None = None
    scalable: bool = True

    @property
    def ceilings(self) -> np.ndarray:
        """The value (O,) at which ReLU6 clips each channel: `ceiling`, or 6 for all."""
        return np.full(len(self.bias), float(SIX)) if self.ceiling is None else self.ceiling


@dataclass(frozen=True)
class SeveralInputs:
    """Base class of the operations that read several tensors.

    Attributes:
        name: the unique name of the operation.
        inputs: the names of the tensors that it reads.
        output: the name of the tensor that it writes.
    """

    name: str
    inputs: tuple[str, ...]
    output: str


@dataclass(frozen=True)
class Add(SeveralInputs):
    """An element-wise sum of two tensors.

    Attributes:
        activation: the activation of the sum.
    """

    activation: Activation = Activation.none


class Mul(SeveralInputs):
    """An element-wise product of two tensors of one size; one of them may have a single pixel per
    channel.
    """


class Concat(SeveralInputs):
    """A concatenation of tensors along the channels; they share a scale."""


@dataclass(frozen=True)
class MaxPool(OneInput):
    """The largest value of each window of a map; padding never counts.

    Attributes:
        kernel: rows and columns of a window.
        window: strides, pads and dilations.
    """

    kernel: Sides
    window: Window = field(default_factory=Window)


@dataclass(frozen=True)
class AveragePool(OneInput):
    """The mean of each window of a map, with padding counted as zeros.

    Attributes:
        kernel: rows and columns of a window; None for the mean of the whole map (global pooling).
        window: strides, pads and dilations.
    """

    kernel: Sides | None
    window: Window = field(default_factory=Window)


@dataclass(frozen=True)
class Resize(OneInput):
    """An enlargement of the rows and columns of a map.

    Attributes:
        factor: the factor of rows and columns.
        bilinear: True interpolates bilinearly with half-pixel centres, False repeats pixels.
    """

    factor: int
    bilinear: bool = False


@dataclass(frozen=True)
class Shuffle(OneInput):
    """A pixel shuffle: each group of block^2 channels becomes block x block pixels of one channel.

    Attributes:
        block: the number of rows and of columns of a block.
        up: False for the inverse, the pixel unshuffle.
        columns_first: True for torch's order of the channels (ONNX's CRD). False for ONNX's default
            (DCR), which its SpaceToDepth has too.
    """

    block: int
    up: bool = True
    columns_first: bool = True

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Apply the shuffle to values (N, C, H, W) of any type, and return the moved values."""
        count, channels, height, width = values.shape
        r = self.block
        # ONNX's DCR has the block's place before the channel, CRD (torch's order) behind it.
        if self.up:
            inner = channels // r**2
            parts = (inner, r, r) if self.columns_first else (r, r, inner)
            blocks = values.reshape(count, *parts, height, width)
            order = (0, 1, 4, 2, 5, 3) if self.columns_first else (0, 3, 4, 1, 5, 2)
            return blocks.transpose(order).reshape(count, inner, height * r, width * r)
        blocks = values.reshape(count, channels, height // r, r, width // r, r)
        order = (0, 1, 3, 5, 2, 4) if self.columns_first else (0, 3, 5, 1, 2, 4)
        return blocks.transpose(order).reshape(count, channels * r**2, height // r, width // r)

    @property
    def inverse(self) -> "Shuffle":
        """The shuffle that moves all values back to where they were."""
        return replace(self, up=not self.up)


@dataclass(frozen=True)
class Pointwise(OneInput):
    """An activation as an operation of its own, which follows no convolution or add.

    Attributes:
        activation: the function, which the integer core stores as a table of 256 values.
    """

    activation: Activation


def tensors(graph: Graph) -> list[str]:
    """Return the names of the tensors that the operations write, in order."""
    return [op.output for op in graph]


PLANES = "planes"
"""The tensor by which a 12-bit image enters an int8 network. Each channel becomes a coarse plane,
its remainder, and a third plane for finer weights: (N, C, H, W) to (N, 3 C, H, W), all coarse
planes first. Only convolutions read them.
"""
STEP = 32
COARSE_MAX = 127
QUARTER = 4
PLANES_FRAC_BITS = 7
"""The planes have the scale 2^-7: coarse 127 represents about 1, the full scale."""


def read_planes(graph: Graph, full_scale: np.ndarray | None = None) -> Graph:
    """Let the convolutions that read an image read the int8 planes instead, which the host encodes
    it in.

    The planes are read as multiples q * 2^-7. In float the coarse plane and its remainder carry the
    value, and the weights of the third plane are zeros: it only makes the weights finer in INT8.

    Args:
        graph: a float graph that reads the image, by convolutions alone.
        full_scale: (C,) the value of each channel that is encoded as 1; None for 1.
    """
    unit = np.float32(2.0**PLANES_FRAC_BITS / MAX_DN)
    ops = list[Op]()
    for op in fold_full_scale(graph, full_scale):
        if isinstance(op, Conv) and op.input == IMAGE:
            weight = op.weight
            # Each result of a depthwise convolution reads several planes of its channel, so it
            # becomes an ordinary convolution with zeros for the other channels.
            if op.groups != 1:
                weight = weight * np.eye(op.groups, dtype=np.float32)[:, :, None, None]
            # The third plane only makes the steps of the weights finer: in float it adds nothing.
            planes = [weight * (STEP * unit), weight * unit, np.zeros_like(weight)]
            weight = np.concatenate(planes, axis=1).astype(np.float32)
            ops.append(replace(op, input=PLANES, weight=weight, groups=1))
        else:
            ops.append(op)
    return tuple(ops)


def fold_full_scale(graph: Graph, full_scale: np.ndarray | None) -> Graph:
    """Return the graph that computes the same from an image whose channels were divided by their
    full scale.

    The weights that read a channel are multiplied by its full scale.

    Args:
        graph: a float graph that reads the image, by convolutions alone.
        full_scale: (C,) the value of each channel that becomes 1; None returns `graph` itself.
    """
    if full_scale is None:
        return graph
    gains = full_scale[:, None, None]
    scaled = list[Op]()
    for op in graph:
        if isinstance(op, Conv) and op.input == IMAGE:
            # A depthwise convolution has its channels on the axis of its results.
            factors = gains if op.groups == 1 else gains[..., None]
            scaled.append(replace(op, weight=op.weight * factors))
        else:
            scaled.append(op)
    return tuple(scaled)
