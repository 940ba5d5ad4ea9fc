"""Replace the standard deviation over an image, which IMDN's attention (CCA) has, by the mean
absolute deviation, because a DPU computes no root.

    sqrt(mean((x - m)^2)) is about RATIO mean(|x - m|) = 2 RATIO mean(ReLU(x - m))

1. The mean m of each channel is enlarged to the size of the map x, from which it is subtracted.
2. Differences above and below the mean have the same sum, so that those above it are enough.
"""

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.fold_affine import affine_chain

RATIO = (np.pi / 2) ** 0.5
"""The standard deviation over the mean absolute deviation, of normally distributed values."""


def deviation(graph: OnnxGraph, node: Node) -> list[Node]:
    """Return the nodes that replace a standard deviation over a square image of known size.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node; a root may end a standard deviation.

    Returns:
        The nodes, whose last has the name and the result of the root; empty if it is something
        else.
    """
    exponent = graph.value(node, 1) if node.op_type == "Pow" else None
    is_root = node.op_type == "Sqrt" or (exponent is not None and exponent.tolist() == 0.5)
    name = node.source if is_root else ""
    scale, name = _scaled(graph, name)
    variance = graph.writers.get(name)
    square = graph.writers.get(variance.source) if variance is not None else None
    if variance is None or variance.op_type != "GlobalAveragePool" or square is None:
        return []
    difference = graph.writers.get(square.source)
    if square.op_type != "Mul" or len(set(square.inputs)) > 1 or difference is None:
        return []
    for source, negative in (difference.inputs, difference.inputs[::-1]):
        mean, affine = affine_chain(graph, negative, is_sole=False)
        pool = graph.writers.get(mean)
        is_mean = pool is not None and pool.op_type == "GlobalAveragePool" and source in pool.inputs
        *_, rows, columns = graph.shapes.get(source, (0, 0))
        if is_mean and (affine.scale == -1).all() and not affine.shift.any() and rows == columns:
            return _nodes(graph, node, (source, negative), rows, scale)
    return []


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


def _nodes(
    graph: OnnxGraph, node: Node, operands: tuple[str, str], side_px: int, scale: np.ndarray
) -> list[Node]:
    """Return the nodes of the mean absolute deviation.

    Args:
        graph: the graph whose constants are extended.
        node: the root that they replace.
        operands: the names of the map, and of its mean times -1.
        side_px: the sides of the map.
        scale: (C,) or (1,) the factor of the variance.
    """
    source, negative = operands
    names = [f"{node.result}.{part}" for part in ("mean", "difference", "above", "deviation")]
    wide, difference, above, pooled = names
    scales = graph.add_constant(f"{wide}.scales", np.array([1, 1, side_px, side_px]))
    factor = 2 * RATIO * np.sqrt(scale).reshape(1, -1, 1, 1)
    modes = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
    return [
        Node.new("Resize", [negative, "", scales], wide, wide, **modes),
        Node.new("Add", [source, wide], difference, difference),
        Node.new("Relu", [difference], above, above),
        Node.new("GlobalAveragePool", [above], pooled, pooled),
        node.replaced_by("Mul", [pooled, graph.add_constant(f"{pooled}.factor", factor)]),
    ]
