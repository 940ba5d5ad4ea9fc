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
    """

    factors: tuple[float, ...]
    mode: str
    where: str
    rounding: str

    @classmethod
    def of(cls, node: Node, graph: OnnxGraph) -> "Resizing":
        """Read what a Resize or Upsample node states in its attributes and inputs.

        Args:
            node: the node.
            graph: the graph that the node belongs to, which knows constant inputs.
        """
        # Before opset 11 the factors are the second input, and places start at the corner.
        old = node.op_type == "Upsample" or len(node.inputs) == 2
        attribute = node.attributes.get
        scales = graph.numbers(node, 1 if old else 2, "scales") or []
        axes = [axis % 4 for axis in attribute("axes", range(4))]
        factors = dict(zip(axes, scales, strict=bool(scales)))
        return cls(
            tuple(factors.get(axis, 1.0) for axis in range(4)) if factors else (),
            attribute("mode", "nearest"),
            attribute("coordinate_transformation_mode", "asymmetric" if old else "half_pixel"),
            attribute("nearest_mode", "floor" if old else "round_prefer_floor"),
        )

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
