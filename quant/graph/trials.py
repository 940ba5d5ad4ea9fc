"""What exporters write in several ways is tried out on numbers: spelled-out shuffles, coordinates of resizes."""

from collections.abc import Callable, Mapping, Sequence
from itertools import product

import numpy as np
import onnx
from onnx import helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from quant.graph.operations import Shuffle

BLOCKS = 8
"""The largest side of a pixel shuffle's blocks that is looked for."""


def spelled_shuffle(
    chain: Sequence[onnx.NodeProto],
    name: str,
    channels: int,
    constants: Mapping[str, np.ndarray],
    model: onnx.ModelProto,
) -> Shuffle | None:
    """The pixel shuffle, to be of that name, that a chain of moves is; None of any other."""
    for block, up, columns_first in product(range(2, BLOCKS + 1), (True, False), (True, False)):
        shuffle = Shuffle(name, chain[0].input[0], chain[-1].output[0], block, up, columns_first)
        if (channels % block**2 == 0 or not up) and spells(chain, shuffle, channels, constants, model):
            return shuffle
    return None


def spells(
    chain: Sequence[onnx.NodeProto],
    shuffle: Shuffle,
    channels: int,
    constants: Mapping[str, np.ndarray],
    model: onnx.ModelProto,
) -> bool:
    """Whether a chain of moves does to numbered pixels what a pixel shuffle of so many channels does.

    Args:
        chain: nodes of the model, each of which only the next one reads.
        shuffle: from what the first reads to what the last writes.
        channels: of what the first reads.
        constants: of the model, by name.
        model: says of which opset the nodes are.
    """
    sizes = 2, channels, 2 * shuffle.block, 3 * shuffle.block
    numbered = np.arange(np.prod(sizes), dtype=np.float32).reshape(sizes)
    ends = [helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, None) for n in (shuffle.input, shuffle.output)]
    read = {name: constants[name] for node in chain for name in node.input if name in constants}
    held = [numpy_helper.from_array(value, name) for name, value in read.items()]
    graph = helper.make_graph(chain, "moves", ends[:1], ends[1:], held)
    alone = helper.make_model(graph, opset_imports=model.opset_import)
    try:
        (moved,) = ReferenceEvaluator(alone).run(None, {shuffle.input: numbered})
    except Exception:  # noqa: BLE001 - sizes that do not fit this block fail in many ways
        return False
    return bool(np.array_equal(moved, shuffle(numbered)))


PLACES: dict[str, Callable[[np.ndarray, int], np.ndarray]] = {
    "asymmetric": lambda place, factor: place / factor,
    "half_pixel": lambda place, factor: (place + 0.5) / factor - 0.5,
    "pytorch_half_pixel": lambda place, factor: (place + 0.5) / factor - 0.5,
    "tf_half_pixel_for_nn": lambda place, factor: (place + 0.5) / factor,
}
ROUNDINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "floor": np.floor,
    "ceil": np.ceil,
    "round_prefer_floor": lambda place: np.ceil(place - 0.5),
    "round_prefer_ceil": lambda place: np.floor(place + 0.5),
}


def makes_blocks(factor: int, where: str, rounding: str) -> bool:
    """Whether ONNX's coordinates, so rounded, give each pixel of the result the one whose block it lies in."""
    if where not in PLACES or rounding not in ROUNDINGS:
        return False
    place = np.arange(4 * factor)
    nearest = np.clip(ROUNDINGS[rounding](PLACES[where](place, factor)), 0, 3)
    return bool((nearest == place // factor).all())
