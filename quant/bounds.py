"""What a float network can give over all images: interval arithmetic on its own weights. Loose, but true.

Two bounds, each over every image of [0, 1] and every size:

1. anywhere: layer by layer, each input within its own interval, or zero where the border pads.
2. inside: farther from the border than the receptive radius. There no zero is padded, so convolutions between two
   ReLUs are one convolution, whose signs cancel before sizes are taken: tighter by orders of magnitude.

The gain is the largest change of any output pixel when every input pixel changes by at most 1: sums of the weights'
sizes along the graph. A ReLU changes by no more than its input does, and by no more than its own range.
"""

from dataclasses import dataclass

import numpy as np

from quant.graph import CORRECTION, IMAGE, Add, Conv, Graph


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


ALL_IMAGES = Span(np.zeros(1), np.ones(1), np.ones(1))


def bound_anywhere(graph: Graph) -> Bound:
    """Of the image plus the graph's correction, at every pixel of every image."""
    spans = {IMAGE: ALL_IMAGES}
    for op in graph:
        if isinstance(op, Add):
            spans[op.output] = spans[op.inputs[0]] + spans[op.inputs[1]]
            continue
        sums = spans[op.input].padded().through(op.weight.astype(np.float64))
        span = Span(sums.low + op.bias, sums.high + op.bias, sums.change)
        spans[op.output] = span.relu() if op.relu else span
    return _largest(spans[CORRECTION] + ALL_IMAGES)


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
    sources, one = {IMAGE: ALL_IMAGES}, np.ones((1, 1, 1, 1))
    forms = {IMAGE: Form({IMAGE: one}, np.zeros(1))}
    for op in graph:
        if isinstance(op, Add):
            forms[op.output] = forms[op.inputs[0]] + forms[op.inputs[1]]
            continue
        form = forms[op.input].through(op)
        if op.relu:
            sources[op.output] = form.span(sources).relu()
            channels = len(op.bias)
            form = Form({op.output: np.eye(channels)[:, :, None, None]}, np.zeros(channels))
        forms[op.output] = form
    return _largest((forms[CORRECTION] + forms[IMAGE]).span(sources))


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
