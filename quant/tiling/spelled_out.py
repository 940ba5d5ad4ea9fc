"""Pixel shuffles that an exporter spelled out: Reshape, Transpose and their like in a row, seen as one operator.

torch writes PixelUnshuffle so, and PixelShuffle in old opsets. Whether such a row of nodes is one is asked of itself:
it is run on the pixels' own indices, and is a shuffle where each pixel of the result comes from the square, or the
pixel, in its own place. In which order channels come is not asked: the graph returned here is for questions about
places, and never run.
"""

import math
from collections import Counter
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import onnx
from onnx import helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from quant.onnx_file import constants

MOVING = {"Reshape", "Squeeze", "Transpose", "Unsqueeze"}
SIDE_PX = 24
"""Of what a row of nodes is tried on, where it takes any size: blocks of 2, 3, 4, 6 and 8 fit."""
VALUES = 1 << 22
"""Most that it is tried on."""


def with_shuffles(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with one DepthToSpace or SpaceToDepth for each spelled-out one; as it is where there is none."""
    rows = list(_rows(model.graph))
    if not rows:
        return model
    sizes = _sizes(model)
    growths = [_growth(row, sizes.get(row[0].input[0], []), model) for row in rows]
    shuffles = {id(row[-1]): _shuffle(row, growth) for row, growth in zip(rows, growths, strict=True) if growth}
    gone = {id(node) for row, growth in zip(rows, growths, strict=True) if growth for node in row[:-1]}
    nodes = [shuffles.get(id(node), node) for node in model.graph.node if id(node) not in gone]
    found = onnx.ModelProto()
    found.CopyFrom(model)
    del found.graph.node[:]
    found.graph.node.extend(nodes)
    return found


def _rows(graph: onnx.GraphProto) -> Iterator[list[onnx.NodeProto]]:
    """Nodes that do nothing but move pixels, each of which only the next one reads."""
    readers = Counter([name for node in graph.node for name in node.input] + [value.name for value in graph.output])
    behind = {node.input[0]: node for node in graph.node if node.op_type in MOVING and node.input}
    begun: set[str] = set()
    for node in graph.node:
        if node.op_type not in MOVING or not node.input or node.output[0] in begun:
            continue
        row = [node]
        while readers[row[-1].output[0]] == 1 and row[-1].output[0] in behind:
            row.append(behind[row[-1].output[0]])
        begun.update(each.output[0] for each in row)
        yield row


def _sizes(model: onnx.ModelProto) -> dict[str, list[int]]:
    """What is known of each tensor's sizes; 0 is any."""
    graph = onnx.shape_inference.infer_shapes(model).graph
    values = (*graph.input, *graph.value_info, *graph.output)
    return {value.name: [dim.dim_value for dim in value.type.tensor_type.shape.dim] for value in values}


def _growth(row: list[onnx.NodeProto], sizes: list[int], model: onnx.ModelProto) -> Fraction | None:
    """Pixels of a shuffle's result for one of its source, along either side; None of what is no shuffle."""
    if len(sizes) != 4 or not sizes[1]:
        return None
    shape = [1, sizes[1], sizes[2] or SIDE_PX, sizes[3] or SIDE_PX]
    result = _moved(row, shape, model) if math.prod(shape) <= VALUES else None
    if result is None or result.ndim != 4 or len(result) != 1:
        return None
    growth = Fraction(result.shape[2], shape[2])
    whole = 1 in (growth.numerator, growth.denominator)
    return growth if whole and all(_in_place(result, shape, axis, growth) for axis in (2, 3)) else None


def _moved(row: list[onnx.NodeProto], shape: list[int], model: onnx.ModelProto) -> np.ndarray | None:
    """Where the pixels of an image of that shape come to; None where such a row does not run on it."""
    held, read = constants(model), {name for node in row for name in node.input[1:]}
    ends = [helper.make_tensor_value_info(row[0].input[0], onnx.TensorProto.INT64, shape)]
    results = [helper.make_tensor_value_info(row[-1].output[0], onnx.TensorProto.INT64, None)]
    weights = [numpy_helper.from_array(held[name], name) for name in read if name in held]
    graph = helper.make_graph(row, "row", ends, results, weights)
    pixels = np.arange(math.prod(shape)).reshape(shape)
    try:
        alone = helper.make_model(graph, opset_imports=model.opset_import)
        (result,) = ReferenceEvaluator(alone).run(None, {row[0].input[0]: pixels})
    except Exception:  # noqa: BLE001 - the evaluator raises whatever it stumbles over
        return None
    return np.asarray(result)


def _in_place(result: np.ndarray, shape: list[int], axis: int, growth: Fraction) -> bool:
    """Whether each pixel comes from its own place along one axis of four."""
    source = np.unravel_index(result, shape)[axis]
    here = np.arange(result.shape[axis]).reshape([-1 if k == axis else 1 for k in range(4)])
    return bool((source // growth.denominator == here // growth.numerator).all())


def _shuffle(row: list[onnx.NodeProto], growth: Fraction) -> onnx.NodeProto:
    """The row as one operator."""
    kind = "DepthToSpace" if growth.numerator > 1 else "SpaceToDepth"
    size = max(growth.numerator, growth.denominator)
    return helper.make_node(kind, [row[0].input[0]], [row[-1].output[0]], row[0].name, blocksize=size)
