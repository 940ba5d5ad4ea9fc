"""Replace the standard deviation over an image, which IMDN's attention (CCA) has, by the mean
absolute deviation, because a DPU computes no root.

    sqrt(mean((x - m)^2)) is about RATIO mean(|x - m|) = 2 RATIO mean(ReLU(x - m))

1. The mean m of each channel is enlarged to the size of the map x, from which it is subtracted.
2. Differences above and below the mean have the same sum, so that those above it are enough.
"""

from dataclasses import dataclass

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.fold_affine import affine_chain

RATIO = (np.pi / 2) ** 0.5
"""The standard deviation over the mean absolute deviation, of normally distributed values."""


@dataclass(frozen=True)
class Deviation:
    """A standard deviation over a square image of known size.

    Attributes:
        root: the node that computes it from the variance.
        source: the name of the map x.
        negative: the name of the mean of x, times -1.
        side_px: the sides of x.
        scale: (C,) or (1,) the factor of the variance.
    """

    root: Node
    source: str
    negative: str
    side_px: int
    scale: np.ndarray

    @classmethod
    def of(cls, graph: OnnxGraph, node: Node) -> "Deviation | None":
        """Return the standard deviation that a node ends; None if it is something else.

        Args:
            graph: the graph that the node belongs to, which knows the sizes of its tensors.
            node: any node; only a root can end one.
        """
        exponent = graph.value(node, 1) if node.op_type == "Pow" else None
        is_root = node.op_type == "Sqrt" or (exponent is not None and exponent.tolist() == 0.5)
        scale, name = _scaled(graph, node.source if is_root else "")
        variance = graph.writers.get(name)
        square = graph.writers.get(variance.source) if variance is not None else None
        if variance is None or variance.op_type != "GlobalAveragePool" or square is None:
            return None
        difference = graph.writers.get(square.source)
        if square.op_type != "Mul" or len(set(square.inputs)) > 1 or difference is None:
            return None
        for source, negative in (difference.inputs, difference.inputs[::-1]):
            mean, affine = affine_chain(graph, negative, is_sole=False)
            pool = graph.writers.get(mean)
            is_mean = (
                pool is not None and pool.op_type == "GlobalAveragePool" and source in pool.inputs
            )
            is_negative = (affine.scale == -1).all() and not affine.shift.any()
            *_, rows, columns = graph.shapes.get(source, (0, 0))
            if is_mean and is_negative and rows == columns:
                return cls(node, source, negative, rows, scale)
        return None

    def nodes(self, graph: OnnxGraph) -> list[Node]:
        """Return the nodes that compute the mean absolute deviation in place of the root.

        Args:
            graph: the graph whose constants are extended.
        """
        result = self.root.result
        names = [f"{result}.{part}" for part in ("mean", "difference", "above", "deviation")]
        wide, difference, above, pooled = names
        scales = graph.add_constant(f"{wide}.scales", np.array([1, 1, self.side_px, self.side_px]))
        factor = 2 * RATIO * np.sqrt(self.scale).reshape(1, -1, 1, 1)
        modes = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
        return [
            Node.new("Resize", [self.negative, "", scales], wide, wide, **modes),
            Node.new("Add", [self.source, wide], difference, difference),
            Node.new("Relu", [difference], above, above),
            Node.new("GlobalAveragePool", [above], pooled, pooled),
            self.root.replaced_by("Mul", [pooled, graph.add_constant(f"{pooled}.factor", factor)]),
        ]


def _scaled(graph: OnnxGraph, name: str) -> tuple[np.ndarray, str]:
    """Return the factor (C,) or (1,) that constants scale a tensor by, and the tensor.

    What they add, against a root of 0, is left out.
    """
    name, affine = affine_chain(graph, name)
    node = graph.writers.get(name)
    weight = graph.value(node, 1) if node is not None and node.op_type == "Conv" else None
    if node is None or weight is None or weight.shape[1:] != (1, 1, 1):
        return affine.scale, name
    return affine.scale * weight.ravel(), node.source
