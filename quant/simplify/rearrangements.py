"""Write shuffles of channels and pixel unshuffles, which exporters spell by Reshape and Transpose,
as one operator.

1. A shuffle of channels is a Reshape to (N, groups, C / groups, H, W), a Transpose of groups and
   members, and a Reshape back. It becomes a convolution of one pixel that moves each channel.
2. A pixel unshuffle is a Reshape to (N, C, H, r, W, r), a Transpose to (N, C, r, r, H, W), and a
   Reshape. Of one channel it becomes a SpaceToDepth. ONNX orders several channels in another way,
   so it becomes a convolution of r x r pixels and stride r that moves each value; the host
   unshuffles an image of several channels.

All of it is exact.
"""

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph

Sizes = dict[str, tuple[int, ...]]

RESHAPING = {"Flatten", "Reshape", "Squeeze", "Unsqueeze"}
"""Operators that move no value."""


SHUFFLE = [0, 2, 1, 3, 4]
UNSHUFFLE = [0, 1, 3, 5, 2, 4]
"""The transpositions of the two."""


def is_rearrangement(graph: OnnxGraph, node: Node) -> bool:
    """Return True for the Transpose of a shuffle or unshuffle within a network, behind the image.

    Args:
        graph: the graph that the node belongs to.
        node: any node.
    """
    is_one = node.op_type == "Transpose" and node.attributes.get("perm") in (SHUFFLE, UNSHUFFLE)
    return is_one and _before_reshapes(graph, node.inputs[0]) not in graph.inputs


def rearranged(graph: OnnxGraph, node: Node, sizes: Sizes) -> list[Node] | None:
    """Return the operator that does what a Reshape and the nodes in front of it do.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: a Reshape, or another operator that moves no value.
        sizes: the sizes of each tensor, for images of one size.

    Returns:
        The operator; None if the nodes are neither a shuffle of channels nor a pixel unshuffle.
    """
    moved = graph.sole_writer(_before_reshapes(graph, node.inputs[0]))
    if moved is None or moved.op_type != "Transpose":
        return None
    source = _before_reshapes(graph, moved.inputs[0])
    split = sizes.get(moved.inputs[0], ())
    ends = sizes.get(source, ()), sizes[node.outputs[0]]
    perm = moved.attributes.get("perm")
    weight = None
    stride = 1
    if perm == SHUFFLE and len(split) == 5:
        weight = _channel_shuffle(split, ends)
    elif perm == UNSHUFFLE and len(split) == 6:
        weight = _unshuffle(split, ends)
        stride = split[3]
    if weight is None:
        return None
    if stride > 1 and weight.shape[1] == 1:
        return [Node.new("SpaceToDepth", [source], node.outputs[0], node.name, blocksize=stride)]
    if stride > 1 and source in graph.inputs:
        return None
    strides = [stride, stride]
    return [graph.convolution(source, node.outputs[0], node.name, weight, strides=strides)]


def _before_reshapes(graph: OnnxGraph, name: str) -> str:
    """Return the tensor that operators which move no value turn into this one."""
    writer = graph.sole_writer(name)
    while writer is not None and writer.op_type in RESHAPING:
        name = writer.inputs[0]
        writer = graph.sole_writer(name)
    return name


def _channel_shuffle(
    split: tuple[int, ...], ends: tuple[tuple[int, ...], tuple[int, ...]]
) -> np.ndarray | None:
    """Return the weights (C, C, 1, 1) of a shuffle of channels; None if the sizes are not its own.

    Args:
        split: sizes (N, groups, C / groups, H, W) that the Transpose reads.
        ends: sizes of the map before and after.
    """
    count, groups, members, rows, columns = split
    channels = groups * members
    if ends != ((count, channels, rows, columns),) * 2:
        return None
    order = np.arange(channels).reshape(groups, members).T.ravel()
    return np.eye(channels)[order][:, :, None, None]


def _unshuffle(
    split: tuple[int, ...], ends: tuple[tuple[int, ...], tuple[int, ...]]
) -> np.ndarray | None:
    """Return the weights (C r r, C, r, r) of a pixel unshuffle; None if the sizes are not its own.

    Args:
        split: sizes (N, C, H / r, r, W / r, r) that the Transpose reads.
        ends: sizes of the map before and after.
    """
    count, channels, rows, block, columns, across = split
    whole = count, channels, rows * block, columns * block
    values = channels * block * block
    if block != across or ends != (whole, (count, values, rows, columns)):
        return None
    return np.eye(values).reshape(values, channels, block, block)
