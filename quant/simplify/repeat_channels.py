"""Repeat channels by convolutions of one pixel, where a network repeats them or leaves it to ONNX.

A DPU adds and multiplies maps of one number of channels. A map of one channel that gates several is
repeated first, as a Tile along the channels does. Both are exact.
"""

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.standard_operators import Shapes, channels_in


def repeat_channels(shapes: Shapes, graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Let a convolution repeat the channels of a map that a Tile, an Add or a Mul repeats.

    The image is left as it is: the host adds it to each channel of a result.

    Args:
        shapes: the sizes of each float tensor by name, as `float_shapes` returns them.
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The convolution, and the Add or Mul; None if the node repeats no channels.
    """
    source, result = node.inputs[0], node.outputs[0]
    channels = channels_in(shapes, source)
    if node.op_type == "Tile":
        repeats = graph.value(node, 1)
        if repeats is None or not channels or np.delete(repeats, 1).tolist() != [1, 1, 1]:
            return None
        weight = np.tile(np.eye(channels), (int(repeats[1]), 1))[:, :, None, None]
        return [graph.convolution(source, result, node.name, weight)]
    if node.op_type not in ("Add", "Mul") or not graph.constants.keys().isdisjoint(node.inputs):
        return None
    widths = [channels_in(shapes, name) for name in node.inputs]
    narrow = node.inputs[int(widths[0] > widths[1])]
    if min(widths) != 1 or max(widths) == 1 or narrow in graph.inputs:
        return None
    name = f"{result}.repeated"
    repeated = graph.convolution(narrow, name, name, np.ones((max(widths), 1, 1, 1)))
    node.inputs = tuple(name if each == narrow else each for each in node.inputs)
    return [repeated, node]
