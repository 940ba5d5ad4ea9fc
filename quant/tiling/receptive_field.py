"""Determine how the image of a network may be cut into tiles that give the result of the whole
image, bit for bit.

`tiling_of` defines this contract. Cut tiles at multiples of `alignment_px`. Read each with
`halo_px` around the part that is kept, less only where the image ends. Extend the image at the
bottom and right to a multiple of `alignment_px` first, and to `min_side_px`. Then a kept pixel is
computed from the same numbers in the same places as in the whole image, including the zeros that
layers pad with. The output is `scale` times the image's size. (A runtime's float sums are the same
too if it adds in one order: onnxruntime changes that for maps of fewer than some 80 pixels a
thread, see docs/explanation/tiling.md.)

The graph is traversed forwards and backwards, once for the rows and once for the columns. The
forward pass computes the number of pixels of each tensor per pixel of the image, which is a
fraction behind a pool or a stride. The lattice is the least common multiple of the denominators.
The backward pass computes which pixels of each tensor one cell of the lattice reads. The halo
extends to the farthest of them: a tile ends there too, and the layers behind pad at its end.

A network is rejected, with the node's name, if a node does not do the same at every period of the
lattice, from near pixels alone. Examples are ranges and means over the image, fully connected
layers, fixed sizes and constants that differ from pixel to pixel. Others are enlargements whose
weights depend on the place by rounding (a third has no exact float).
"""

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from onnx import ModelProto, TypeProto

from beers_deploy.profiles.errors import ModelError, counted
from beers_deploy.profiles.rounding import up_to_multiple
from beers_deploy.quant.graph.pixel_shuffle import MOVES, with_shuffles
from beers_deploy.quant.onnx.elementwise import ELEMENTWISE
from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.onnx.messages import sizes_of
from beers_deploy.quant.onnx_file import faults_named
from beers_deploy.quant.session import open_session, result_of
from beers_deploy.quant.tiling.axis_maps import AXIS_MAPS, AxisMap, AxisNode, not_tileable
from beers_deploy.quant.untrusted import contradictions


@dataclass(frozen=True)
class Tiling:
    """How an image may be cut into tiles for a network, so that the result equals that of the whole
    image.

    The description of the module states the procedure.

    Attributes:
        halo_px: the number of pixels around the kept part of a tile that must be read too: the
            receptive radius, rounded up to a multiple of `alignment_px`.
        alignment_px: tiles begin and end at multiples of this number of pixels; 1 without strides.
        scale: the number of pixels of the output for one of the image, along either side.
        channels_in: the number of bands that the network reads jointly.
        channels_out: the number of bands that it returns.
        fixed_px: the side of the image that the network is fixed to; None if it accepts any size.
        min_side_px: the shortest side of an image that it accepts: one pixel more than it mirrors
            at a border.
        reads_whole: why each pixel depends on the whole tile, so that no halo gives the result of
            the whole image; empty otherwise.
    """

    halo_px: int
    alignment_px: int = 1
    scale: Fraction = Fraction(1)
    channels_in: int = 1
    channels_out: int = 1
    fixed_px: int | None = None
    min_side_px: int = 1
    reads_whole: str = ""

    def whole_px(self, side_px: int) -> int:
        """Return the length in pixels to which a side of an image is extended, at the bottom or
        right, before it is cut.

        Args:
            side_px: the length of the side.
        """
        return up_to_multiple(max(side_px, self.min_side_px), self.alignment_px)

    @property
    def words(self) -> str:
        """A description of bands, scale and alignment for messages."""
        bands = f"of {counted(self.channels_in, 'band')} in and {self.channels_out} out"
        return (
            f"{bands}, a result of {self.scale} times the image's size and tiles of "
            f"multiples of {self.alignment_px} px"
        )


def tiling_of(model: ModelProto, where: str = "") -> Tiling:
    """Determine how an image may be cut into tiles for a network, float or INT8.

    Args:
        model: the network.
        where: the name of the network for messages, such as that of its file.

    Raises:
        ModelError: the network cannot be tiled; the message names the node that prevents it.
    """
    with faults_named(where), contradictions(where or "the network"):
        fixed_px = fixed_tile_px(model)
        graph = with_shuffles(model)
        rows, columns = (_Walk(graph, axis) for axis in (0, 1))
        channels_in, channels_out = _channels(graph)
        alignment_px = math.lcm(rows.alignment_px, columns.alignment_px)
        radius_px = max(rows.radius_px, columns.radius_px)
        if rows.scale != columns.scale:
            raise not_tileable(
                "it must scale rows and columns by one factor, but the factors are "
                f"{rows.scale} and {columns.scale}"
            )
        if fixed_px is not None and fixed_px % alignment_px:
            raise not_tileable(
                f"the side of a tile must be a multiple of {alignment_px} pixels, but the network "
                f"is fixed to {fixed_px} pixels"
            )
        # A tile begins and ends on the lattice, so its context does too.
        halo_px = up_to_multiple(radius_px, alignment_px)
        min_side_px = max(rows.min_side_px, columns.min_side_px)
        return Tiling(
            halo_px, alignment_px, rows.scale, channels_in, channels_out, fixed_px, min_side_px
        )


def independent_tiles(model: ModelProto, fault: ModelError) -> Tiling:
    """Return the geometry of a network that cannot be tiled exactly, such as by squeeze and excite,
    but is fixed to the size of one tile. Its tiles are restored independently: the radius is the
    tile.

    Args:
        model: the network.
        fault: why `tiling_of` refused it.

    Raises:
        ModelError: `fault`, if the network accepts any size, or makes no square map of its tile.
    """
    fixed_px = fixed_tile_px(model)
    if fixed_px is None or len(model.graph.output) != 1:
        raise fault
    channels_in, _ = _channels(OnnxGraph(model))
    # Not every file states the size of its result.
    image = np.zeros((1, channels_in, fixed_px, fixed_px), np.float32)
    shape = result_of(open_session(model), image).shape
    if len(shape) != 4 or shape[2] != shape[3]:
        raise fault
    scale = Fraction(shape[2], fixed_px)
    return Tiling(fixed_px, 1, scale, channels_in, shape[1], fixed_px, reads_whole=str(fault))


def _channels(graph: OnnxGraph) -> tuple[int, int]:
    """Return the number of channels of the image and of the result."""
    if len(graph.outputs) != 1:
        raise not_tileable(f"it must have one output, but it has {len(graph.outputs)}")
    (sizes,) = graph.inputs.values()
    (result,) = graph.outputs
    result_sizes = graph.result_sizes[result]
    if len(result_sizes) != 4 or not result_sizes[1]:
        result_sizes = sizes_of(graph.tensor_types().get(result, TypeProto.Tensor()))
    # Where neither file nor inference states it, as with a runtime's own operators, the output is
    # judged when it is computed.
    stated = result_sizes[1] if len(result_sizes) == 4 else 0
    return sizes[1], stated or sizes[1]


PERIOD = 1024
"""The maximum number of pixels of a lattice, and of a tensor's within one; practical networks stay
far below.
"""


@dataclass(frozen=True)
class _Grid:
    """The number of pixels of a tensor along one side: pixels per pixel of the image, plus an
    excess.

    The excess (or deficit) comes from padding, until windows use it up or it is cropped.
    """

    per_px: Fraction
    extra: int

    def in_cell(self, alignment_px: int) -> int:
        """Return the number of pixels of the tensor in one cell of the lattice."""
        return int(self.per_px * alignment_px)

    def reach_px(self, first: int, last: int, alignment_px: int) -> int:
        """Return how far beyond the lattice's first cell a tile must extend to include these
        pixels.
        """
        end_px = math.ceil((last - self.extra + 1) / self.per_px)
        return max(-math.floor(first / self.per_px), end_px - alignment_px)


class _Walk:
    """Traverses the graph along one side: forwards from the image, and backwards from a cell of the
    lattice.
    """

    def __init__(self, graph: OnnxGraph, axis: int) -> None:
        self._graph = graph
        self._axis = axis
        self._shapes = {name: value.shape for name, value in graph.constants.items()}
        self._grids = dict.fromkeys(graph.inputs, _Grid(Fraction(1), 0))
        self._steps: list[tuple[Node, AxisMap]] = []
        self.min_side_px = 1
        for node in graph.nodes:
            self._visit(node)
        output = graph.outputs[0]
        if output not in self._grids:
            raise not_tileable("its output must depend on the image, but it is constant")
        self.scale = self._grids[output].per_px
        extra = self._grids[output].extra
        if extra:
            raise not_tileable(
                "its output must have the image's size or a multiple of it, but it has "
                f"{extra:+d} pixels a side"
            )
        self.alignment_px = math.lcm(*(grid.per_px.denominator for grid in self._grids.values()))
        period = max(
            self.alignment_px, *(grid.in_cell(self.alignment_px) for grid in self._grids.values())
        )
        if period > PERIOD:
            raise not_tileable(
                f"it must repeat within {PERIOD} pixels, but its period is {period} pixels"
            )
        self.radius_px = self._radius_px(output)

    def _visit(self, node: Node) -> None:
        grids = [self._grids[name] for name in node.inputs if name in self._grids]
        at = AxisNode(node, self._axis, grids[0].extra if grids else 0, self._graph, self._shapes)
        if grids:
            if node.op_type in AXIS_MAPS:
                at.require(
                    node.source in self._grids and len(grids) == 1,
                    "has parameters that the image determines",
                )
                at.require(len(list(filter(None, node.outputs))) == 1, "returns positions as well")
                step = AXIS_MAPS[node.op_type](at)
            else:
                _require_pointwise(at)
                at.require(len(set(grids)) == 1, "combines tensors of different sizes")
                step = AxisMap(Fraction(1), at.extra)
            at.require(step.growth > 0, "has no positive stride")
            self._steps.append((node, step))
            self._grids.update(
                dict.fromkeys(node.outputs, _Grid(grids[0].per_px * step.growth, step.extra))
            )
            if step.mirrored:
                side_px = math.ceil((1 + step.mirrored) / grids[0].per_px)
                self.min_side_px = max(self.min_side_px, side_px)
        else:
            # A board's file dequantises its weights by such nodes.
            at.require(node.op_type in KEEPING, "reads constants only (fold them)")
            self._shapes[node.result] = self._shapes[node.source]

    def _radius_px(self, output: str) -> int:
        """Return how far the pixels on which a cell of the lattice depends extend beyond
        that cell.
        """
        ranges = {output: (0, self._grids[output].in_cell(self.alignment_px) - 1)}
        # A tensor's readers stand behind its writer, so backwards each range is complete when the
        # node that writes the tensor is reached.
        for node, step in reversed(self._steps):
            result_ranges = [ranges[name] for name in node.outputs if name in ranges]
            if not result_ranges:
                continue
            first, last = _hull(result_ranges)
            for name in node.inputs:
                if name not in self._grids:
                    continue
                grid = self._grids[name]
                size = grid.in_cell(self.alignment_px) + grid.extra
                ends = step.reads(first, last, size)
                ranges[name] = _hull([ends, ranges.get(name, ends)])
        # Inner tensors count too: a tile ends at each of them, and the layers behind pad there.
        return max(
            self._grids[name].reach_px(*ends, self.alignment_px) for name, ends in ranges.items()
        )


def _hull(ranges: list[tuple[int, int]]) -> tuple[int, int]:
    return min(first for first, _ in ranges), max(last for _, last in ranges)


def _require_pointwise(at: AxisNode) -> None:
    kind = at.node.op_type
    if kind in AXES:
        at.require(at.attribute("axis", AXES[kind]) in (1, -3), "does not work along the channels")
    elif kind == "Gather":
        # Our host files have an activation by itself as a table, and in front of a core that reads
        # several channels at a lower resolution they change the order of channels.
        table, order = (len(at.shapes.get(name, ())) for name in at.node.inputs)
        is_order = (table, order, at.attribute("axis", 0)) == (0, 1, 1)
        at.require(is_order or (table, at.attribute("axis", 0)) == (1, 0), "moves pixels")
    elif kind.startswith("Reduce"):
        axes = {axis % 4 for axis in at.numbers(1, "axes")}
        is_of_channels = axes == {1} and at.attribute("keepdims", 1)
        at.require(is_of_channels, "reads the whole image")
    else:
        why = next(
            (why for why, marks in WHY.items() if any(mark in kind for mark in marks)),
            "is not known to do so",
        )
        at.require(kind in ELEMENTWISE, why)
        flat = all(set(at.shapes.get(name, ())[-2:]) <= {1} for name in at.node.inputs)
        at.require(flat, "has a constant that differs from pixel to pixel")


AXES = {
    **dict.fromkeys(("BatchNormalization", "DequantizeLinear", "QuantizeLinear"), 1),
    **dict.fromkeys(("Concat", "QLinearConcat", "Softmax", "Split"), 0),
}
"""Operators that are point-wise if they work along the channels, or have one number per channel;
and the axis if none is stated.
"""
KEEPING = {"BatchNormalization", "Cast", "DequantizeLinear", "Identity", "QuantizeLinear"}
"""Operators that do not change the shape of constants."""
WHY = {
    "reads the whole image": ("Dynamic", "Global", "Normalization", "Shape"),
    "is fully connected": ("Flatten", "Gemm", "MatMul"),
    "moves pixels": tuple(MOVES),
}
"""The reasons why an operator is rejected, by parts of its name."""
