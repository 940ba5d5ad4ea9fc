"""What an operator's pixels read along one side of the image: windows, transposed windows, shuffles, enlargements.

`STEPS` says it of each operator that reads other pixels than the one in its own place. Sizes are followed as a share
of the image's, and what a tensor has beyond that share: so it does not matter where pixels were padded and where
windows used them up.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
import onnx

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.graph.trials import PLACES, ROUNDINGS
from beers_deploy.quant.untrusted import WINDOW_PX, times


@dataclass(frozen=True)
class Step:
    """What an operator does along one side.

    Attributes:
        growth: pixels of its result for one of its source.
        extra: pixels that its result has beyond, or short of, its share of the image.
        low: pixel k of the result reads its source from k / growth + low, rounded up,
        high: to k / growth + high, rounded down.
        mirrored: pixels beyond either end of the source for which it reads those within.
    """

    growth: Fraction
    extra: int
    low: Fraction = Fraction(0)
    high: Fraction = Fraction(0)
    mirrored: int = 0

    def reads(self, first: int, last: int, size: int) -> tuple[int, int]:
        """The first and the last pixel of the source that some pixels of the result read.

        Args:
            first: of the result's pixels.
            last: of them.
            size: of the source where the image is one cell of the lattice: it may end on either side of it.
        """
        low, high = math.ceil(first / self.growth + self.low), math.floor(last / self.growth + self.high)
        if self.mirrored:  # beyond an end of the source stands what is mirrored, or copied, from within
            return min(low, 2 * (size - 1) - high), max(high, -low)
        return min(low, size - 1), max(high, 0)


@dataclass(frozen=True)
class Along:
    """A node along one side of the image, 0 for the rows and 1 for the columns.

    Attributes:
        node: the node.
        given: its attributes by name.
        side: which side.
        extra: pixels that its source has beyond, or short of, its share of the image.
        values: the constants of the file.
        shapes: of all constants, those included that nodes make of others.
    """

    node: onnx.NodeProto
    given: Mapping[str, Any]
    side: int
    extra: int
    values: Mapping[str, np.ndarray]
    shapes: Mapping[str, tuple[int, ...]]

    def require(self, sound: bool, why: str) -> None:
        """Refuse a node that cannot be tiled."""
        if not sound:
            got = f"{self.node.op_type} {self.node.name}".strip() + f", {why}"
            raise refused("operators that do the same at every pixel, from near pixels alone", got)

    def numbers(self, index: int, otherwise: Iterable[float]) -> list[Any]:
        """The values of a constant input, or what they are where there is none."""
        name = self.node.input[index] if len(self.node.input) > index else ""
        if not name:
            return list(otherwise)
        self.require(name in self.values, "whose sizes are computed: fold them")
        self.require(self.values[name].size <= 16, "whose sizes are many")
        return list(self.values[name].ravel().tolist())

    def own(self, numbers: Sequence[Any], axes: Sequence[int], otherwise: Any) -> Any:
        """This side's number, of some for these axes of (N, C, H, W)."""
        return dict(zip((int(axis) % 4 for axis in axes), numbers, strict=True)).get(2 + self.side, otherwise)


def _window(at: Along, weights: int | None) -> tuple[int, int]:
    """Pixels from the first to the last of a window, of weights at that input, and its stride."""
    kernel = at.given["kernel_shape"] if weights is None else at.shapes.get(at.node.input[weights], ())[2:]
    sound = len(kernel) == 2 and not at.given.get("channels_last", 0)
    at.require(sound, "which has no constant window of rows and columns")
    stride, dilation = (at.given.get(name, [1, 1])[at.side] for name in ("strides", "dilations"))
    return (kernel[at.side] - 1) * dilation + 1, stride


def _sliding(at: Along, extent: int, stride: int, pads: Sequence[int], ceil: bool = False) -> Step:
    """A window that slides over its padded source; a last one that would begin behind the image is left out."""
    room = at.extra + sum(pads) - extent
    steps = min(-(-room // stride), (at.extra + pads[0] - 1) // stride) if ceil else room // stride
    return Step(Fraction(1, stride), steps + 1, Fraction(-pads[0]), Fraction(extent - 1 - pads[0]))


def _put_down(at: Along, extent: int, stride: int, pads: Sequence[int]) -> Step:
    """A window that is put down at each pixel of its source; the result is cut by the padding."""
    extra = (at.extra - 1) * stride + extent - sum(pads)
    return Step(Fraction(stride), extra, Fraction(pads[0] - extent + 1, stride), Fraction(pads[0], stride))


def _slide(at: Along) -> Step:
    """Convolutions and pools."""
    extent, stride = _window(at, CONVOLUTIONS.get(at.node.op_type))
    auto, pads = at.given.get("auto_pad", b"NOTSET"), at.given.get("pads", [0, 0, 0, 0])[at.side :: 2]
    at.require(auto in (b"NOTSET", b"VALID", b"SAME_UPPER", b"SAME_LOWER"), "of an unknown padding")
    if auto != b"NOTSET":  # as much as keeps a size that is a multiple of the stride
        total = max(extent - stride + -at.extra % stride, 0) if auto != b"VALID" else 0
        less, more = total // 2, total - total // 2
        pads = (more, less) if auto == b"SAME_LOWER" else (less, more)
    return _sliding(at, extent, stride, pads, bool(at.given.get("ceil_mode", 0)))


def _transpose(at: Along) -> Step:
    """Transposed convolutions."""
    extent, stride = _window(at, 1)
    sound = "output_shape" not in at.given and at.given.get("auto_pad", b"NOTSET") == b"NOTSET"
    at.require(sound, "of a fixed or automatic size")
    before, behind = at.given.get("pads", [0, 0, 0, 0])[at.side :: 2]
    return _put_down(at, extent, stride, (before, behind - at.given.get("output_padding", [0, 0])[at.side]))


def _shuffle(at: Along) -> Step:
    """Channels become squares of pixels, or squares of pixels channels."""
    size = int(at.given["blocksize"])
    if at.node.op_type == "DepthToSpace":
        return _put_down(at, size, size, (0, 0))
    at.require(at.extra % size == 0, "of squares that do not fit")
    return _sliding(at, size, size, (0, 0))


def _pad(at: Along) -> Step:
    """Padding by itself; less than none cuts off."""
    mode = at.given.get("mode", b"constant")
    at.require(mode != b"wrap", "which joins opposite borders")
    pads, axes = at.numbers(1, at.given.get("pads", ())), at.numbers(3, range(4))
    at.require(len(pads) == 2 * len(axes), "of an unknown padding")
    ends = [at.own(part, axes, 0) for part in (pads[: len(axes)], pads[len(axes) :])]
    return replace(_sliding(at, 1, 1, ends), mirrored=max(ends) if mode == b"reflect" else 0)


FAR = 1 << 30
"""An end of a slice that stands for the image's own."""


def _slice(at: Along) -> Step:
    """A part that is counted from the borders, or every n-th pixel."""
    starts, ends = at.numbers(1, at.given.get("starts", ())), at.numbers(2, at.given.get("ends", ()))
    axes, steps = at.numbers(3, at.given.get("axes", range(len(starts)))), at.numbers(4, [1] * len(starts))
    start, end, step = (at.own(*each) for each in ((starts, axes, 0), (ends, axes, FAR), (steps, axes, 1)))
    at.require(start >= 0 and step > 0 and (end < 0 or end >= FAR), "which cuts at a place that is fixed")
    return _sliding(at, 1, step, (-start, min(end, 0)))


def _resize(at: Along) -> Step:
    """Enlarging by whole factors, or taking every 2nd, 4th, ... pixel; linear where all weights are exact floats."""
    old = at.node.op_type == "Upsample" or len(at.node.input) == 2  # before opset 11
    growth = _growth(at, 1 if old else 2)
    mode = at.given.get("mode", b"nearest").decode()
    where = at.given.get("coordinate_transformation_mode", b"asymmetric" if old else b"half_pixel").decode()
    rounding = at.given.get("nearest_mode", b"floor" if old else b"round_prefer_floor").decode()
    at.require(where in PLACES, f"of coordinates {where}, which depend on the size")
    at.require(growth > 1 or where != "pytorch_half_pixel", "of coordinates that depend on the size")
    at.require(not at.given.get("antialias", 0) and mode in ("nearest", "linear"), f"of mode {mode}")
    exact = growth.numerator & (growth.numerator - 1) == 0
    at.require(mode == "nearest" or exact, f"by {growth}, of weights that depend on the place by rounding")
    ways = (math.floor, math.ceil) if mode == "linear" else (ROUNDINGS[rounding],)
    places = [(k / growth, PLACES[where](k, float(growth))) for k in range(growth.numerator)]
    offsets = [way(place) - own for way in ways for own, place in places]
    return Step(growth, math.floor(at.extra * growth), min(offsets), max(offsets))


def _growth(at: Along, index: int) -> Fraction:
    """The factor of enlargement."""
    scales = at.numbers(index, at.given.get("scales", ()))
    axes = [int(axis) % 4 for axis in at.given.get("axes", range(4))]
    at.require(len(scales) == len(axes) > 0, "to a size that is fixed")
    growth = Fraction(at.own(scales, axes, 1))
    sound = 0 < growth <= WINDOW_PX and 1 in (growth.numerator, growth.denominator)
    sound = sound and all(scale == 1 or axis >= 2 for scale, axis in zip(scales, axes, strict=True))
    at.require(sound, f"by {times(scales)}")
    return growth


CONVOLUTIONS = {"Conv": 1, "ConvInteger": 1, "QLinearConv": 3}
"""Operator and the index of its weights among the inputs."""

STEPS: dict[str, Callable[[Along], Step]] = {
    **dict.fromkeys((*CONVOLUTIONS, "AveragePool", "LpPool", "MaxPool", "QLinearAveragePool"), _slide),
    **dict.fromkeys(("DepthToSpace", "SpaceToDepth"), _shuffle),
    **dict.fromkeys(("Resize", "Upsample"), _resize),
    "ConvTranspose": _transpose,
    "Pad": _pad,
    "Slice": _slice,
}
"""What reads other pixels than the one in its own place; the image is its first input."""


def refused(expected: str, got: str) -> ModelError:
    """What is raised of a network that cannot be tiled."""
    return ModelError(
        "tiled model",
        expected=expected,
        got=got,
        remedy="give a network of near pixels alone, one image in and one out",
    )
