"""What an operator's pixels read along one side of the image: windows, transposed windows, shuffles, enlargements.

`Reach` is what a tensor's pixels depend on; `STEPS` says of each operator that reads other pixels than the one in its
own place which ones, and `Reach.behind` makes one of both. Sizes are followed as a share of the image's, and what a
tensor has beyond that share: so it does not matter where pixels were padded and where windows used them up.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import onnx
from onnx import numpy_helper

from profiles.errors import ModelError
from quant.untrusted import times

PERIOD = 1024
"""Most pixels of a lattice, and of a tensor's within one: networks of use stay far below."""


@dataclass(frozen=True)
class Step:
    """What an operator does along one side.

    Attributes:
        growth: pixels of its result for one of its source.
        extra: pixels that its result has beyond, or short of, its share of the image.
        sources: the first and the last pixel of the source that pixel k of the result reads; None reads nothing.
    """

    growth: Fraction
    extra: int
    sources: Callable[[int], tuple[int, int] | None]


@dataclass(frozen=True)
class Reach:
    """What a tensor's pixels depend on along one side.

    Attributes:
        per_px: its pixels for one of the image.
        extra: its size less its share of the image: what was padded and not yet used up by windows, or cut off.
        lattice_px: after so many image pixels everything repeats.
        first: the first image pixel that each of its pixels 0, 1, ... within one period depends on.
        last: and the last one.
    """

    per_px: Fraction
    extra: int
    lattice_px: int
    first: tuple[int, ...]
    last: tuple[int, ...]

    @property
    def radius_px(self) -> int:
        """How far what one period depends on reaches beyond it."""
        return max(-min(self.first), max(self.last) - self.lattice_px + 1, 0)

    def of(self, pixel: int) -> tuple[int, int]:
        """The first and the last image pixel that any of its pixels depends on."""
        period, place = divmod(pixel, len(self.first))
        return self.first[place] + period * self.lattice_px, self.last[place] + period * self.lattice_px

    def behind(self, step: Step) -> "Reach":
        """The result of an operator that reads this tensor.

        Raises:
            ModelError: everything repeats too seldom.
        """
        per_px = self.per_px * step.growth
        lattice_px = self.lattice_px * (per_px * self.lattice_px).denominator
        count = int(per_px * lattice_px)
        if max(lattice_px, count) > PERIOD:
            raise refused(f"a network that repeats within {PERIOD} pixels", f"a period of {max(lattice_px, count)}")
        ends = [self._ends(step, pixel, per_px) for pixel in range(count)]
        return Reach(per_px, step.extra, lattice_px, *(tuple(side) for side in zip(*ends, strict=True)))

    def _ends(self, step: Step, pixel: int, per_px: Fraction) -> tuple[int, int]:
        read = step.sources(pixel)
        first, last = (math.floor(pixel / per_px), math.ceil((pixel - step.extra + 1) / per_px) - 1)  # its own place
        if read is None:
            return first, last
        # Behind a transposed convolution a later pixel may see farther back; a period later none does.
        (begin, end), period = read, len(self.first)
        first = min(first, *(self.of(k)[0] for k in range(begin, min(end + 1, begin + period))))
        return first, max(last, *(self.of(k)[1] for k in range(max(begin, end + 1 - period), end + 1)))


IMAGE = Reach(Fraction(1), 0, 1, (0,), (0,))


def joined(node: onnx.NodeProto, parts: list[Reach]) -> Reach:
    """What depends on a pixel in the same place of each of some tensors.

    Raises:
        ModelError: they have unequal sizes, or lattices that hardly ever meet.
    """
    per_px, extra = parts[0].per_px, parts[0].extra
    require(node, {(part.per_px, part.extra) for part in parts} == {(per_px, extra)}, "of tensors of unequal sizes")
    lattice_px = math.lcm(*(part.lattice_px for part in parts))
    pixels = range(int(per_px * lattice_px))
    require(node, max(lattice_px, len(pixels)) <= PERIOD, "of lattices that hardly ever meet")
    ends = [[part.of(pixel) for part in parts] for pixel in pixels]
    first, last = (tuple(take(end[i] for end in at) for at in ends) for i, take in ((0, min), (1, max)))
    return Reach(per_px, extra, lattice_px, first, last)


KEEPING = {"BatchNormalization", "Cast", "DequantizeLinear", "Identity", "QuantizeLinear"}
"""What leaves the shape of constants as it is."""


class Constants:
    """The constants of a graph: their shapes, and the values of those that say where pixels go."""

    def __init__(self, model: onnx.ModelProto) -> None:
        self._held = {tensor.name: tensor for tensor in model.graph.initializer}
        self._shapes = {name: tuple(tensor.dims) for name, tensor in self._held.items()}

    def __contains__(self, name: str) -> bool:
        return name in self._held

    def note(self, node: onnx.NodeProto) -> None:
        """What is made of constants alone, such as weights dequantised in a board file.

        Raises:
            ModelError: by an operator that no exporter leaves there.
        """
        (output,) = node.output
        if node.op_type == "Constant":
            self._held.update((output, a.t) for a in node.attribute if a.name == "value")
            self._shapes[output] = tuple(self._held[output].dims) if output in self._held else ()
            return
        require(node, node.op_type in KEEPING, "of constants alone: fold them")
        self._shapes[output] = self._shapes[node.input[0]]

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of a constant; none of anything else."""
        return self._shapes.get(name, ())

    def numbers(self, node: onnx.NodeProto, index: int, otherwise: Iterable[float]) -> list[Any]:
        """The values of a constant input, or what they are where there is none.

        Raises:
            ModelError: they are computed, or too many to say where pixels go.
        """
        if len(node.input) <= index or not node.input[index]:
            return list(otherwise)
        require(node, node.input[index] in self._held, "whose sizes are computed: fold them")
        values = np.ravel(numpy_helper.to_array(self._held[node.input[index]]))
        require(node, values.size <= 16, "whose sizes are many")
        return list(values.tolist())


@dataclass(frozen=True)
class Side:
    """Along which side a walk goes, 0 for the rows and 1 for the columns, and what constants it meets."""

    side: int
    constants: Constants


def _window(
    kernel: int, stride: int, dilation: int, pads: tuple[int, int], source: Reach, ceil: bool = False
) -> Step:
    """A window that slides over its source in steps of `stride`."""
    extent = (kernel - 1) * dilation + 1
    room = source.extra + sum(pads) - extent
    extra = (-(-room // stride) if ceil else room // stride) + 1
    if ceil and (extra - 1) * stride >= source.extra + pads[0]:
        extra -= 1  # a last window that would begin behind the image is left out

    def sources(pixel: int) -> tuple[int, int]:
        first = pixel * stride - pads[0]
        return first, first + extent - 1

    return Step(Fraction(1, stride), extra, sources)


def _slide(node: onnx.NodeProto, given: dict[str, Any], at: Side, source: Reach) -> Step:
    """Convolutions and pools."""
    if node.op_type in CONVOLUTIONS:
        kernel = at.constants.shape(node.input[CONVOLUTIONS[node.op_type]])[2:]
    else:
        kernel = tuple(given["kernel_shape"])
    sound = len(kernel) == 2 and not given.get("channels_last", 0)
    require(node, sound, "which has no constant window of rows and columns")
    side, size = at.side, kernel[at.side]
    stride, dilation = (given.get(name, [1, 1])[side] for name in ("strides", "dilations"))
    pads = _pads(node, given, side, (size - 1) * dilation + 1 - stride, source.extra, stride)
    return _window(size, stride, dilation, pads, source, bool(given.get("ceil_mode", 0)))


def _pads(
    node: onnx.NodeProto, given: dict[str, Any], side: int, same: int, extra: int, stride: int
) -> tuple[int, int]:
    """Padding before and behind; `same` is what keeps a size that is a multiple of the stride."""
    kind = given.get("auto_pad", b"NOTSET")
    if kind in (b"SAME_UPPER", b"SAME_LOWER"):
        total = max(same - extra + -(-extra // stride) * stride, 0)
        less, more = total // 2, total - total // 2
        return (less, more) if kind == b"SAME_UPPER" else (more, less)
    require(node, kind in (b"NOTSET", b"VALID"), "of an unknown padding")
    pads = given.get("pads", [0, 0, 0, 0]) if kind == b"NOTSET" else [0, 0, 0, 0]
    return pads[side], pads[side + 2]


def _transposed(node: onnx.NodeProto, given: dict[str, Any], at: Side, source: Reach) -> Step:
    """A transposed convolution: pixel k of the result reads where a window that was put down covers it."""
    kernel, side = at.constants.shape(node.input[1])[2:], at.side
    require(node, len(kernel) == 2, "which has no constant window of rows and columns")
    sound = "output_shape" not in given and given.get("auto_pad", b"NOTSET") == b"NOTSET"
    require(node, sound, "of a fixed or automatic size")
    stride, dilation = (given.get(name, [1, 1])[side] for name in ("strides", "dilations"))
    pads, behind = given.get("pads", [0, 0, 0, 0]), given.get("output_padding", [0, 0])[side]
    extent = (kernel[side] - 1) * dilation + 1
    extra = (source.extra - 1) * stride + extent + behind - pads[side] - pads[side + 2]

    def sources(pixel: int) -> tuple[int, int] | None:
        taps = [pixel + pads[side] - dilation * tap for tap in range(kernel[side])]
        read = [tap // stride for tap in taps if tap % stride == 0]
        return (min(read), max(read)) if read else None

    return Step(Fraction(stride), extra, sources)


def _shuffle(node: onnx.NodeProto, given: dict[str, Any], at: Side, source: Reach) -> Step:  # noqa: ARG001
    """Channels become squares of pixels, or squares of pixels channels."""
    size = int(given["blocksize"])
    if node.op_type == "DepthToSpace":
        return Step(Fraction(size), source.extra * size, lambda pixel: (pixel // size, pixel // size))
    require(node, source.extra % size == 0, "of squares that do not fit")
    return Step(Fraction(1, size), source.extra // size, lambda pixel: (pixel * size, pixel * size + size - 1))


def _pad(node: onnx.NodeProto, given: dict[str, Any], at: Side, source: Reach) -> Step:
    """Padding by itself; less than none cuts off."""
    require(node, given.get("mode", b"constant") != b"wrap", "which joins opposite borders")
    pads = at.constants.numbers(node, 1, given.get("pads", ()))
    axes = [int(axis) % 4 for axis in at.constants.numbers(node, 3, range(4))]
    require(node, len(pads) == 2 * len(axes), "of an unknown padding")
    by_axis = dict(zip(axes, zip(pads[: len(axes)], pads[len(axes) :], strict=True), strict=True))
    return _window(1, 1, 1, by_axis.get(2 + at.side, (0, 0)), source)


FAR = 1 << 30
"""An end of a slice that stands for the image's own."""


def _slice(node: onnx.NodeProto, given: dict[str, Any], at: Side, source: Reach) -> Step:
    """A part that is counted from the borders, or every n-th pixel."""
    starts, ends = (
        at.constants.numbers(node, 1, given.get("starts", ())),
        at.constants.numbers(node, 2, given.get("ends", ())),
    )
    axes = [int(axis) % 4 for axis in at.constants.numbers(node, 3, given.get("axes", range(len(starts))))]
    steps = at.constants.numbers(node, 4, [1] * len(starts))
    if 2 + at.side not in axes:
        return _window(1, 1, 1, (0, 0), source)
    start, end, step = (values[axes.index(2 + at.side)] for values in (starts, ends, steps))
    require(node, start >= 0 and step > 0 and (end < 0 or end >= FAR), "which cuts at a place that is fixed")
    return _window(1, step, 1, (-start, min(end, 0)), source)


COORDINATES = {b"asymmetric": Fraction(0), b"half_pixel": Fraction(1, 2), b"pytorch_half_pixel": Fraction(1, 2)}
"""Where a pixel's middle is taken to be. Others depend on the image's size."""
NEAREST: dict[bytes, Callable[[Fraction], int]] = {
    b"floor": math.floor,
    b"ceil": math.ceil,
    b"round_prefer_floor": lambda place: math.ceil(place - Fraction(1, 2)),
    b"round_prefer_ceil": lambda place: math.floor(place + Fraction(1, 2)),
}


def _resize(node: onnx.NodeProto, given: dict[str, Any], at: Side, source: Reach) -> Step:
    """Enlarging by whole factors, or taking every 2nd, 4th, ... pixel; linear where all weights are exact floats."""
    old = node.op_type == "Upsample" or len(node.input) == 2  # before opset 11
    growth = _growth(node, given, at, 1 if old else 2)
    mode = given.get("mode", b"nearest")
    coordinates = given.get("coordinate_transformation_mode", b"asymmetric" if old else b"half_pixel")
    rounding = given.get("nearest_mode", b"floor" if old else b"round_prefer_floor")
    require(node, coordinates in COORDINATES, f"of coordinates {coordinates.decode()}, which depend on the size")
    require(node, growth > 1 or coordinates != b"pytorch_half_pixel", "of coordinates that depend on the size")
    require(node, not given.get("antialias", 0) and mode in (b"nearest", b"linear"), f"of mode {mode.decode()}")
    exact = growth.numerator & (growth.numerator - 1) == 0
    require(node, mode == b"nearest" or exact, f"by {growth}, of weights that depend on the place by rounding")
    middle = COORDINATES[coordinates]

    def sources(pixel: int) -> tuple[int, int]:
        place = (pixel + middle) / growth - middle
        if mode == b"nearest":
            return NEAREST[rounding](place), NEAREST[rounding](place)
        return math.floor(place), math.ceil(place)

    return Step(growth, math.floor(source.extra * growth), sources)


def _growth(node: onnx.NodeProto, given: dict[str, Any], at: Side, index: int) -> Fraction:
    """The factor of enlargement along the walk's side."""
    scales = at.constants.numbers(node, index, given.get("scales", ()))
    axes = [int(axis) % 4 for axis in given.get("axes", range(4))]
    require(node, len(scales) == len(axes) > 0, "to a size that is fixed")
    by_axis = dict(zip(axes, (Fraction(scale) for scale in scales), strict=True))
    growth = by_axis.get(2 + at.side, Fraction(1))
    whole = growth > 0 and 1 in (growth.numerator, growth.denominator)
    require(node, whole and {by_axis.get(0, 1), by_axis.get(1, 1)} == {1}, f"by {times(scales)}")
    return growth


CONVOLUTIONS = {"Conv": 1, "ConvInteger": 1, "QLinearConv": 3}
"""Operator and the index of its weights among the inputs."""

STEPS: dict[str, Callable[[onnx.NodeProto, dict[str, Any], Side, Reach], Step]] = {
    **dict.fromkeys((*CONVOLUTIONS, "AveragePool", "LpPool", "MaxPool", "QLinearAveragePool"), _slide),
    **dict.fromkeys(("DepthToSpace", "SpaceToDepth"), _shuffle),
    **dict.fromkeys(("Resize", "Upsample"), _resize),
    "ConvTranspose": _transposed,
    "Pad": _pad,
    "Slice": _slice,
}
"""What reads other pixels than the one in its own place; the image is its first input."""


def require(node: onnx.NodeProto, sound: bool, why: str) -> None:
    """Refuse a node that cannot be tiled.

    Raises:
        ModelError: it is not sound.
    """
    if not sound:
        got = f"{node.op_type} {node.name}".strip() + f", {why}"
        raise refused("operators that do the same at every pixel, from near pixels alone", got)


def refused(expected: str, got: str) -> ModelError:
    """What is raised of a network that cannot be tiled."""
    return ModelError("tiled model", expected=expected, got=got, remedy="run it on the whole image instead")
