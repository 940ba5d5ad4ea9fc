"""Write what only moves and repeats the values of a map as one operator.

Exporters spell shuffles of channels, pixel unshuffles and repeated channels or pixels by Reshape,
Transpose, Expand and Tile, selected channels by GatherND between two Transposes or by Gather and
Unsqueeze, and a map in another order of memory by Gather of the flat map. Such a chain is tested on
a map of numbered values:

1. If each channel of the result is a channel of the map, or one place of its blocks of r x r
   pixels, it is a convolution of r x r pixels and stride r that selects them. A pixel unshuffle of
   one channel is a SpaceToDepth, and so is one of the image in front of convolutions, whose weights
   are reordered.
2. If each pixel becomes a block, it is a nearest Resize, and if the channels become a block, a
   DepthToSpace. `quant.graph.pixel_shuffle` reads one whose sizes are constants.
3. If each value stays in its place, nothing is needed.

All of it is exact.
"""

import math
from functools import partial, reduce

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement
from beers_deploy.quant.simplify.slices import unshuffled

RESHAPING = {"Flatten", "Reshape", "Squeeze", "Unsqueeze"}
"""Operators that move no value."""
MOVING = RESHAPING | {"Expand", "Gather", "GatherND", "Tile", "Transpose"}
PIXEL_SHUFFLES = {"CRD": [0, 1, 4, 2, 5, 3], "DCR": [0, 3, 4, 1, 5, 2]}
"""The transposition of each mode of DepthToSpace."""
OF_BLOCKS = {
    "mode": "nearest",
    "coordinate_transformation_mode": "asymmetric",
    "nearest_mode": "floor",
}
"""Attributes of a Resize that makes a block of each pixel."""
MOST_VALUES = 1 << 24
"""The largest map that chains are tested on."""


def is_rearrangement(graph: OnnxGraph, node: Node) -> bool:
    """Return True if a node may belong to a chain that moves values, behind the image."""
    perm = node.attribute("perm", ())
    sizes = graph.value(graph.writer(node.source), 1)
    is_read_as_shuffle = perm in PIXEL_SHUFFLES.values() and sizes is not None
    is_one = len(perm) > 4 and not is_read_as_shuffle
    return (
        node.op_type in ("GatherND", "Tile")
        or takes_others(graph, node)
        or (is_one and _chain(graph, node)[0] not in graph.inputs)
    )


def takes_others(graph: OnnxGraph, node: Node) -> bool:
    """Return True for a Gather of constant places that changes the number of axes."""
    places = graph.value(node, 1) if node.op_type == "Gather" else None
    return places is not None and places.ndim != 1


def rearranged(graph: OnnxGraph, node: Node) -> Replacement:
    """Return one operator that replaces a node and those in front of it.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: a Transpose, a Reshape, or another operator that moves no value.

    Returns:
        The operator; None if there is no such operator.
    """
    source, chain = _chain(graph, node)
    before = graph.shapes.get(source, ())
    result = node.result
    after = graph.shapes.get(result, ())
    if len(before) != 4 or len(after) != 4 or not 0 < math.prod(before) <= MOST_VALUES:
        return None
    image = np.arange(math.prod(before)).reshape(before)
    moved = reduce(partial(_moved, graph), chain, image)
    if np.array_equal(moved, image):
        return [node.replaced_by("Identity", [source])]
    if after[2] > before[2]:
        return _enlarged(graph, node, source, image, moved)
    block = before[2] // after[2]
    channels = before[1]
    if (after[2] * block, after[3] * block) != before[2:]:
        return None
    blocks = image.reshape(-1, channels, after[2], block, after[3], block)
    blocks = blocks.transpose(0, 1, 3, 5, 2, 4).reshape(before[0], -1, *after[2:])
    # The numbers increase from channel to channel, and from place to place.
    order = np.searchsorted(blocks[0, :, 0, 0], moved[0, :, 0, 0]) % blocks.shape[1]
    if not np.array_equal(blocks[:, order], moved):
        return None
    if block > 1 and np.array_equal(order, np.arange(block * block)):
        return [node.replaced_by("SpaceToDepth", [source], blocksize=block)]
    if block > 1 and source in graph.inputs:
        # ONNX counts the places of a block first, then the channels.
        channel, place = np.divmod(order, block * block)
        return unshuffled(graph, node, source, block, place * channels + channel)
    weight = np.eye(blocks.shape[1])[order].reshape(-1, channels, block, block)
    return [graph.convolution(source, result, node.name, weight, strides=[block, block])]


def _enlarged(
    graph: OnnxGraph, node: Node, source: str, image: np.ndarray, moved: np.ndarray
) -> Replacement:
    """Return the operator that enlarges a map of numbers so; None if it is no enlargement (2)."""
    factor = moved.shape[2] // image.shape[2]
    if moved.shape[2:] != (factor * image.shape[2], factor * image.shape[3]):
        return None
    is_of_channels = moved.shape[1] == image.shape[1]
    if is_of_channels and np.array_equal(moved, image.repeat(factor, 2).repeat(factor, 3)):
        scales = graph.add_constant(f"{node.result}.scales", [1, 1, factor, factor])
        return [node.replaced_by("Resize", [source, "", scales], **OF_BLOCKS)]
    batch, channels, *_ = moved.shape
    blocks = batch, channels, image.shape[2], factor, image.shape[3], factor
    for mode, perm in PIXEL_SHUFFLES.items() if math.prod(blocks) == image.size else ():
        sizes = [blocks[axis] for axis in np.argsort(perm)]
        shuffled = image.reshape(sizes).transpose(perm).reshape(moved.shape)
        if np.array_equal(moved, shuffled):
            return [node.replaced_by("DepthToSpace", [source], blocksize=factor, mode=mode)]
    return None


def _chain(graph: OnnxGraph, node: Node) -> tuple[str, list[Node]]:
    """Return the tensor that a chain up to this node begins with, and its nodes in order."""
    chain = [node]
    while (writer := graph.writer(chain[0].source)).op_type in MOVING:
        chain.insert(0, writer)
    return chain[0].source, chain


def _moved(graph: OnnxGraph, values: np.ndarray, node: Node) -> np.ndarray:
    """Return the result of a node for these values."""
    size = graph.shapes[node.result]
    if node.op_type == "Transpose":
        return values.transpose(node.attribute("perm"))
    if node.op_type == "Expand":
        return np.broadcast_to(values, size)
    if node.op_type == "Tile":
        return np.tile(values, np.floor_divide(size, values.shape))
    if node.op_type not in ("Gather", "GatherND"):
        return values.reshape(size)
    chosen = graph.value(node, 1)
    if chosen is not None and node.op_type == "Gather":
        return np.asarray(values.take(chosen, node.attribute("axis", 0)))
    if chosen is not None and chosen.ndim == 2 and chosen.shape[1] == 1:
        return np.asarray(values[chosen[:, 0]])
    # A number that no map has.
    return np.full(size, -1)
