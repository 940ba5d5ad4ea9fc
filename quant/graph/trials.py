"""What exporters write in several ways, tried out on numbers: pixel shuffles, and coordinates of resizes.

torch writes PixelUnshuffle as Reshape and Transpose, and PixelShuffle in old opsets.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from copy import deepcopy
from fractions import Fraction
from itertools import product

import numpy as np
import onnx
from onnx import helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from beers_deploy.quant.graph.operations import Shuffle
from beers_deploy.quant.onnx_file import constants

MOVES = ("Reshape", "Transpose", "Squeeze", "Unsqueeze")
SIDES_PX = 24, 35
"""Of images that moves are tried on: blocks of 2 to 8 fit one of them."""
VALUES = 1 << 22
"""Most of an image of a stated size."""


def spelled_shuffle(
    chain: Sequence[onnx.NodeProto], name: str, channels: int, model: onnx.ModelProto
) -> Shuffle | None:
    """The pixel shuffle that a chain of moves is; None of any other.

    Args:
        chain: nodes of the model, each of which only the next one reads.
        name: the shuffle's.
        channels: of what the first reads.
        model: theirs.
    """
    for side_px in SIDES_PX:
        image, result = _moved(chain, (2, channels, side_px, 2 * side_px), model)
        for block, up, columns_first in product(range(2, 9), (True, False), (True, False)):
            shuffle = Shuffle(name, chain[0].input[0], chain[-1].output[0], block, up, columns_first)
            fits = channels % block**2 == 0 if up else side_px % block == 0
            if fits and np.array_equal(result, shuffle(image)):
                return shuffle
    return None


def _moved(
    chain: Sequence[onnx.NodeProto], sizes: Sequence[int], model: onnx.ModelProto
) -> tuple[np.ndarray, np.ndarray]:
    """An image of those sizes, its pixels numbered, and where a chain takes it; to nothing where it does not run."""
    image = np.arange(math.prod(sizes)).reshape(sizes)
    held, read = constants(model), {name for node in chain for name in node.input[1:]}
    weights = [numpy_helper.from_array(held[name], name) for name in read if name in held]
    names = chain[0].input[0], chain[-1].output[0]
    ends = [helper.make_tensor_value_info(name, onnx.TensorProto.INT64, None) for name in names]
    graph = helper.make_graph(chain, "moves", ends[:1], ends[1:], weights)
    try:
        alone = helper.make_model(graph, opset_imports=model.opset_import)
        (result,) = ReferenceEvaluator(alone).run(None, {names[0]: image})
    except Exception:  # noqa: BLE001 - the evaluator raises whatever it stumbles over
        return image, np.array([])
    return image, np.asarray(result)


def with_shuffles(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with one DepthToSpace or SpaceToDepth for each spelled-out one; as it is where there is none.

    In which order channels come is not asked: it is for questions about places, and never run.
    """
    if not any(node.op_type in MOVES for node in model.graph.node):
        return model
    found = deepcopy(model)
    graph = onnx.shape_inference.infer_shapes(model).graph
    known = {value.name: value.type.tensor_type.shape.dim for value in (*graph.input, *graph.value_info)}
    for chain in _chains(found.graph):
        growth = _growth(chain, [dim.dim_value for dim in known.get(chain[0].input[0], ())], model)
        if growth:
            kind, size = "DepthToSpace" if growth > 1 else "SpaceToDepth", max(growth.numerator, growth.denominator)
            ends = [chain[0].input[0]], [chain[-1].output[0]]
            chain[-1].CopyFrom(helper.make_node(kind, *ends, chain[0].name, blocksize=size))
            for node in chain[:-1]:
                found.graph.node.remove(node)
    return found


def _chains(graph: onnx.GraphProto) -> list[list[onnx.NodeProto]]:
    """Nodes that do nothing but move pixels, each of which only the next one reads."""
    readers = Counter([name for node in graph.node for name in node.input] + [value.name for value in graph.output])
    chains: dict[str, list[onnx.NodeProto]] = {}  # by the tensor that they have come to
    for node in graph.node:
        if node.op_type in MOVES:
            before = chains.pop(node.input[0], []) if readers[node.input[0]] == 1 else []
            chains[node.output[0]] = [*before, node]
    return list(chains.values())


def _growth(chain: list[onnx.NodeProto], sizes: list[int], model: onnx.ModelProto) -> Fraction | None:
    """Pixels of a shuffle's result for one of its source, along either side; None of what is no shuffle.

    It is one where each pixel comes from its own place: the pixel there, or the block of them.
    """
    for side_px in SIDES_PX if len(sizes) == 4 and sizes[1] else ():
        shape = 1, sizes[1], sizes[2] or side_px, sizes[3] or side_px
        result = _moved(chain, shape, model)[1] if math.prod(shape) <= VALUES else np.array([])
        if result.ndim != 4 or len(result) != 1:
            continue
        growth = Fraction(result.shape[2], shape[2])
        rows, columns = (source // growth.denominator for source in np.unravel_index(result, shape)[2:])
        down, across = (np.arange(side) // growth.numerator for side in result.shape[2:])
        whole = 1 in (growth.numerator, growth.denominator)
        if whole and (rows == down[:, None]).all() and (columns == across).all():
            return growth
    return None


PLACES: dict[str, Callable[[int, float], float]] = {
    "asymmetric": lambda pixel, factor: pixel / factor,
    "half_pixel": lambda pixel, factor: (pixel + 0.5) / factor - 0.5,
    "pytorch_half_pixel": lambda pixel, factor: (pixel + 0.5) / factor - 0.5,
    "tf_half_pixel_for_nn": lambda pixel, factor: (pixel + 0.5) / factor,
}
"""Where a pixel of an enlarged image lies in the image before. ONNX's other coordinates depend on the sizes."""
ROUNDINGS: dict[str, Callable[[float], int]] = {
    "floor": math.floor,
    "ceil": math.ceil,
    "round_prefer_floor": lambda place: math.ceil(place - 0.5),
    "round_prefer_ceil": lambda place: math.floor(place + 0.5),
}


def makes_blocks(factor: int, where: str, rounding: str) -> bool:
    """Whether ONNX's coordinates, so rounded, give each pixel of the result the one whose block it lies in."""
    known = where in PLACES and rounding in ROUNDINGS
    return known and all(ROUNDINGS[rounding](PLACES[where](k, factor)) == k // factor for k in range(factor))
