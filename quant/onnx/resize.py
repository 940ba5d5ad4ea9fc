"""Read Resize nodes of all opsets, with ONNX's defaults filled in."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from beers_deploy.quant.onnx.graph import Node, OnnxGraph

PLACES: dict[str, Callable[[int, float], float]] = {
    "asymmetric": lambda pixel, factor: pixel / factor,
    "half_pixel": lambda pixel, factor: (pixel + 0.5) / factor - 0.5,
    "pytorch_half_pixel": lambda pixel, factor: (pixel + 0.5) / factor - 0.5,
    "tf_half_pixel_for_nn": lambda pixel, factor: (pixel + 0.5) / factor,
}
"""The position in the source of a pixel of an enlarged image.

ONNX's other coordinates depend on the sizes.
"""
ROUNDINGS: dict[str, Callable[[float], int]] = {
    "floor": math.floor,
    "ceil": math.ceil,
    "round_prefer_floor": lambda place: math.ceil(place - 0.5),
    "round_prefer_ceil": lambda place: math.floor(place + 0.5),
}
CUBIC = -0.75
"""The coefficient a of cubic convolution in torch and in ONNX's default."""
BY_2_OR_4: tuple[tuple[float, ...], ...] = ((1, 1, 2, 2), (1, 1, 4, 4))


@dataclass(frozen=True)
class Resizing:
    """An enlargement as a Resize node states it (or an Upsample of older opsets), with ONNX's
    defaults filled in.

    Attributes:
        factors: the factors of N, C, H and W; empty if other nodes compute them, or if a size is
            stated instead.
        mode: the interpolation, in ONNX's words: "nearest", "linear" or "cubic".
        where: ONNX's `coordinate_transformation_mode`, the position of a pixel in the source.
        rounding: ONNX's `nearest_mode`, how a position is rounded to a pixel.
        is_plain: True if cubic weights are ONNX's default, also at the border.
    """

    factors: tuple[float, ...]
    mode: str
    where: str
    rounding: str
    is_plain: bool

    @classmethod
    def of(cls, graph: OnnxGraph, node: Node) -> "Resizing":
        """Read what a Resize or Upsample node states in its attributes and inputs.

        Args:
            graph: the graph that the node belongs to, which knows constant inputs.
            node: the node.
        """
        # Before opset 11 the factors are the second input, and places start at the corner.
        old = node.op_type == "Upsample" or len(node.inputs) == 2
        attribute = node.attribute
        scales = graph.numbers(node, 1 if old else 2, "scales") or []
        axes = [axis % 4 for axis in attribute("axes", range(4))]
        factors = dict(zip(axes, scales, strict=bool(scales)))
        return cls(
            tuple(factors.get(axis, 1.0) for axis in range(4)) if factors else (),
            attribute("mode", "nearest"),
            attribute("coordinate_transformation_mode", "asymmetric" if old else "half_pixel"),
            attribute("nearest_mode", "floor" if old else "round_prefer_floor"),
            attribute("cubic_coeff_a", CUBIC) == CUBIC and not attribute("exclude_outside", 0),
        )

    @property
    def is_half_pixel(self) -> bool:
        """True if the centres of pixels lie at half of their width, as a DPU has them."""
        return self.where in ("half_pixel", "pytorch_half_pixel")

    @property
    def is_nearly_bilinear(self) -> bool:
        """True if bilinear enlargements by 4 and 2 with half-pixel centres, as a DPU has them, are
        near: this one has other centres, such as those of aligned corners, or a larger power of 2.
        """
        by_2_or_4 = self.factors in BY_2_OR_4
        is_power = by_2_or_4 or self.factors in ((1, 1, 8, 8), (1, 1, 16, 16), (1, 1, 32, 32))
        return self.mode == "linear" and is_power and not (by_2_or_4 and self.is_half_pixel)

    def makes_blocks(self, factor: int) -> bool:
        """Return True if nearest interpolation turns each pixel into a block of `factor` x `factor`
        pixels.

        That depends on how positions are computed and rounded. The DPU repeats pixels in this way.
        """
        if self.where not in PLACES or self.rounding not in ROUNDINGS:
            return False
        place = PLACES[self.where]
        rounded = ROUNDINGS[self.rounding]
        return all(rounded(place(k, factor)) == k // factor for k in range(factor))


def enlarged_bilinearly(graph: OnnxGraph, source: str, factor: int, node: Node) -> list[Node]:
    """Return bilinear enlargements by 4 and 2 with half-pixel centres in place of a Resize.

    Args:
        graph: the graph that the Resize belongs to; its constants are extended.
        source: the name of the map that they enlarge.
        factor: the power of 2 by which rows and columns are enlarged.
        node: the Resize, whose name and result the last one has.
    """
    modes = {"mode": "linear", "coordinate_transformation_mode": "pytorch_half_pixel"}
    nodes: list[Node] = []
    enlarged = 1
    while enlarged < factor:
        step = min(4, factor // enlarged)
        enlarged *= step
        is_last = enlarged == factor
        result = node.result if is_last else f"{node.result}.{enlarged}"
        scales = graph.add_constant(f"{result}.scales", [1, 1, step, step])
        name = node.name if is_last else result
        nodes.append(Node.new("Resize", [source, "", scales], result, name, **modes))
        source = result
    return nodes


def enlarges_image(graph: OnnxGraph, node: Node) -> bool:
    """Return True if a node enlarges the image by 2 or 4, bicubically with half-pixel centres.

    Args:
        graph: the graph that the node belongs to.
        node: any node.
    """
    if node.op_type != "Resize":
        return False
    resizing = Resizing.of(graph, node)
    is_cubic = resizing.mode == "cubic" and resizing.is_half_pixel and resizing.is_plain
    return is_cubic and resizing.factors in BY_2_OR_4 and node.source in graph.inputs


def alone_enlarges_image(graph: OnnxGraph, node: Node) -> bool:
    """Return True if a node enlarges the image bicubically, and the network reads the image nowhere
    else but in a sum.

    Args:
        graph: the graph that the node belongs to.
        node: any node.
    """
    readers = graph.readers[node.source]
    is_alone = all(reader is node or reader.op_type == "Add" for reader in readers)
    return is_alone and enlarges_image(graph, node)
