"""Determine which pixels of its source an operator reads, along one axis of the image.

`AXIS_MAPS` has each operator that reads other pixels than the one in its own place: windows,
transposed windows, shuffles, enlargements. The size of a tensor is tracked as a share of the
image's size plus an excess. So it does not matter where pixels were padded and where windows used
them up.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product
from typing import Any

from beers_deploy.profiles.errors import LONGEST, ModelError, printable
from beers_deploy.quant.onnx.graph import WEIGHTS, Node, OnnxGraph
from beers_deploy.quant.onnx.resize import PLACES, ROUNDINGS, Resizing
from beers_deploy.quant.onnx.runnable import WINDOW_PX
from beers_deploy.quant.onnx.window import Window
from beers_deploy.quant.simplify.convolutions import states_pads
from beers_deploy.quant.simplify.slices import TO_THE_END
from beers_deploy.quant.untrusted import times


@dataclass(frozen=True)
class AxisMap:
    """The pixels of its source that an operator reads, along one side (rows or columns).

    Pixel k of the result reads the source from k / growth + low, rounded up, to k / growth + high,
    rounded down.

    Attributes:
        growth: the number of pixels of the result for one of the source.
        extra: the number of pixels by which the result differs from its share of the image:
            positive if it has more.
        low: the first pixel that is read, relative to the pixel's own place.
        high: the last pixel that is read, relative to the pixel's own place.
        mirrored: the number of pixels beyond either end of the source in whose place mirrored ones
            are read.
    """

    growth: Fraction
    extra: int
    low: Fraction = Fraction(0)
    high: Fraction = Fraction(0)
    mirrored: int = 0

    def reads(self, first: int, last: int, size: int) -> tuple[int, int]:
        """Return the first and the last pixel of the source that a range of pixels of the result
        reads.

        Args:
            first: the first pixel of the range.
            last: the last pixel of the range.
            size: the number of pixels of the source if the image is a single cell of the lattice
                (the smallest step by which tiles may be moved). The source may end there, on either
                side.
        """
        low = math.ceil(first / self.growth + self.low)
        high = math.floor(last / self.growth + self.high)
        # Pixels beyond an end of the source are mirrored, or copied, from within.
        if self.mirrored:
            return min(low, 2 * (size - 1) - high), max(high, -low)
        return min(low, size - 1), max(high, 0)


@dataclass(frozen=True)
class AxisNode:
    """A node whose effect along one side of the image is determined.

    Attributes:
        node: the node.
        axis: 0 for the rows, 1 for the columns.
        extra: the number of pixels by which the node's source differs from its share of the image:
            positive if it has more.
        graph: the graph that the node belongs to.
        shapes: the shapes of all constants by name, including those that nodes compute from others.
    """

    node: Node
    axis: int
    extra: int
    graph: OnnxGraph
    shapes: Mapping[str, tuple[int, ...]]

    def require(self, valid: bool, why: str) -> None:
        """Raise ModelError unless a condition for tiling holds.

        Args:
            valid: True if the node meets the condition.
            why: a verb phrase for the message on what the node does instead, such as "has a fixed
                size".
        """
        if not valid:
            raise not_tileable(
                "every operator must do the same at every pixel and read near pixels only, but "
                f"{self.node} {why}"
            )

    def attribute(self, key: str, otherwise: Any) -> Any:
        """Return an attribute of the node, or `otherwise` if the node does not state it."""
        return self.node.attribute(key, otherwise)

    def numbers(self, place: int, key: str, otherwise: Sequence[float] = ()) -> list[Any]:
        """Return the numbers that the node states in a constant input or, in older opsets, in an
        attribute.

        Args:
            place: the number of the input, from 0 on.
            key: the name of the attribute.
            otherwise: the numbers that are returned if the node states none.

        Raises:
            ModelError: other nodes compute the input.
        """
        values = self.graph.numbers(self.node, place, key)
        self.require(values is not None, "has sizes that are computed (fold them)")
        return values or list(otherwise)

    def own(self, numbers: Sequence[Any], axes: Sequence[int], otherwise: Any) -> Any:
        """Select from numbers for several axes the one for the node's side, rows or columns.

        Args:
            numbers: one number for each of `axes`.
            axes: axes of (N, C, H, W); a negative one counts from the last.
            otherwise: the value that is returned if no number is for this side.
        """
        by_axis = dict(zip((int(axis) % 4 for axis in axes), numbers, strict=True))
        return by_axis.get(2 + self.axis, otherwise)

    def slide(self, window: Window, kernel: int = 1, ceil: bool = False) -> AxisMap:
        """Return which pixels a window reads that slides over its padded source, such as a
        convolution's.

        Args:
            window: strides, pads and dilations.
            kernel: the number of pixels that the window reads along the side.
            ceil: True if the last window may reach beyond the padding (ONNX's `ceil_mode`).
        """
        extra = window.output_size(self.axis, kernel, self.extra, ceil)
        before = window.pads[self.axis]
        high = window.extent(self.axis, kernel) - 1 - before
        growth = Fraction(1, window.strides[self.axis])
        return AxisMap(growth, extra, Fraction(-before), Fraction(high))

    def transpose(self, window: Window, kernel: int) -> AxisMap:
        """Return which pixels a transposed convolution reads, whose pads cut its result.

        Args:
            window: strides, pads and dilations.
            kernel: the number of weights along the side.
        """
        stride = window.strides[self.axis]
        before = window.pads[self.axis]
        extra = window.transposed_size(self.axis, kernel, self.extra)
        extra += self.node.output_padding[self.axis]
        # Pixel k of the source writes `extent` pixels of the result, from k * stride - before on.
        low = Fraction(before - window.extent(self.axis, kernel) + 1, stride)
        high = Fraction(before, stride)
        return AxisMap(Fraction(stride), extra, low, high)


def _window(at: AxisNode) -> tuple[int, Window]:
    """Return its side along the axis, and how it moves."""
    weight = WEIGHTS.get(at.node.op_type)
    kernel = () if weight is None else at.shapes.get(at.node.inputs[weight], ())[2:]
    window = at.node.window(kernel, (at.extra, at.extra))
    at.require(
        window is not None and not at.attribute("channels_last", 0),
        "has no constant window of rows and columns",
    )
    assert window is not None  # noqa: S101 - required above
    return window[0][at.axis], window[1]


def _slide(at: AxisNode) -> AxisMap:
    kernel, window = _window(at)
    return at.slide(window, kernel, bool(at.attribute("ceil_mode", 0)))


def _transpose(at: AxisNode) -> AxisMap:
    at.require(states_pads(at.node), "has a fixed or automatic size")
    kernel, window = _window(at)
    return at.transpose(window, kernel)


def _shuffle(at: AxisNode) -> AxisMap:
    """Return the map of a pixel shuffle or its inverse."""
    block = int(at.attribute("blocksize", 1))
    window = Window((block, block))
    if at.node.op_type == "DepthToSpace":
        return at.transpose(window, block)
    at.require(at.extra % block == 0, "makes channels of blocks that do not fit the image")
    return at.slide(window, block)


def _pad(at: AxisNode) -> AxisMap:
    """Return the map of a separate Pad; negative padding crops."""
    mode = at.attribute("mode", "constant")
    at.require(mode != "wrap", "joins opposite borders")
    pads = at.numbers(1, "pads")
    axes = at.numbers(3, "axes", range(4))
    at.require(len(pads) == 2 * len(axes), "has an unknown padding")
    ends = [at.own(part, axes, 0) for part in (pads[: len(axes)], pads[len(axes) :])]
    # A pad is a window of one pixel that slides over the padded source.
    step = at.slide(Window(pads=(ends[0], ends[0], ends[1], ends[1])))
    return replace(step, mirrored=max(ends) if mode == "reflect" else 0)


def _slice(at: AxisNode) -> AxisMap:
    """Return the map of a Slice that cuts relative to the borders, or that selects every n-th
    pixel.

    Raises ModelError for a slice at a fixed position.
    """
    starts = at.numbers(1, "starts")
    ends = at.numbers(2, "ends")
    axes = at.numbers(3, "axes", range(len(starts)))
    steps = at.numbers(4, "steps", [1] * len(starts))
    start = at.own(starts, axes, 0)
    end = at.own(ends, axes, TO_THE_END)
    step = at.own(steps, axes, 1)
    # A start from the end or an end from the start lies elsewhere for each size of the image.
    is_relative = start >= 0 and step > 0 and not 0 <= end < TO_THE_END
    at.require(is_relative, "cuts at a fixed position")
    behind = min(end, 0)
    return at.slide(Window(strides=(step, step), pads=(-start, -start, behind, behind)))


def _resize(at: AxisNode) -> AxisMap:
    """Return the map of a Resize by an integer factor, or by the inverse of one.

    Linear and cubic interpolation are accepted only if all weights are exact floats. Raises
    ModelError for anything else.
    """
    resizing = Resizing.of(at.graph, at.node)
    at.require(bool(resizing.factors), "resizes to a fixed size")
    growth = Fraction(resizing.factors[2 + at.axis])
    by_whole_factor = (
        0 < growth <= WINDOW_PX
        and 1 in (growth.numerator, growth.denominator)
        and resizing.factors[:2] == (1, 1)
    )
    at.require(by_whole_factor, f"resizes by {times(resizing.factors)}")
    at.require(
        resizing.where in PLACES, f"uses the coordinates {resizing.where}, which depend on the size"
    )
    # Its formula differs where the result has a single pixel.
    at.require(
        growth > 1 or resizing.where != "pytorch_half_pixel",
        "uses coordinates that depend on the size",
    )
    blends = resizing.mode != "nearest"
    at.require(
        not at.attribute("antialias", 0), f"resizes in mode {resizing.mode} with antialiasing"
    )
    # Weights that are multiples of a power of two are exact floats, so that the same sum is rounded
    # alike at every place.
    exact = not blends or growth.numerator & (growth.numerator - 1) == 0
    at.require(exact, f"resizes by {growth} with weights whose rounding depends on the position")
    ways = (math.floor, math.ceil) if blends else (ROUNDINGS[resizing.rounding],)
    # The offsets repeat after the number of pixels that one pixel of the source becomes.
    pixels = range(growth.numerator)
    places = [(k / growth, PLACES[resizing.where](k, float(growth))) for k in pixels]
    offsets = [way(place) - share for way, (share, place) in product(ways, places)]
    # Cubic interpolation reads one pixel more on either side.
    more = int(resizing.mode == "cubic")
    low = min(offsets) - more
    return AxisMap(growth, math.floor(at.extra * growth), low, max(offsets) + more)


AXIS_MAPS: dict[str, Callable[[AxisNode], AxisMap]] = {
    **dict.fromkeys(("Conv", "ConvInteger", "QLinearConv"), _slide),
    **dict.fromkeys(("AveragePool", "LpPool", "MaxPool", "QLinearAveragePool"), _slide),
    **dict.fromkeys(("DepthToSpace", "SpaceToDepth"), _shuffle),
    **dict.fromkeys(("Resize", "Upsample"), _resize),
    "ConvTranspose": _transpose,
    "Pad": _pad,
    "Slice": _slice,
}
"""Operators that read other pixels than the one in their own place; the image is
their first input.
"""


def not_tileable(reason: str) -> ModelError:
    """Build the error for a network whose image cannot be cut into tiles.

    Args:
        reason: a clause on why, which may contain names from a file.
    """
    return ModelError(
        f"The network cannot be tiled: {printable(reason, 4 * LONGEST)}. Give a network that "
        "computes one image from one image, each pixel from near pixels only."
    )
