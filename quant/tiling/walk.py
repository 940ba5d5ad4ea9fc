"""How a network's image may be cut into tiles that give the whole image's result, bit for bit.

The contract, of `tiling_of`: cut tiles at multiples of `lattice_px`; read each with `halo_px` around what is kept of
it, less only where the image ends; extend the image at the bottom and right to a multiple of `lattice_px` first, and
to `least_px`.
Then a kept pixel is computed from the same numbers in the same places as in the whole image, the zeros that layers
pad with included, and the output is `scale` times the image's size. (A runtime's float sums are the same too where
it adds in one order: onnxruntime changes that for maps of fewer than some 80 pixels a thread, see
docs/explanation/tiling.md.)

It is found by a walk along the graph, once for the rows and once for the columns. For each tensor it carries how
many pixels it has for one of the image (a fraction behind a pool or a stride), and for each of its pixels within one
period of the lattice the first and the last image pixel that it depends on. To these belongs the pixel's own place:
a tile ends there too, and the layers behind pad at its end.

Refused, with the node's name, is what does not do the same at every period of the lattice, from near pixels alone:
ranges and means over the image, fully connected layers, sizes that are fixed, enlargements whose weights depend on
the place by rounding (a third has no exact float), and constants that differ from pixel to pixel.
"""

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import onnx

from quant.onnx_file import fixed_tile_px
from quant.tiling.reach import IMAGE, STEPS, Constants, Reach, Side, joined, refused, require
from quant.tiling.spelled_out import with_shuffles
from quant.untrusted import contradictions


@dataclass(frozen=True)
class Tiling:
    """How a network meets an image (see the module's own words).

    Attributes:
        halo_px: context around what is kept of a tile: the receptive radius, rounded up to the lattice.
        lattice_px: tiles begin and end at multiples of it; 1 without strides.
        scale: pixels of the output for one of the image, along either side.
        channels_in: bands that the network reads together.
        channels_out: bands that it gives.
        fixed_px: the tile side that the network is fixed to; None where it takes any size.
        least_px: the shortest side that it takes: one pixel more than what it mirrors at a border.
    """

    halo_px: int
    lattice_px: int = 1
    scale: Fraction = Fraction(1)
    channels_in: int = 1
    channels_out: int = 1
    fixed_px: int | None = None
    least_px: int = 1

    def whole_px(self, side_px: int) -> int:
        """What a side of an image is extended to, at the bottom and right."""
        return -(-max(side_px, self.least_px) // self.lattice_px) * self.lattice_px

    @property
    def words(self) -> str:
        """What a message says of it."""
        bands = f"of {self.channels_in} bands in and {self.channels_out} out"
        return (
            f"{bands}, a result of {self.scale} times the image's size and tiles of multiples of {self.lattice_px} px"
        )


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
        plain = with_shuffles(model)
        rows, columns = (_Walk(plain, side) for side in (ROWS, COLUMNS))
        (channels_in, channels_out), fixed_px = _channels(model), fixed_tile_px(model)
        lattice_px = math.lcm(rows.lattice_px, columns.lattice_px)
        radius_px = max(rows.radius_px, columns.radius_px)
        if rows.scale != columns.scale:
            raise refused("as many pixels of output along both sides", f"{rows.scale} and {columns.scale}")
        if fixed_px is not None and fixed_px % lattice_px:
            raise refused(f"tiles of a multiple of {lattice_px} pixels a side", f"a network fixed to {fixed_px}")
        halo_px = -(-radius_px // lattice_px) * lattice_px
        least_px = max(rows.least_px, columns.least_px)
        return Tiling(halo_px, lattice_px, rows.scale, channels_in, channels_out, fixed_px, least_px)


def _channels(model: onnx.ModelProto) -> tuple[int, int]:
    """Channels of the only image in and the only one out."""
    held = {tensor.name for tensor in model.graph.initializer}
    images = [value for value in model.graph.input if value.name not in held]
    if len(images) != 1 or len(model.graph.output) != 1:
        raise refused("one image in and one out", f"{len(images)} in and {len(model.graph.output)} out")
    counts = [_channel_count(images[0]), _channel_count(model.graph.output[0])]
    if not all(counts):
        counts[1] = counts[1] or _channel_count(onnx.shape_inference.infer_shapes(model).graph.output[0])
    if not counts[0]:
        raise refused("an image (N, C, H, W) of a stated number of channels", "none stated")
    # Where neither file nor inference tells, as with a runtime's own operators, what comes out is judged as it comes.
    return counts[0], counts[1] or counts[0]


def _channel_count(value: onnx.ValueInfoProto) -> int:
    """0 where it is not stated, or the tensor is no image."""
    sizes = value.type.tensor_type.shape.dim
    return sizes[1].dim_value if len(sizes) == 4 else 0


ROWS, COLUMNS = 0, 1


class _Walk:
    """Follows the image along one side, from node to node."""

    def __init__(self, model: onnx.ModelProto, side: int) -> None:
        self._at = Side(side, Constants(model))
        self.least_px = 1
        self._reach = {value.name: IMAGE for value in model.graph.input if value.name not in self._at.constants}
        seen = [self._visit(node) for node in model.graph.node]
        end = self._reach.get(model.graph.output[0].name)
        if end is None:
            raise refused("an output that depends on the image", "one of constants alone")
        if end.extra:
            raise refused("an output of the image's size or a multiple", f"{end.extra:+d} pixels a side")
        self.scale = end.per_px
        self.lattice_px = math.lcm(1, *(reach.lattice_px for reach in seen if reach))
        # Of every tensor, not the output's alone: mirrored borders read as far inside as they reach outside.
        self.radius_px = max((reach.radius_px for reach in seen if reach), default=0)

    def _visit(self, node: onnx.NodeProto) -> Reach | None:
        parts = [self._reach[name] for name in node.input if name in self._reach]
        if not parts:
            self._at.constants.note(node)
            return None
        given = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        if node.op_type in STEPS:
            require(node, node.input[0] in self._reach and len(parts) == 1, "steered by the image")
            require(node, len([name for name in node.output if name]) == 1, "which tells places")
            reach = parts[0].behind(STEPS[node.op_type](node, given, self._at, parts[0]))
            if given.get("mode") == b"reflect":
                pads = self._at.constants.numbers(node, 1, given.get("pads", ()))
                self.least_px = max(self.least_px, math.ceil((1 + max(pads)) / parts[0].per_px))
        else:
            self._require_pointwise(node, given)
            reach = joined(node, parts)
        self._reach.update(dict.fromkeys(node.output, reach))
        return reach

    def _require_pointwise(self, node: onnx.NodeProto, given: dict[str, Any]) -> None:
        if node.op_type in OVER_CHANNELS:
            require(node, given.get("axis", 0) in (1, -3), "along other sides than the channels")
        elif node.op_type in PER_CHANNEL:
            require(node, given.get("axis", 1) in (1, -3), "along other sides than the channels")
        elif node.op_type == "Gather":  # an activation as a table
            table = self._at.constants.shape(node.input[0])
            require(node, len(table) == 1 and given.get("axis", 0) == 0, "which moves pixels")
        else:
            require(node, node.op_type in POINTWISE, WHY.get(node.op_type, "of which it is not known"))
            flat = all(set(self._at.constants.shape(name)[-2:]) <= {1} for name in node.input)
            require(node, flat, "with a constant that differs from pixel to pixel")


POINTWISE = {
    "Abs", "Add", "And", "Cast", "Ceil", "Celu", "Clip", "Div", "Dropout", "Elu", "Equal", "Erf", "Exp", "Floor",
    "Gelu", "Greater", "GreaterOrEqual", "HardSigmoid", "HardSwish", "Identity", "LeakyRelu", "Less", "LessOrEqual",
    "Log", "Max", "Mean", "Min", "Mish", "Mul", "Neg", "Not", "Or", "PRelu", "Pow", "QLinearAdd", "QLinearLeakyRelu",
    "QLinearMul", "QLinearSigmoid", "Reciprocal", "Relu", "Round", "Selu", "Sigmoid", "Sign", "Softplus", "Softsign",
    "Sqrt", "Sub", "Sum", "Tanh", "ThresholdedRelu", "Where", "Xor",
}  # fmt: skip
PER_CHANNEL = {"BatchNormalization", "DequantizeLinear", "QuantizeLinear"}
"""Point-wise, with vectors of one number a channel."""
OVER_CHANNELS = {"Concat", "QLinearConcat", "Softmax", "Split"}
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
