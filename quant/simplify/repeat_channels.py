"""Repeat channels by convolutions of one pixel, where a network repeats them or leaves it to ONNX.

A DPU adds and multiplies maps of one number of channels. A map of one channel that meets several is
repeated first, as a Tile along the channels does. Channels of the image that a Concat repeats come
from one convolution as well. All of it is exact.
"""

import numpy as np
import onnx

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.standard_operators import float_shapes

HOST = {"Clip", "DepthToSpace"}
"""Operators that the host computes behind the sum with the image."""


def repeat_channels(graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Let a convolution repeat the channels of a map that a Tile or arithmetic repeats.

    The image that is added at the end is left as it is: the host adds it to each channel.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The convolution, and the arithmetic; None if the node repeats no channels.
    """
    source = node.source
    result = node.result
    channels = graph.channels(source)
    if node.op_type == "Tile":
        repeats = graph.value(node, 1)
        if repeats is None or not channels or np.delete(repeats, 1).tolist() != [1, 1, 1]:
            return None
        weight = np.tile(np.eye(channels), (int(repeats[1]), 1))[:, :, None, None]
        return [graph.convolution(source, result, node.name, weight)]
    narrow = _narrow_input(graph, node)
    if narrow is None:
        return None
    channels = max(graph.channels(name) for name in node.inputs)
    name = f"{result}.repeated"
    repeated = graph.convolution(narrow, name, name, np.ones((channels, 1, 1, 1)))
    node.inputs = tuple(name if each == narrow else each for each in node.inputs)
    return [repeated, node]


def join_copies(graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Let one convolution write the channels of the image that a Concat joins, such as copies.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The convolution; None if the node joins anything else.
    """
    (image, *_) = graph.inputs
    if node.op_type != "Concat" or node.attributes.get("axis") != 1:
        return None
    weights = []
    for name in node.inputs:
        conv = graph.writers.get(name)
        if name == image:
            weights.append(np.eye(graph.inputs[image][1])[:, :, None, None])
        elif conv is not None and conv.op_type == "Conv" and conv.source == image:
            weights.append(graph.constants[conv.inputs[1]])
        else:
            return None
        is_plain = conv is None or (
            len(conv.inputs) == 2 and not conv.attributes.get("group", 1) > 1
        )
        if weights[-1].shape[2:] != (1, 1) or not is_plain:
            return None
    return [graph.convolution(image, node.result, node.name, np.concatenate(weights))]


def broadcasts_channels(model: onnx.ModelProto) -> bool:
    """Return True if a network adds or multiplies maps of one channel and of several.

    Args:
        model: a float network of few kinds of operators, whose channels ONNX can infer.
    """
    graph = OnnxGraph(model)
    graph.shapes = float_shapes(graph)
    return any(_narrow_input(graph, node) is not None for node in graph.nodes)


def _narrow_input(graph: OnnxGraph, node: Node) -> str | None:
    """Return the map of one channel that an Add, Mul or Sub repeats; None if there is none."""
    is_of_maps = graph.constants.keys().isdisjoint(node.inputs)
    if node.op_type not in ("Add", "Mul", "Sub") or not is_of_maps:
        return None
    widths = [graph.channels(name) for name in node.inputs]
    narrow = node.inputs[int(widths[0] > widths[1])]
    result = node.result
    readers = {reader.op_type for reader in graph.readers[result]}
    is_end = node.op_type == "Add" and (result in graph.outputs or readers <= HOST)
    is_repeated = min(widths) == 1 < max(widths) and not (is_end and narrow in graph.inputs)
    return narrow if is_repeated else None
