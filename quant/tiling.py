"""How a network's image may be cut into tiles that give the whole image's result, bit for bit.

The contract, of `tiling_of`: cut tiles at multiples of `lattice_px`; read each with `halo_px` around what is kept of
it, less only where the image ends; extend the image at the bottom and right to a multiple of `lattice_px` first.
Then a kept pixel is computed from the same numbers in the same places as in the whole image, the zeros that layers
pad with included, and the output is `scale` times the image's size. (A runtime's float sums are the same too where
it adds in one order: onnxruntime changes that for maps of fewer than some 128 pixels.)

It is found by a walk along the graph, once for the rows and once for the columns. For each tensor it carries how
many pixels it has for one of the image (a fraction behind a pool or a stride), and for each of its pixels within one
period of the lattice the first and the last image pixel that it depends on. To these belongs the pixel's own place:
a tile ends there too, and the layers behind pad at its end.

Refused, with the node's name, is what does not do the same at every period of the lattice, from near pixels alone:
ranges and means over the image, fully connected layers, sizes that are fixed, enlargements whose weights depend on
the place by rounding (a third has no exact float), and constants that differ from pixel to pixel.
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
from quant.untrusted import contradictions, times


@dataclass(frozen=True)
class Tiling:
    """How a network meets an image (see the module's own words).

    Attributes:
        halo_px: context around what is kept of a tile: the receptive radius, rounded up to the lattice.
        lattice_px: tiles begin and end at multiples of it; 1 without strides.
        scale: pixels of the output for one of the image, along either side.
        channels_in: bands that the network reads together.
        channels_out: bands that it gives.
    """

    halo_px: int
    lattice_px: int = 1
    scale: Fraction = Fraction(1)
    channels_in: int = 1
    channels_out: int = 1


def receptive_radius_px(model: onnx.ModelProto) -> int:
    """The farthest input pixel that an output pixel depends on, in pixels, rounded up to the network's lattice.

    Raises:
        ModelError: a network that cannot be tiled.
    """
    return tiling_of(model).halo_px


def tiling_of(model: onnx.ModelProto) -> Tiling:
    """How an image may be tiled for a network, float or INT8.

    Raises:
        ModelError: a network that cannot be tiled; the sentence names the node.
    """
    with contradictions("tiled model"):
        channels_in, channels_out = _channels(model)
        rows, columns = (_Walk(model, side) for side in (ROWS, COLUMNS))
        lattice_px = math.lcm(rows.lattice_px, columns.lattice_px)
        radius_px = max(rows.radius_px, columns.radius_px)
        if rows.scale != columns.scale:
            raise _refused("as many pixels of output along both sides", f"{rows.scale} and {columns.scale}")
        halo_px = -(-radius_px // lattice_px) * lattice_px
        return Tiling(halo_px, lattice_px, rows.scale, channels_in, channels_out)


def _channels(model: onnx.ModelProto) -> tuple[int, int]:
    """Channels of the only image in and the only one out."""
    held = {tensor.name for tensor in model.graph.initializer}
    images = [value for value in model.graph.input if value.name not in held]
    if len(images) != 1 or len(model.graph.output) != 1:
        raise _refused("one image in and one out", f"{len(images)} in and {len(model.graph.output)} out")
    counts = [_channel_count(images[0]), _channel_count(model.graph.output[0])]
    if not all(counts):
        counts[1] = counts[1] or _channel_count(onnx.shape_inference.infer_shapes(model).graph.output[0])
    if not all(counts):
        raise _refused("images (N, C, H, W) of a stated number of channels", f"{counts[0]} in and {counts[1]} out")
    return counts[0], counts[1]


def _channel_count(value: onnx.ValueInfoProto) -> int:
    """0 where it is not stated, or the tensor is no image."""
    sizes = value.type.tensor_type.shape.dim
    return sizes[1].dim_value if len(sizes) == 4 else 0


ROWS, COLUMNS = 0, 1
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
        """The result of an operator that reads this tensor."""
        per_px = self.per_px * step.growth
        lattice_px = self.lattice_px * (per_px * self.lattice_px).denominator
        count = int(per_px * lattice_px)
        if max(lattice_px, count) > PERIOD:
            raise _refused(f"a network that repeats within {PERIOD} pixels", f"a period of {max(lattice_px, count)}")
        ends = [self._ends(step, pixel, per_px) for pixel in range(count)]
        return Reach(per_px, step.extra, lattice_px, *(tuple(side) for side in zip(*ends, strict=True)))

    def _ends(self, step: Step, pixel: int, per_px: Fraction) -> tuple[int, int]:
        read = step.sources(pixel)
        first, last = (math.floor(pixel / per_px), math.ceil((pixel - step.extra + 1) / per_px) - 1)  # its own place
        if read is not None:
            first, last = min(first, self.of(read[0])[0]), max(last, self.of(read[1])[1])
        return first, last


IMAGE = Reach(Fraction(1), 0, 1, (0,), (0,))


def _joined(node: onnx.NodeProto, parts: list[Reach]) -> Reach:
    """What depends on a pixel of each of some tensors."""
    per_px, extra = parts[0].per_px, parts[0].extra
    _require(node, {(part.per_px, part.extra) for part in parts} == {(per_px, extra)}, "of tensors of unequal sizes")
    lattice_px = math.lcm(*(part.lattice_px for part in parts))
    pixels = range(int(per_px * lattice_px))
    _require(node, max(lattice_px, len(pixels)) <= PERIOD, "of lattices that hardly ever meet")
    ends = [[part.of(pixel) for part in parts] for pixel in pixels]
    first, last = (tuple(take(end[i] for end in at) for at in ends) for i, take in ((0, min), (1, max)))
    return Reach(per_px, extra, lattice_px, first, last)


class _Walk:
    """Follows the image along one side, from node to node."""

    def __init__(self, model: onnx.ModelProto, side: int) -> None:
        self.side = side
        self._held = {tensor.name: tensor for tensor in model.graph.initializer}
        self._shapes = {name: tuple(tensor.dims) for name, tensor in self._held.items()}
        self._reach = {value.name: IMAGE for value in model.graph.input if value.name not in self._held}
        seen = [self._visit(node) for node in model.graph.node]
        end = self._reach.get(model.graph.output[0].name)
        if end is None:
            raise _refused("an output that depends on the image", "one of constants alone")
        if end.extra:
            raise _refused("an output of the image's size or a multiple", f"{end.extra:+d} pixels a side")
        self.scale = end.per_px
        self.lattice_px = math.lcm(1, *(reach.lattice_px for reach in seen if reach))
        # Of every tensor, not the output's alone: mirrored borders read as far inside as they reach outside.
        self.radius_px = max((reach.radius_px for reach in seen if reach), default=0)

    def _visit(self, node: onnx.NodeProto) -> Reach | None:
        parts = [self._reach[name] for name in node.input if name in self._reach]
        if not parts:
            self._note_constant(node)
            return None
        given = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        if node.op_type in MOVING:
            _require(node, node.input[0] in self._reach and len(parts) == 1, "steered by the image")
            _require(node, len([name for name in node.output if name]) == 1, "which tells places")
            reach = parts[0].behind(MOVING[node.op_type](node, given, self, parts[0]))
        else:
            self._require_pointwise(node, given)
            reach = _joined(node, parts)
        self._reach.update(dict.fromkeys(node.output, reach))
        return reach

    def _note_constant(self, node: onnx.NodeProto) -> None:
        """What is made of constants alone, such as weights dequantised in a board file."""
        (output,) = node.output
        if node.op_type == "Constant":
            self._held.update((output, a.t) for a in node.attribute if a.name == "value")
            self._shapes[output] = tuple(self._held[output].dims) if output in self._held else ()
            return
        _require(node, node.op_type in PER_CHANNEL | {"Cast", "Identity"}, "of constants alone: fold them")
        self._shapes[output] = self._shapes[node.input[0]]

    def _require_pointwise(self, node: onnx.NodeProto, given: dict[str, Any]) -> None:
        if node.op_type in OVER_CHANNELS:
            _require(node, given.get("axis", 0) in (1, -3), "along other sides than the channels")
        elif node.op_type in PER_CHANNEL:
            _require(node, given.get("axis", 1) in (1, -3), "along other sides than the channels")
        elif node.op_type == "Gather":  # an activation as a table
            table = self._shapes.get(node.input[0], ())
            _require(node, len(table) == 1 and given.get("axis", 0) == 0, "which moves pixels")
        else:
            _require(node, node.op_type in POINTWISE, WHY.get(node.op_type, "of which it is not known"))
            flat = all(set(self.shape(name)[-2:]) <= {1} for name in node.input)
            _require(node, flat, "with a constant that differs from pixel to pixel")

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of a constant; none of anything else."""
        return self._shapes.get(name, ())

    def numbers(self, node: onnx.NodeProto, index: int, otherwise: Iterable[float]) -> list[Any]:
        """The values of a constant input, or what they are where there is none."""
        if len(node.input) <= index or not node.input[index]:
            return list(otherwise)
        _require(node, node.input[index] in self._held, "whose sizes are computed: fold them")
        values = np.ravel(numpy_helper.to_array(self._held[node.input[index]]))
        _require(node, values.size <= 16, "whose sizes are many")
        return list(values.tolist())


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


def _slide(node: onnx.NodeProto, given: dict[str, Any], walk: _Walk, source: Reach) -> Step:
    """Convolutions and pools."""
    if node.op_type in CONVOLUTIONS:
        kernel = walk.shape(node.input[CONVOLUTIONS[node.op_type]])[2:]
    else:
        kernel = tuple(given["kernel_shape"])
    sound = len(kernel) == 2 and not given.get("channels_last", 0)
    _require(node, sound, "which has no constant window of rows and columns")
    side, size = walk.side, kernel[walk.side]
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
    _require(node, kind in (b"NOTSET", b"VALID"), "of an unknown padding")
    pads = given.get("pads", [0, 0, 0, 0]) if kind == b"NOTSET" else [0, 0, 0, 0]
    return pads[side], pads[side + 2]


def _transposed(node: onnx.NodeProto, given: dict[str, Any], walk: _Walk, source: Reach) -> Step:
    """A transposed convolution: pixel k of the result reads where a window that was put down covers it."""
    kernel, side = walk.shape(node.input[1])[2:], walk.side
    _require(node, len(kernel) == 2, "which has no constant window of rows and columns")
    sound = "output_shape" not in given and given.get("auto_pad", b"NOTSET") == b"NOTSET"
    _require(node, sound, "of a fixed or automatic size")
    stride, dilation = (given.get(name, [1, 1])[side] for name in ("strides", "dilations"))
    pads, behind = given.get("pads", [0, 0, 0, 0]), given.get("output_padding", [0, 0])[side]
    extent = (kernel[side] - 1) * dilation + 1
    extra = (source.extra - 1) * stride + extent + behind - pads[side] - pads[side + 2]

    def sources(pixel: int) -> tuple[int, int] | None:
        taps = [pixel + pads[side] - dilation * tap for tap in range(kernel[side])]
        read = [tap // stride for tap in taps if tap % stride == 0]
        return (min(read), max(read)) if read else None

    return Step(Fraction(stride), extra, sources)


def _shuffle(node: onnx.NodeProto, given: dict[str, Any], walk: _Walk, source: Reach) -> Step:  # noqa: ARG001
    """Channels become squares of pixels, or squares of pixels channels."""
    size = int(given["blocksize"])
    if node.op_type == "DepthToSpace":
        return Step(Fraction(size), source.extra * size, lambda pixel: (pixel // size, pixel // size))
    _require(node, source.extra % size == 0, "of squares that do not fit")
    return Step(Fraction(1, size), source.extra // size, lambda pixel: (pixel * size, pixel * size + size - 1))


def _pad(node: onnx.NodeProto, given: dict[str, Any], walk: _Walk, source: Reach) -> Step:
    """Padding by itself; less than none cuts off."""
    _require(node, given.get("mode", b"constant") != b"wrap", "which joins opposite borders")
    pads = walk.numbers(node, 1, given.get("pads", ()))
    axes = [int(axis) % 4 for axis in walk.numbers(node, 3, range(4))]
    _require(node, len(pads) == 2 * len(axes), "of an unknown padding")
    by_axis = dict(zip(axes, zip(pads[: len(axes)], pads[len(axes) :], strict=True), strict=True))
    return _window(1, 1, 1, by_axis.get(2 + walk.side, (0, 0)), source)


FAR = 1 << 30
"""An end of a slice that stands for the image's own."""


def _slice(node: onnx.NodeProto, given: dict[str, Any], walk: _Walk, source: Reach) -> Step:
    """A part that is counted from the borders, or every n-th pixel."""
    starts, ends = walk.numbers(node, 1, given.get("starts", ())), walk.numbers(node, 2, given.get("ends", ()))
    axes = [int(axis) % 4 for axis in walk.numbers(node, 3, given.get("axes", range(len(starts))))]
    steps = walk.numbers(node, 4, [1] * len(starts))
    if 2 + walk.side not in axes:
        return _window(1, 1, 1, (0, 0), source)
    start, end, step = (values[axes.index(2 + walk.side)] for values in (starts, ends, steps))
    _require(node, start >= 0 and step > 0 and (end < 0 or end >= FAR), "which cuts at a place that is fixed")
    return _window(1, step, 1, (-start, min(end, 0)), source)


COORDINATES = {b"asymmetric": Fraction(0), b"half_pixel": Fraction(1, 2), b"pytorch_half_pixel": Fraction(1, 2)}
"""Where a pixel's middle is taken to be. Others depend on the image's size."""
NEAREST: dict[bytes, Callable[[Fraction], int]] = {
    b"floor": math.floor,
    b"ceil": math.ceil,
    b"round_prefer_floor": lambda place: math.ceil(place - Fraction(1, 2)),
    b"round_prefer_ceil": lambda place: math.floor(place + Fraction(1, 2)),
}


def _resize(node: onnx.NodeProto, given: dict[str, Any], walk: _Walk, source: Reach) -> Step:
    """Enlarging by whole factors, or taking every 2nd, 4th, ... pixel; linear where all weights are exact floats."""
    old = node.op_type == "Upsample" or len(node.input) == 2  # before opset 11
    growth = _growth(node, given, walk, 1 if old else 2)
    mode = given.get("mode", b"nearest")
    coordinates = given.get("coordinate_transformation_mode", b"asymmetric" if old else b"half_pixel")
    rounding = given.get("nearest_mode", b"floor" if old else b"round_prefer_floor")
    _require(node, coordinates in COORDINATES, f"of coordinates {coordinates.decode()}, which depend on the size")
    _require(node, growth > 1 or coordinates != b"pytorch_half_pixel", "of coordinates that depend on the size")
    _require(node, not given.get("antialias", 0) and mode in (b"nearest", b"linear"), f"of mode {mode.decode()}")
    exact = growth.numerator & (growth.numerator - 1) == 0
    _require(node, mode == b"nearest" or exact, f"by {growth}, of weights that depend on the place by rounding")
    middle = COORDINATES[coordinates]

    def sources(pixel: int) -> tuple[int, int]:
        place = (pixel + middle) / growth - middle
        if mode == b"nearest":
            return NEAREST[rounding](place), NEAREST[rounding](place)
        return math.floor(place), math.ceil(place)

    return Step(growth, math.floor(source.extra * growth), sources)


def _growth(node: onnx.NodeProto, given: dict[str, Any], walk: _Walk, index: int) -> Fraction:
    """The factor of enlargement along the walk's side."""
    scales = walk.numbers(node, index, given.get("scales", ()))
    axes = [int(axis) % 4 for axis in given.get("axes", range(4))]
    _require(node, len(scales) == len(axes) > 0, "to a size that is fixed")
    by_axis = dict(zip(axes, (Fraction(scale) for scale in scales), strict=True))
    growth = by_axis.get(2 + walk.side, Fraction(1))
    whole = growth > 0 and 1 in (growth.numerator, growth.denominator)
    _require(node, whole and {by_axis.get(0, 1), by_axis.get(1, 1)} == {1}, f"by {times(scales)}")
    return growth


CONVOLUTIONS = {"Conv": 1, "ConvInteger": 1, "QLinearConv": 3}
"""Operator and the index of its weights among the inputs."""

MOVING: dict[str, Callable[[onnx.NodeProto, dict[str, Any], _Walk, Reach], Step]] = {
    **dict.fromkeys((*CONVOLUTIONS, "AveragePool", "LpPool", "MaxPool", "QLinearAveragePool"), _slide),
    **dict.fromkeys(("DepthToSpace", "SpaceToDepth"), _shuffle),
    **dict.fromkeys(("Resize", "Upsample"), _resize),
    "ConvTranspose": _transposed,
    "Pad": _pad,
    "Slice": _slice,
}
"""What reads other pixels than the one in its own place; the image is its first input."""

POINTWISE = {
    "Abs", "Add", "And", "Cast", "Ceil", "Celu", "Clip", "Div", "Dropout", "Elu", "Equal", "Erf", "Exp", "Floor",
    "Gelu", "Greater", "GreaterOrEqual", "HardSigmoid", "HardSwish", "Identity", "LeakyRelu", "Less", "LessOrEqual",
    "Log", "Max", "Mean", "Min", "Mish", "Mul", "Neg", "Not", "Or", "PRelu", "Pow", "QLinearAdd", "QLinearLeakyRelu",
    "QLinearMul", "QLinearSigmoid", "Reciprocal", "Relu", "Round", "Selu", "Sigmoid", "Sign", "Softplus", "Softsign",
    "Sqrt", "Sub", "Sum", "Tanh", "ThresholdedRelu", "Where", "Xor",
}  # fmt: skip
PER_CHANNEL = {"BatchNormalization", "DequantizeLinear", "QuantizeLinear"}
"""Point-wise, with vectors of one number a channel."""
OVER_CHANNELS = {"Concat", "QLinearConcat", "Split"}
"""Point-wise where they work along the channels."""

WHY = {
    **dict.fromkeys(
        (
            "DynamicQuantizeLinear", "GlobalAveragePool", "GlobalMaxPool", "GroupNormalization",
            "InstanceNormalization", "LayerNormalization", "QLinearGlobalAveragePool", "ReduceMax", "ReduceMean",
            "ReduceSum", "Shape",
        ),
        "which looks at the whole image",
    ),
    **dict.fromkeys(("Flatten", "Gemm", "MatMul", "QGemm", "QLinearMatMul"), "fully connected"),
    **dict.fromkeys(("Reshape", "Squeeze", "Transpose", "Unsqueeze"), "which moves pixels"),
}  # fmt: skip


def _require(node: onnx.NodeProto, sound: bool, why: str) -> None:
    if not sound:
        got = f"{node.op_type} {node.name}".strip() + f", {why}"
        raise _refused("operators that do the same at every pixel, from near pixels alone", got)


def _refused(expected: str, got: str) -> ModelError:
    return ModelError("tiled model", expected=expected, got=got, remedy="run it on the whole image instead")
