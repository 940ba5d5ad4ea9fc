"""Spatial attention of RFDN and RLFN (ESA), and the same on whole fractions of a map.

It shrinks a map by an unpadded convolution of stride 2 and an unpadded maximum of stride 3, and
enlarges what convolutions make of that to the map's size: by a factor that is no whole number.

1. Padded, and with a maximum of stride 4, its inner map has an eighth of the sides.
2. Two bilinear enlargements, by 4 and by 2, lead back to the map's size.

That is another function, which `quant.adapt` puts in its place, measures and compensates.
"""

import numpy as np

from beers_deploy.quant.graph.resize import Resizing
from beers_deploy.quant.onnx.graph import Node, OnnxGraph

BETWEEN = {"Conv", "LeakyRelu", "PRelu", "Relu"}
"""What stands between the maximum and the enlargement."""


def shrinking(graph: OnnxGraph, node: Node) -> tuple[Node, Node] | None:
    """Return the strided convolution and the maximum of the attention that a Resize belongs to."""
    if node.op_type != "Resize" or Resizing.of(node, graph).mode != "linear":
        return None
    pool = _writer(graph, node.inputs[0])
    while pool is not None and pool.op_type in BETWEEN:
        pool = _writer(graph, pool.inputs[0])
    conv = None if pool is None else _writer(graph, pool.inputs[0])
    if conv is None or pool is None or (conv.op_type, pool.op_type) != ("Conv", "MaxPool"):
        return None
    weight = graph.value(conv, 1)
    is_known = (
        weight is not None
        and weight.shape[2:] == (3, 3)
        and conv.attributes.get("strides") == [2, 2]
        and pool.attributes.get("kernel_shape") == [7, 7]
        and pool.attributes.get("strides") == [3, 3]
        and not any([*conv.attributes.get("pads", []), *pool.attributes.get("pads", [])])
    )
    return (conv, pool) if is_known else None


def _writer(graph: OnnxGraph, name: str) -> Node | None:
    """Return the node that writes a tensor; None if several nodes read its values."""
    readers = [node for node in graph.readers[name] if node.op_type != "Shape"]
    return graph.writers.get(name) if len(readers) == 1 else None


def aligned(graph: OnnxGraph, node: Node) -> dict[Node, list[Node]]:
    """Return the nodes that take the place of a Resize and of what shrinks; none of another node.

    Args:
        graph: that the node belongs to; its constants are extended.
        node: any node.
    """
    match = shrinking(graph, node)
    if match is None:
        return {}
    conv, pool = match
    # 1. Pads put each value in the middle of the eight pixels that it stands for, or next to it.
    pads = {conv: {"pads": [1, 1, 1, 1]}, pool: {"strides": [4, 4], "pads": [1, 1, 2, 2]}}
    replacements = {
        old: [
            Node.new(old.op_type, old.inputs, old.outputs[0], old.name, **{**old.attributes, **new})
        ]
        for old, new in pads.items()
    }
    # 2.
    inner = f"{node.outputs[0]}.quarter"
    modes = {"mode": "linear", "coordinate_transformation_mode": "pytorch_half_pixel"}
    ends = [(4, node.inputs[0], inner), (2, inner, node.outputs[0])]
    replacements[node] = []
    for factor, source, result in ends:
        scales = graph.add_constant(f"{result}.scales", np.array([1, 1, factor, factor]))
        name = node.name if factor == 2 else inner
        replacements[node].append(Node.new("Resize", [source, "", scales], result, name, **modes))
    return replacements
