"""Find the pixel shuffles that exporters write as Reshape and Transpose.

torch writes PixelUnshuffle so, and PixelShuffle in old opsets. The effect of such nodes is
determined on an image of numbered pixels.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import numpy as np
from onnx import ModelProto, TypeProto

from beers_deploy.quant.graph.operations import Shuffle
from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.onnx.messages import sizes_of

MOVES: dict[str, tuple[str, Callable[[np.ndarray, list[int]], np.ndarray]]] = {
    "Reshape": (
        "shape",
        lambda image, sizes: image.reshape([n or image.shape[k] for k, n in enumerate(sizes)]),
    ),
    "Squeeze": ("axes", lambda image, axes: image.squeeze(tuple(axes) or None)),
    "Transpose": ("perm", lambda image, axes: image.transpose(axes or None)),
    "Unsqueeze": ("axes", lambda image, axes: np.expand_dims(image, tuple(axes))),
}
"""Operators that only move pixels: the name of their parameter, an input or an attribute, and their
effect.
"""
ORDERS = {"CRD": True, "DCR": False}
"""The modes of ONNX's DepthToSpace, and whether columns come first."""
SIDES_PX = 24, 35
"""Sides of the test images: blocks of 2 to 8 fit one of them."""
VALUES = 1 << 22
"""The largest image of a stated size on which nodes are tested."""


def with_shuffles(model: ModelProto) -> OnnxGraph:
    """Build the graph of a model, in which each pixel shuffle is one node.

    A shuffle that the file writes as Reshape and Transpose becomes DepthToSpace or SpaceToDepth.
    The attribute `mode` of both states the order of the channels: a key of `ORDERS`, or empty for
    any other order.

    Args:
        model: any network; not changed.
    """
    graph = OnnxGraph(model)
    # Chains of nodes that only move pixels, each of which only the next one reads, by the last
    # result.
    chains: dict[str, list[Node]] = {}
    for node in graph.nodes:
        if node.op_type in MOVES:
            chain = chains.pop(node.source, []) if graph.n_reads(node.source) == 1 else []
            chain.append(node)
            chains[node.result] = chain
    if not chains:
        return graph
    types = graph.tensor_types()
    # The last node stands for its chain, so that readers of the result need not change.
    replacements: dict[Node, list[Node]] = {}
    for chain in chains.values():
        sizes = sizes_of(types.get(chain[0].source, TypeProto.Tensor()))
        shuffle = _shuffle(chain, sizes, graph)
        if shuffle is not None:
            replacements |= {**{node: [] for node in chain}, chain[-1]: [shuffle]}
    graph.rewrite(lambda _, node: replacements.get(node))
    return graph


def _shuffle(chain: list[Node], sizes: tuple[int, ...], graph: OnnxGraph) -> Node | None:
    """Return the pixel shuffle that is equivalent to a chain of nodes; 0 stands for free sizes.

    None if the chain is no shuffle.
    """
    for side_px in SIDES_PX if len(sizes) == 4 and sizes[1] else ():
        shape = sizes[0] or 1, sizes[1], sizes[2] or side_px, sizes[3] or 2 * side_px
        if math.prod(shape) > VALUES:
            continue
        # Each pixel has a unique number, so that the result shows where each one moved.
        image = np.arange(math.prod(shape)).reshape(shape)
        result = _moved(chain, image, graph)
        growth = _growth(result, shape)
        if growth is None:
            continue
        up = growth > 1
        block = max(growth.numerator, growth.denominator)
        modes = [
            mode
            for mode, columns_first in ORDERS.items()
            if np.array_equal(Shuffle("", "", "", block, up, columns_first)(image), result)
        ]
        kind = "DepthToSpace" if up else "SpaceToDepth"
        # Messages name the first node of the chain, and files that we write the last one.
        last = chain[-1]
        node = Node.new(kind, chain[0].inputs[:1], last.result, last.name, blocksize=block)
        attributes = {"blocksize": block, "mode": modes[0] if modes and block > 1 else ""}
        return replace(node, name=chain[0].name, attributes=attributes)
    return None


def _moved(chain: list[Node], image: np.ndarray, graph: OnnxGraph) -> np.ndarray:
    """Return an image as a chain moves its pixels; empty if the chain does not fit."""
    for node in chain:
        key, move = MOVES[node.op_type]
        numbers = graph.numbers(node, 1, key)
        if numbers is None:
            return np.array([])
        try:
            image = move(image, numbers)
        except (IndexError, ValueError):
            return np.array([])
    return image


def _growth(result: np.ndarray, shape: tuple[int, int, int, int]) -> Fraction | None:
    """Return the pixels of a shuffle's result for one of its source, along either side.

    It is a shuffle if each pixel comes from its own place: the pixel there, or the block of them.
    None for anything else.
    """
    if result.ndim != 4 or len(result) != shape[0]:
        return None
    growth = Fraction(result.shape[2], shape[2])
    if result.shape[3] != growth * shape[3]:
        return None
    rows, columns = (source // growth.denominator for source in np.unravel_index(result, shape)[2:])
    down, across = (np.arange(side) // growth.numerator for side in result.shape[2:])
    # The numerator or the denominator is 1 if blocks become pixels, or pixels become blocks.
    in_blocks = 1 in (growth.numerator, growth.denominator)
    in_place = (rows == down[:, None]).all() and (columns == across).all()
    return growth if in_blocks and in_place else None
