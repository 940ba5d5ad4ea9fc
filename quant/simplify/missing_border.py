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
from onnx import ModelProto, shape_inference

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.onnx.messages import sizes_of

WINDOWS = {"AveragePool", "Conv", "MaxPool"}
"""Operators whose pads add pixels around a map; those of a transposed convolution cut its result.
"""
WHOLE_IMAGE = "Global", "Reduce"
"""The beginnings of the names of operators that read the whole image."""
SIZES_PX = (256, 320), (384, 512)
"""Rows and columns of the two images."""
MOST_PX = 128
"""The largest border that a network without padding can lack."""


def with_missing_border(model: ModelProto) -> ModelProto:
    """Return a network whose result has the size of its image, by mirroring the image beyond its
    borders first.

    Args:
        model: a float network without needless nodes; not changed.

    Returns:
        The network with a Pad in front; `model` itself if no border is missing.
    """
    graph = OnnxGraph(model)
    # Zeros that a layer pads with would lie beyond the mirrored border, not at the image's.
    is_padded = any(node.op_type == "Pad" or _pads(graph, node) for node in graph.nodes)
    reads_all = any(node.op_type.startswith(WHOLE_IMAGE) for node in graph.nodes)
    border_px = 0 if is_padded or reads_all else _missing_px(model)
    if not border_px:
        return model
    network = deepcopy(model)
    # A file of a fixed size states the sizes without the border.
    network.graph.ClearField("value_info")
    for dim in network.graph.output[0].type.tensor_type.shape.dim[2:]:
        dim.Clear()
    # 2.
    graph = OnnxGraph(network)
    image = network.graph.input[0].name
    mirrored = f"{image}.mirrored"
    for node in graph.readers[image]:
        node.read_instead(image, mirrored)
    graph.set_nodes([graph.mirrored(image, border_px, mirrored), *graph.nodes])
    graph.save()
    return network


def _pads(graph: OnnxGraph, node: Node) -> bool:
    """Return True if a convolution or pool adds pixels around its map, also by `auto_pad`."""
    if node.op_type not in WINDOWS:
        return False
    weight = graph.value(node, 1)
    match = node.window(() if weight is None else weight.shape[2:])
    return any(node.attribute("pads", ()) if match is None else match[1].pads)


def _missing_px(model: ModelProto) -> int:
    """Return how many pixels of a border are missing at each side; 0 for none (1)."""
    dims = model.graph.input[0].type.tensor_type.shape.dim
    if len(model.graph.input) != 1 or len(model.graph.output) != 1 or len(dims) != 4:
        return 0
    results = []
    for image_size in SIZES_PX:
        network = deepcopy(model)
        network.graph.ClearField("value_info")
        dims = network.graph.input[0].type.tensor_type.shape.dim
        for dim, side_px in zip(dims[2:], image_size, strict=True):
            dim.dim_value = side_px
        network.graph.output[0].type.tensor_type.ClearField("shape")
        try:
            inferred = shape_inference.infer_shapes(network)
        except shape_inference.InferenceError:
            return 0
        size = sizes_of(inferred.graph.output[0].type.tensor_type)
        if len(size) != 4 or min(size[2:]) < 1:
            return 0
        results.append(size[2:])
    small, large = np.array(results)
    sides, larger_sides = np.array(SIZES_PX)
    growth = (large - small) / (larger_sides - sides)
    if growth.min() < 1:
        return 0
    borders = (sides - small / growth) / 2
    border_px = int(borders[0])
    return border_px if (borders == border_px).all() and 0 < border_px <= MOST_PX else 0
