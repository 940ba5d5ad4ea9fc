"""Align the spatial attention of RFDN and RLFN (ESA) with integer fractions of a map.

It reduces a map by an unpadded convolution of stride 2 and an unpadded maximum of stride 3. It then
enlarges the result of convolutions on that to the map's size, by a non-integer factor.

1. Padded, and with a maximum of stride 4, its inner map has an eighth of the sides.
2. Two bilinear enlargements, by 4 and by 2, lead back to the map's size.

That is another function. `quant.adapt` replaces the original by it, measures the loss and
compensates it.
"""

from beers_deploy.quant.onnx.graph import NO_NODE, Node, OnnxGraph
from beers_deploy.quant.onnx.resize import Resizing, enlarged_bilinearly

BETWEEN = {"Conv", "LeakyRelu", "PRelu", "Relu"}
"""The operators between the maximum and the enlargement."""


def shrinking(graph: OnnxGraph, node: Node) -> list[Node]:
    """Return the nodes of a spatial attention that reduce its map, in front of the Resize that
    enlarges it.

    Args:
        graph: the graph that the node belongs to.
        node: any node; only a Resize can be part of an attention.

    Returns:
        In order: the convolution of stride 2, the maximum of stride 3, and the nodes between that
        and the Resize. The list is empty if the node is no Resize of an attention.
    """
    if node.op_type != "Resize":
        return []
    nodes: list[Node] = []
    pool = _writer(graph, node.source)
    while pool.op_type in BETWEEN:
        nodes.insert(0, pool)
        pool = _writer(graph, pool.source)
    writer = _writer(graph, pool.source)
    weight = graph.value(writer, 1)
    # The pads and strides that `aligned` writes fit these kernels and strides only.
    is_attention = (
        (writer.op_type, pool.op_type) == ("Conv", "MaxPool")
        and weight is not None
        and weight.shape[2:] == (3, 3)
        and writer.attribute("strides") == [2, 2]
        and pool.attribute("kernel_shape") == [7, 7]
        and pool.attribute("strides") == [3, 3]
        and not any([*writer.attribute("pads", []), *pool.attribute("pads", [])])
        and Resizing.of(graph, node).mode == "linear"
    )
    return [writer, pool, *nodes] if is_attention else []


def _writer(graph: OnnxGraph, name: str) -> Node:
    """Return the node that writes a tensor; NO_NODE if several nodes read its values."""
    readers = [node for node in graph.readers[name] if node.op_type != "Shape"]
    return graph.writer(name) if len(readers) == 1 else NO_NODE


def aligned(graph: OnnxGraph, node: Node) -> dict[Node, list[Node]]:
    """Return the nodes that replace a spatial attention by one whose map has an integer fraction of
    the size.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node; only a Resize can end an attention.

    Returns:
        A dict from each replaced node, the Resize and those that reduce the map in front of it, to
        the new nodes in its place. It is empty if the node ends no attention.
    """
    nodes = shrinking(graph, node)
    if not nodes:
        return {}
    # 1. Pads put each value in the middle of the eight pixels that it stands for, or next to it.
    changes = {0: {"pads": [1, 1, 1, 1]}, 1: {"strides": [4, 4], "pads": [1, 1, 2, 2]}}
    replacements = {}
    source = nodes[0].source
    for place, old in enumerate(nodes):
        # It has another name, because it is no longer the tensor of the original.
        result = f"{old.result}.aligned"
        attributes = {**old.attributes, **changes.get(place, {})}
        inputs = [source, *old.inputs[1:]]
        replacements[old] = [Node.new(old.op_type, inputs, result, old.name, **attributes)]
        source = result
    # 2.
    return replacements | {node: enlarged_bilinearly(graph, source, 8, node)}
