"""Mirror the image beyond its borders if a network has no padding and its result is smaller.

1. If no layer pads, the sizes of the result for two sizes of image determine how many pixels per
   side are missing. For a network of a fixed size, other sizes are inferred too.
2. A Pad in front of the network mirrors half of them at each border. The result then has the size
   of the image, or a multiple of it, and is unchanged inside its border.

A network that pools over the whole image is not changed: a larger image would change its means, and
so the result inside its border too.
"""

from copy import deepcopy

import numpy as np
import onnx
from onnx import shape_inference

from beers_deploy.quant.onnx.graph import Node, OnnxGraph, sizes_of

WINDOWS = {"AveragePool", "Conv", "ConvTranspose", "MaxPool", "Pad"}
WHOLE_IMAGE = "Global", "Reduce"
"""How the names of operators begin that read the whole image."""
SIZES_PX = (256, 320), (384, 512)
"""Rows and columns of the two images."""
MOST_PX = 128
"""The largest border that a network without padding can lack."""


def with_missing_border(model: onnx.ModelProto) -> onnx.ModelProto:
    """Return a network whose result has the size of its image, by mirroring the image beyond its
    borders first.

    Args:
        model: a float network without needless nodes; not changed.

    Returns:
        The network with a Pad in front; `model` itself if no border is missing.
    """
    nodes = model.graph.node
    windows = [node for node in nodes if node.op_type in WINDOWS]
    # Zeros that a layer pads with would lie beyond the mirrored border, not at the image's.
    is_padded = any(map(_is_padded, windows))
    reads_all = any(node.op_type.startswith(WHOLE_IMAGE) for node in nodes)
    border_px = 0 if is_padded or reads_all else _missing_px(model)
    if not border_px:
        return model
    network = deepcopy(model)
    # The sizes that a file of a fixed size states are those without the border.
    network.graph.ClearField("value_info")
    for dim in network.graph.output[0].type.tensor_type.shape.dim[2:]:
        dim.Clear()
    # 2.
    graph = OnnxGraph(network)
    image = network.graph.input[0].name
    mirrored = f"{image}.mirrored"
    for node in graph.readers[image]:
        node.inputs = tuple(mirrored if name == image else name for name in node.inputs)
    amounts = np.array([0, 0, border_px, border_px] * 2)
    pads = graph.add_constant(f"{mirrored}.pads", amounts, np.int64)
    pad = Node.new("Pad", [image, pads], mirrored, mode="reflect")
    graph.set_nodes([pad, *graph.nodes])
    graph.save()
    return network


def _is_padded(node: onnx.NodeProto) -> bool:
    """Return True for a node that adds pixels around its map."""
    states_pads = any(a.name == "pads" and any(a.ints) for a in node.attribute)
    # The pads of a transposed convolution cut its result.
    return node.op_type == "Pad" or (states_pads and node.op_type != "ConvTranspose")


def _missing_px(model: onnx.ModelProto) -> int:
    """Return how many pixels of a border are missing at each side; 0 for none (1)."""
    results = [_result_size(model, size) for size in SIZES_PX]
    if not all(results):
        return 0
    small, large = np.array(results)
    sides, larger_sides = np.array(SIZES_PX)
    growth = (large - small) / (larger_sides - sides)
    if growth.min() < 1:
        return 0
    borders = (sides - small / growth) / 2
    border_px = int(borders[0])
    return border_px if (borders == border_px).all() and 0 < border_px <= MOST_PX else 0


def _result_size(model: onnx.ModelProto, size: tuple[int, int]) -> tuple[int, ...]:
    """Return rows and columns of the result for an image of this size; empty if not known.

    Args:
        model: a float network of one input and one result.
        size: rows and columns of the image.
    """
    if len(model.graph.input) != 1 or len(model.graph.output) != 1:
        return ()
    network = deepcopy(model)
    network.graph.ClearField("value_info")
    dims = network.graph.input[0].type.tensor_type.shape.dim
    if len(dims) != 4:
        return ()
    for dim, side_px in zip(dims[2:], size, strict=True):
        dim.dim_value = side_px
    network.graph.output[0].type.tensor_type.ClearField("shape")
    try:
        inferred = shape_inference.infer_shapes(network)
    except shape_inference.InferenceError:
        return ()
    sizes = sizes_of(inferred.graph.output[0].type.tensor_type)
    return sizes[2:] if len(sizes) == 4 and min(sizes[2:]) > 0 else ()
