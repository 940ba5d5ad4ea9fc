"""What a network can give over all images, proven by interval arithmetic on its own weights: loose, but true.

First the float network, then the integer core, whose intervals are whole numbers.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from quant.banked.filters import PLANE_ENDS
from quant.core import INT8_MAX, INT8_MIN, IntConv, IntCore
from quant.graph import (
    COARSE_MAX,
    CORRECTION,
    IMAGE,
    PLANES,
    QUARTER,
    STEP,
    Activation,
    Add,
    AveragePool,
    Concat,
    Conv,
    Graph,
    Mul,
    Op,
    Pointwise,
    Shuffle,
    image_channels,
)
from quant.integer.arithmetic import activated, activation_table, mean_factor


@dataclass(frozen=True)
class Bound:
    """Of the restored image before clipping: its range, and the gain of a perturbation."""

    low: float
    high: float
    gain: float


@dataclass(frozen=True)
class Span:
    """Channels (C,): what values they can take, and by how much they can change for an input that changes by 1."""

    low: np.ndarray
    high: np.ndarray
    change: np.ndarray

    def __add__(self, other: "Span") -> "Span":
        return Span(self.low + other.low, self.high + other.high, self.change + other.change)

    def relu(self) -> "Span":
        """Behind a ReLU."""
        low, high = np.maximum(self.low, 0), np.maximum(self.high, 0)
        return Span(low, high, np.minimum(self.change, high - low))

    def padded(self) -> "Span":
        """Or zero: what a convolution meets at the border."""
        return Span(np.minimum(self.low, 0), np.maximum(self.high, 0), self.change)

    def through(self, weight: np.ndarray) -> "Span":
        """Behind a convolution (O, I, k, k), without its bias."""
        up, down = np.maximum(weight, 0).sum((2, 3)), np.minimum(weight, 0).sum((2, 3))
        sizes = np.abs(weight).sum((2, 3))
        low, high = up @ self.low + down @ self.high, up @ self.high + down @ self.low
        return Span(low, high, sizes @ self.change)


def all_images(graph: Graph) -> Span:
    """Every image, its channels the pixels of a place."""
    channels = image_channels(graph)
    return Span(np.zeros(channels), np.ones(channels), np.ones(channels))


def bound_anywhere(graph: Graph) -> Bound:
    """Of the image plus the graph's correction, at every pixel of every image."""
    spans = {IMAGE: all_images(graph)}
    for op in graph:
        if isinstance(op, Add):
            spans[op.output] = spans[op.inputs[0]] + spans[op.inputs[1]]
            continue
        assert isinstance(op, Conv)  # noqa: S101 - correction_graph has seen to it
        sums = spans[op.input].padded().through(op.weight.astype(np.float64))
        span = Span(sums.low + op.bias, sums.high + op.bias, sums.change)
        spans[op.output] = span.relu() if op.activation is Activation.relu else span
    return _largest(spans[CORRECTION] + spans[IMAGE])


@dataclass(frozen=True)
class Form:
    """A tensor as one convolution of each source (the image, or what left a ReLU), and a bias (C,)."""

    kernels: dict[str, np.ndarray]
    bias: np.ndarray

    def __add__(self, other: "Form") -> "Form":
        names = self.kernels | other.kernels
        kernels = {name: _add([f.kernels[name] for f in (self, other) if name in f.kernels]) for name in names}
        return Form(kernels, self.bias + other.bias)

    def through(self, op: Conv) -> "Form":
        """Behind a convolution."""
        weight = op.weight.astype(np.float64)
        kernels = {name: compose(weight, kernel) for name, kernel in self.kernels.items()}
        return Form(kernels, weight.sum((2, 3)) @ self.bias + op.bias)

    def span(self, sources: dict[str, Span]) -> Span:
        """What it can be, where its sources are within their spans."""
        total = Span(self.bias, self.bias, np.zeros_like(self.bias))
        for name, kernel in self.kernels.items():
            total = total + sources[name].through(kernel)
        return total


def bound_inside(graph: Graph) -> Bound:
    """Of the image plus the graph's correction, farther from the border than the receptive radius."""
    sources = {IMAGE: all_images(graph)}
    forms = {IMAGE: _itself(IMAGE, image_channels(graph))}
    for op in graph:
        if isinstance(op, Add):
            forms[op.output] = forms[op.inputs[0]] + forms[op.inputs[1]]
            continue
        assert isinstance(op, Conv)  # noqa: S101
        form = forms[op.input].through(op)
        if op.activation is Activation.relu:
            sources[op.output] = form.span(sources).relu()
            form = _itself(op.output, len(op.bias))
        forms[op.output] = form
    return _largest((forms[CORRECTION] + forms[IMAGE]).span(sources))


def _itself(name: str, channels: int) -> Form:
    """A source as a form of its own."""
    return Form({name: np.eye(channels)[:, :, None, None]}, np.zeros(channels))


def compose(second: np.ndarray, first: np.ndarray) -> np.ndarray:
    """`first` (M, I, l, l), then `second` (O, M, k, k), as one convolution (O, I, k + l - 1, k + l - 1)."""
    side, inner = second.shape[2], first.shape[2]
    both = np.zeros((len(second), first.shape[1], side + inner - 1, side + inner - 1))
    for dy in range(side):
        for dx in range(side):
            both[:, :, dy : dy + inner, dx : dx + inner] += np.tensordot(second[:, :, dy, dx], first, 1)
    return both


def _add(kernels: list[np.ndarray]) -> np.ndarray:
    """The sum of centred kernels of odd sides."""
    side = max(kernel.shape[2] for kernel in kernels)
    margins = [(side - kernel.shape[2]) // 2 for kernel in kernels]
    wide = [np.pad(k, ((0, 0), (0, 0), (m, m), (m, m))) for k, m in zip(kernels, margins, strict=True)]
    return np.asarray(sum(wide))


def _largest(span: Span) -> Bound:
    return Bound(float(span.low.min()), float(span.high.max()), float(span.change.max()))


PLANE_LOW = np.array([0, -STEP // 2, -STEP // 2 // QUARTER])
PLANE_HIGH = np.array([COARSE_MAX, STEP - 1, STEP // QUARTER])

Range = tuple[np.ndarray, np.ndarray]
"""Smallest and largest whole number of each channel."""


@dataclass(frozen=True)
class LayerBound:
    """What one operation can do, over all images.

    Attributes:
        name: of the operation.
        bits: that its accumulator needs at most, without the sign.
        low: of the result before it is clipped to int8.
        high: likewise.
    """

    name: str
    bits: float
    low: int
    high: int

    @property
    def saturates(self) -> bool:
        """Whether any image might bring a result to int8's ends."""
        return self.low <= INT8_MIN or self.high >= INT8_MAX


def layer_bounds(core: IntCore) -> list[LayerBound]:
    """Of every operation, in order."""
    ranges: dict[str, Range] = {PLANES: _planes(core)}
    bounds = []
    for op in core.ops:
        low, high, shift = _accumulated(core, op, [ranges[name] for name in op.inputs])
        bits = float(np.log2(max(int(np.abs(low).max()), int(np.abs(high).max()), 1)))
        low, high = _shifted(low, shift), _shifted(high, shift)
        ranges[op.output] = np.clip(low, INT8_MIN, INT8_MAX), np.clip(high, INT8_MIN, INT8_MAX)
        bounds.append(LayerBound(op.name, bits, int(low.min()), int(high.max())))
    return bounds


def saturable(core: IntCore) -> Mapping[str, bool]:
    """Which operations might saturate on some image."""
    return {bound.name: bound.saturates for bound in layer_bounds(core)}


def correction_bound(core: IntCore, gain: int) -> float:
    """The largest size of the correction, of full scale, where its last channel counts `gain` times."""
    low, high = layer_bounds(core)[-1].low, layer_bounds(core)[-1].high
    size = max(min(high, INT8_MAX), -max(low, INT8_MIN))
    return size * core.scale(CORRECTION) * (gain if core.ends.gains == 2 else 1)


def _planes(core: IntCore) -> Range:
    count, channels = core.ends.planes, core.ends.channels
    if core.ends.banked:
        low, high = (np.array(ends) for ends in PLANE_ENDS)
        return low.repeat(channels), high.repeat(channels)
    return PLANE_LOW[:count].repeat(channels), PLANE_HIGH[:count].repeat(channels)


Accumulated = tuple[np.ndarray, np.ndarray, int]
"""The accumulators' interval, zero padding included, and the shift to int8."""


def _accumulated(core: IntCore, op: IntConv | Op, read: list[Range]) -> Accumulated:
    if isinstance(op, IntConv):
        return _conv(core, op, read[0])
    if isinstance(op, Add):
        return _whole_add(core, op, read)
    if isinstance(op, Mul):
        corners = np.array([a.astype(np.int64) * b for a in read[0] for b in read[1]])
        shift = sum(core.frac_bits[name] for name in op.inputs) - core.frac_bits[op.output]
        return corners.min(0), corners.max(0), shift
    if isinstance(op, AveragePool):
        assert op.kernel is not None  # noqa: S101 - resolved before anything is quantised
        factor, shift = mean_factor(op.kernel)
        low, high = (op.kernel[0] * op.kernel[1] * factor * end.astype(np.int64) for end in _padded(read[0]))
        return low, high, shift
    low, high = _moved(core, op, read)
    return low, high, 0


def _moved(core: IntCore, op: Op, read: list[Range]) -> Range:
    """Behind what hands values on, or looks them up."""
    low, high = (np.concatenate([ends[k] for ends in read]) for k in (0, 1))
    if isinstance(op, Concat):
        return low, high
    if isinstance(op, Pointwise):
        table = activation_table(op, core.frac_bits)
        spans = [table[a - INT8_MIN : b - INT8_MIN + 1] for a, b in zip(low, high, strict=True)]
        return np.array([span.min() for span in spans]), np.array([span.max() for span in spans])
    if isinstance(op, Shuffle):
        side = 1 if op.up else op.block
        maps = [op(np.tile(end[None, :, None, None], (1, 1, side, side)))[0] for end in (low, high)]
        return maps[0].min((1, 2)), maps[1].max((1, 2))
    return low, high


def _padded(ends: Range) -> Range:
    return np.minimum(ends[0], 0), np.maximum(ends[1], 0)


def _conv(core: IntCore, op: IntConv, read: Range) -> Accumulated:
    low, high = _padded(read)
    weight = op.weight.astype(np.int64)
    up, down = np.maximum(weight, 0).sum((2, 3)), np.minimum(weight, 0).sum((2, 3))
    product = op.weight_frac_bits + core.frac_bits[op.input]
    bias = op.bias.astype(np.int64) << (product - op.bias_frac_bits)
    if op.groups == 1:
        least, most = up @ low + down @ high + bias, up @ high + down @ low + bias
    else:  # depthwise: each channel its own
        up, down = up[:, 0], down[:, 0]
        least, most = up * low + down * high + bias, up * high + down * low + bias
    (least, finer), (most, _) = (activated(end, op.activation, product) for end in (least, most))
    return least, most, product - core.frac_bits[op.output] + finer


def _whole_add(core: IntCore, op: Add, read: list[Range]) -> Accumulated:
    finest = max(core.frac_bits[name] for name in op.inputs)
    shifts = [finest - core.frac_bits[name] for name in op.inputs]
    ends = (sum(r[k].astype(np.int64) << s for r, s in zip(read, shifts, strict=True)) for k in (0, 1))
    (low, finer), (high, _) = (activated(np.asarray(end), op.activation, finest) for end in ends)
    return low, high, finest - core.frac_bits[op.output] + finer


def _shifted(sums: np.ndarray, shift: int) -> np.ndarray:
    return sums << -shift if shift <= 0 else (sums + (1 << (shift - 1))) >> shift
