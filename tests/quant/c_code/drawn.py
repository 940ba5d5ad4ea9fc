"""Small cores of integers with every kind of operation, drawn by Hypothesis."""

import math
from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.frac_bits import INT8_MAX, INT8_MIN
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    Activation,
    Add,
    AveragePool,
    Concat,
    MaxPool,
    Mul,
    Op,
    Pointwise,
    Resize,
    Shuffle,
    Window,
)
from beers_deploy.quant.host_part import HostPart

ACTIVATIONS = (Activation.none, Activation.relu, Activation.relu6, Activation.leaky_relu)
TABLES = (Activation.hard_sigmoid, Activation.hard_swish, Activation.relu6)
KINDS = (
    "convolution",
    "grouped",
    "transposed",
    "add",
    "mul",
    "gate",
    "concat",
    "maximum",
    "mean",
    "repeat",
    "bilinear",
    "to pixels",
    "to channels",
    "table",
)
Shape = tuple[int, int, int]


class CoreDrawer:
    """A builder of a core that draws operations one by one, each on existing tensors."""

    def __init__(self, draw: st.DrawFn, tile_px: int) -> None:
        """Begin with planes of a tile, and with a generator for the integers."""
        self.draw = draw
        self.generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
        self.ops: list[IntConv | Op] = []
        self.frac_bits = {PLANES: 7}
        self.shapes: dict[str, Shape] = {PLANES: (3, tile_px, tile_px)}

    def number(self, low: int, high: int) -> int:
        """Draw an integer between two ends, both included."""
        return self.draw(st.integers(low, high))

    def tensor(self) -> str:
        """Return a tensor that an operation may read: planes are for convolutions alone."""
        return self.draw(st.sampled_from([name for name in self.shapes if name != PLANES]))

    def append(self, op: IntConv | Op, shape: Shape, frac_bits: int) -> None:
        """Append an operation, and note the shape and the scale of its result."""
        self.ops.append(op)
        self.shapes[op.output] = shape
        self.frac_bits[op.output] = frac_bits

    def name(self) -> str:
        """Return a new name, which has the characters that end a comment of C."""
        return f"op.{len(self.ops)}*/"

    def result(self) -> str:
        """Return the name of the next result."""
        return f"t{len(self.ops)}"

    def window(
        self, kernel: tuple[int, int], source: str, plain: bool = False
    ) -> tuple[Window, list[int]]:
        """Draw a window that has at least one place on a map, and return the number of its rows and
        columns of places as well.
        """
        size = self.shapes[source][1:]
        pads = tuple(self.number(0, kernel[axis % 2] - 1) for axis in range(4))
        dilations = (1, 1) if plain else (self.number(1, 2), self.number(1, 2))
        window = Window((self.number(1, 3), self.number(1, 2)), pads, dilations)  # type: ignore[arg-type]
        places = [window.output_size(axis, kernel[axis], size[axis]) for axis in (0, 1)]
        if min(places) > 0:
            return window, places
        return Window(), [size[axis] - kernel[axis] + 1 for axis in (0, 1)]

    def convolution(self, source: str, outputs: int, groups: int = 1) -> None:
        """Append a convolution with a kernel that fits its map."""
        channels, rows, columns = self.shapes[source]
        kernel = (self.number(1, min(rows, 4)), self.number(1, min(columns, 4)))
        drawn = self.window(kernel, source)
        self._conv(source, (outputs, channels // groups, *kernel), *drawn, groups)

    def _transposed(self, source: str) -> None:
        """Append a transposed convolution whose result is not smaller than its map."""
        channels, *size = self.shapes[source]
        stride = self.number(1, 3)
        kernel = (self.number(stride, 4), self.number(stride, 4))
        pads = tuple(self.number(0, (kernel[axis % 2] - 1) // 2) for axis in range(4))
        window = Window((stride, stride), pads)  # type: ignore[arg-type]
        sizes = [window.transposed_size(axis, kernel[axis], size[axis]) for axis in (0, 1)]
        self._conv(source, (self.number(1, 5), channels, *kernel), window, sizes, 1, True)

    def _conv(
        self,
        source: str,
        shape: tuple[int, ...],
        window: Window,
        sizes: list[int],
        groups: int,
        transposed: bool = False,
    ) -> None:
        """Append a convolution with drawn integers and scales.

        At least a fifth of the weights are at the ends of int8, where sums are largest.
        """
        ends = np.array([INT8_MIN, INT8_MAX])
        weight = self.generator.integers(INT8_MIN, INT8_MAX + 1, shape)
        weight = np.where(self.generator.random(shape) < 0.2, self.generator.choice(ends), weight)
        bias = self.generator.integers(INT8_MIN, INT8_MAX + 1, shape[0])
        frac_bits = self.number(2, 7)
        weight_frac_bits = frac_bits + self.number(0, 12) - self.frac_bits[source]
        bias_frac_bits = weight_frac_bits + self.frac_bits[source] - self.number(-2, 9)
        op = IntConv(
            self.name(),
            source,
            self.result(),
            weight.astype(np.int8),
            weight_frac_bits,
            bias.astype(np.int8),
            bias_frac_bits,
            self.draw(st.sampled_from(ACTIVATIONS)),
            window,
            groups,
            transposed,
        )
        self.append(op, (shape[0], sizes[0], sizes[1]), frac_bits)

    def of_kind(self, kind: str) -> None:
        """Append an operation of a kind, after the operations that it needs."""
        getattr(self, f"_{kind.replace(' ', '_')}")(self.tensor())

    def _convolution(self, source: str) -> None:
        """Append a convolution over all channels."""
        self.convolution(source, self.number(1, 6))

    def _grouped(self, source: str) -> None:
        """Append a depthwise convolution with one or two results a channel."""
        channels = self.shapes[source][0]
        self.convolution(source, channels * self.number(1, 2), channels)

    def _pair(self, source: str) -> tuple[str, str]:
        """Return a tensor, and another of the same shape and mostly of another scale."""
        self._table(source)
        shape = self.shapes[source]
        names = [name for name in self.shapes if self.shapes[name] == shape and name != PLANES]
        return source, self.draw(st.sampled_from(names))

    def _add(self, source: str) -> None:
        """Append a sum, coarser or finer than its inputs."""
        pair = self._pair(source)
        activation = self.draw(st.sampled_from(ACTIVATIONS))
        finest = max(self.frac_bits[name] for name in pair)
        add = Add(self.name(), pair, self.result(), activation)
        self.append(add, self.shapes[source], finest - self.number(-2, 5))

    def _mul(self, source: str) -> None:
        """Append a product, whose bits before rounding are those of both factors."""
        pair = self._pair(source)
        finest = sum(self.frac_bits[name] for name in pair)
        mul = Mul(self.name(), pair, self.result())
        self.append(mul, self.shapes[source], finest - self.number(0, 10))

    def _gate(self, source: str) -> None:
        """Append a product with a factor for each channel: the mean over the map."""
        kernel = self.shapes[source][1:]
        mean = AveragePool(self.name(), source, self.result(), kernel, Window())
        self.append(mean, (self.shapes[source][0], 1, 1), self.frac_bits[source])
        pair = self.draw(st.permutations([source, mean.output]))
        mul = Mul(self.name(), tuple(pair), self.result())
        self.append(mul, self.shapes[source], 2 * self.frac_bits[source] - self.number(0, 10))

    def _concat(self, source: str) -> None:
        """Append the channels of all tensors that have the same size and scale."""
        channels, rows, columns = self.shapes[source]
        bits = self.frac_bits[source]
        parts = [
            name
            for name, shape in self.shapes.items()
            if shape[1:] == (rows, columns) and self.frac_bits[name] == bits and name != PLANES
        ]
        width = channels + sum(self.shapes[name][0] for name in parts)
        concat = Concat(self.name(), (*parts, source), self.result())
        self.append(concat, (width, rows, columns), bits)

    def _maximum(self, source: str) -> None:
        """Append a maximum over windows, which may be dilated."""
        self._pool(source, MaxPool)

    def _mean(self, source: str) -> None:
        """Append a mean over windows, which is not dilated."""
        self._pool(source, AveragePool)

    def _pool(self, source: str, pool: type[MaxPool | AveragePool]) -> None:
        """Append a pooling, which keeps the scale of what it reads."""
        channels, rows, columns = self.shapes[source]
        kernel = (self.number(1, min(rows, 3)), self.number(1, min(columns, 3)))
        window, places = self.window(kernel, source, plain=pool is AveragePool)
        op = pool(self.name(), source, self.result(), kernel, window)
        self.append(op, (channels, places[0], places[1]), self.frac_bits[source])

    def _enlarge(self, source: str, factor: int, bilinear: bool) -> None:
        """Append an enlargement, which keeps the scale of what it reads."""
        channels, rows, columns = self.shapes[source]
        resize = Resize(self.name(), source, self.result(), factor, bilinear)
        shape = (channels, rows * factor, columns * factor)
        self.append(resize, shape, self.frac_bits[source])

    def _repeat(self, source: str) -> None:
        """Append an enlargement that repeats pixels."""
        self._enlarge(source, self.number(2, 3), False)

    def _bilinear(self, source: str) -> None:
        """Append an enlargement that interpolates between pixels."""
        self._enlarge(source, self.draw(st.sampled_from((2, 4))), True)

    def _to_pixels(self, source: str) -> None:
        """Append eight channels and their shuffle to pixels, in either order of ONNX."""
        self.convolution(source, 8)
        source = self.ops[-1].output
        _, rows, columns = self.shapes[source]
        order = self.draw(st.booleans())
        up = Shuffle(self.name(), source, self.result(), 2, True, order)
        self.append(up, (2, 2 * rows, 2 * columns), self.frac_bits[source])

    def _to_channels(self, source: str) -> None:
        """Append an enlarged map and the shuffle of its pixels to channels."""
        channels, rows, columns = self.shapes[source]
        # Not by repetition, which would make the values of a square equal.
        self._enlarge(source, 2, bilinear=True)
        down = Shuffle(self.name(), self.ops[-1].output, self.result(), 2, False, False)
        self.append(down, (4 * channels, rows, columns), self.frac_bits[source])

    def _table(self, source: str) -> None:
        """Append an activation that is computed as a table of 256 values."""
        activation = self.draw(st.sampled_from(TABLES))
        table = Pointwise(self.name(), source, self.result(), activation)
        self.append(table, self.shapes[source], self.number(2, 7))

    def core(self) -> IntCore:
        """Return the core, which ends in a convolution of the last result."""
        self.convolution(self.ops[-1].output, 2)
        last = self.ops.pop()
        assert isinstance(last, IntConv)
        self.ops.append(replace(last, output=CORRECTION))
        self.frac_bits[CORRECTION] = self.frac_bits[last.output]
        part = HostPart(outputs=2, adds_image=False)
        return IntCore(tuple(self.ops), self.frac_bits, part)


@st.composite
def cores(draw: st.DrawFn, kinds: tuple[str, ...] = KINDS, most: int = 8) -> tuple[IntCore, int]:
    """Draw a core with operations of these kinds, and the side of its tile in pixels."""
    tile_px = draw(st.integers(4, 9))
    drawer = CoreDrawer(draw, tile_px)
    drawer.convolution(PLANES, draw(st.integers(1, 6)))
    for kind in draw(st.lists(st.sampled_from(kinds), min_size=1, max_size=most)):
        drawer.of_kind(kind)
        # Several enlargements in a row would take seconds.
        if math.prod(drawer.shapes[drawer.ops[-1].output]) > 1 << 14:
            break
    return drawer.core(), tile_px
