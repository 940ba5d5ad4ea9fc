"""Moves of pixels that exporters write in several ways: shuffles as Reshape and Transpose, resizes
of all opsets.

torch writes PixelUnshuffle as Reshape and Transpose, and PixelShuffle in old opsets. What such
nodes do is tried out on an image of numbered pixels.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import onnx
from onnx import helper

from beers_deploy.quant.graph.nodes import Node, OnnxGraph
from beers_deploy.quant.graph.operations import Shuffle

MOVES: dict[str, tuple[str, Callable[[np.ndarray, list[int]], np.ndarray]]] = {
    "Reshape": (
        "shape",
        lambda image, sizes: image.reshape([n or image.shape[k] for k, n in enumerate(sizes)]),
    ),
    "Squeeze": ("axes", lambda image, axes: image.squeeze(tuple(axes) or None)),
    "Transpose": ("perm", lambda image, axes: image.transpose(axes or None)),
    "Unsqueeze": ("axes", lambda image, axes: np.expand_dims(image, tuple(axes))),
}
"""Operators that do nothing but move pixels: what they state, in an input or an attribute, and what
they do.
"""
ORDERS = {"CRD": True, "DCR": False}
"""The modes of ONNX's DepthToSpace, and whether columns come first."""
SIDES_PX = 24, 35
"""Of images that moves are tried on: blocks of 2 to 8 fit one of them."""
VALUES = 1 << 22
"""Most of an image of a stated size."""


def with_shuffles(model: onnx.ModelProto) -> OnnxGraph:
    """The nodes of a model, with one DepthToSpace or SpaceToDepth for each that is spelled out.

    Its `mode`, of SpaceToDepth too, says in which order the channels come: one of `ORDERS`, empty
    for any other.
    """
    graph = OnnxGraph(model)
    if not any(node.op_type in MOVES for node in graph.nodes):
        return graph
    info = onnx.shape_inference.infer_shapes(model).graph
    dims = {
        value.name: value.type.tensor_type.shape.dim for value in (*info.input, *info.value_info)
    }
    # The last node of a chain stands for all of them, so that no reader of the result moves.
    replacements: dict[Node, Node | None] = {}
    for chain in _chains(graph):
        sizes = [dim.dim_value for dim in dims.get(chain[0].inputs[0], ())]
        shuffle = _shuffle(chain, sizes, graph)
        if shuffle is not None:
            replacements |= {**dict.fromkeys(chain), chain[-1]: shuffle}
    nodes = (replacements.get(node, node) for node in graph.nodes)
    return OnnxGraph(model, [node for node in nodes if node is not None])


def _chains(graph: OnnxGraph) -> list[list[Node]]:
    """Nodes that do nothing but move pixels, each of which only the next one reads."""
    chains: dict[str, list[Node]] = {}  # by the tensor that they have come to
    for node in graph.nodes:
        if node.op_type in MOVES:
            chain = chains.pop(node.inputs[0], []) if graph.reads(node.inputs[0]) == 1 else []
            chain.append(node)
            chains[node.outputs[0]] = chain
    return list(chains.values())


def _shuffle(chain: list[Node], sizes: list[int], graph: OnnxGraph) -> Node | None:
    """The pixel shuffle that a chain is, of an image of these sizes, 0 where they are free; None of
    what is none.
    """
    for side_px in SIDES_PX if len(sizes) == 4 and sizes[1] else ():
        shape = sizes[0] or 1, sizes[1], sizes[2] or side_px, sizes[3] or 2 * side_px
        if math.prod(shape) > VALUES:
            continue
        # Each pixel has a number of its own, so that the result says where each one went.
        image = np.arange(math.prod(shape)).reshape(shape)
        result = _moved(chain, image, graph)
        growth = _growth(result, shape)
        if growth is None:
            continue
        up = growth > 1
        block = max(growth.numerator, growth.denominator)
        mode = _order(image, result, block, up) if block > 1 else ""
        kind = "DepthToSpace" if up else "SpaceToDepth"
        source = chain[0].inputs[0]
        output = chain[-1].outputs[0]
        proto = helper.make_node(kind, [source], [output], chain[-1].name, blocksize=block)
        node = Node.of(proto)
        return replace(node, name=chain[0].name, attributes={"blocksize": block, "mode": mode})
    return None


def _order(image: np.ndarray, result: np.ndarray, block: int, up: bool) -> str:
    """Return the mode of a pixel shuffle that makes the result of the image; empty if none does."""
    for mode, columns_first in ORDERS.items():
        shuffle = Shuffle("", "", "", block, up, columns_first)
        if np.array_equal(shuffle(image), result):
            return mode
    return ""


def _moved(chain: list[Node], image: np.ndarray, graph: OnnxGraph) -> np.ndarray:
    """Where a chain takes the pixels of an image; nowhere where it does not fit."""
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
    """Pixels of a shuffle's result for one of its source, along either side; None of what is no
    shuffle.

    It is one where each pixel comes from its own place: the pixel there, or the block of them.
    """
    if result.ndim != 4 or len(result) != shape[0]:
        return None
    growth = Fraction(result.shape[2], shape[2])
    rows, columns = (source // growth.denominator for source in np.unravel_index(result, shape)[2:])
    down, across = (np.arange(side) // growth.numerator for side in result.shape[2:])
    # Numerator or denominator is 1 where blocks become pixels or pixels become blocks.
    in_blocks = 1 in (growth.numerator, growth.denominator)
    in_place = (rows == down[:, None]).all() and (columns == across).all()
    return growth if in_blocks and in_place else None


PLACES: dict[str, Callable[[int, float], float]] = {
    "asymmetric": lambda pixel, factor: pixel / factor,
    "half_pixel": lambda pixel, factor: (pixel + 0.5) / factor - 0.5,
    "pytorch_half_pixel": lambda pixel, factor: (pixel + 0.5) / factor - 0.5,
    "tf_half_pixel_for_nn": lambda pixel, factor: (pixel + 0.5) / factor,
}
"""Where a pixel of an enlarged image lies in the image before.

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
    """A Resize, or an Upsample of older opsets, with ONNX's defaults filled in.

    `factors` are those of N, C, H and W; none where they are computed, or a size is stated.
    """

    factors: tuple[float, ...]
    mode: str
    where: str
    rounding: str

    @classmethod
    def of(cls, node: Node, graph: OnnxGraph) -> "Resizing":
        """What a node states."""
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
        """Whether nearest pixels, enlarged by a factor, are those whose block each pixel of the
        result lies in.
        """
        if self.where not in PLACES or self.rounding not in ROUNDINGS:
            return False
        place = PLACES[self.where]
        rounded = ROUNDINGS[self.rounding]
        return all(rounded(place(k, factor)) == k // factor for k in range(factor))
