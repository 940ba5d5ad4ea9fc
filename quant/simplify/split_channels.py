"""Compute each part of a map's channels by separate operations, so that nothing splits a map.

1. A Split, or a Slice, along the channels has parts, each a list of channels.
2. If only such nodes read a map, and a convolution writes it, each part becomes a convolution with
   the weights of its channels. Activations and depthwise convolutions in between are divided with
   it. The amount of computation does not change.
3. In front of any other operation, a convolution of one pixel selects the channels.

All of it is exact. The divided nodes remain, and are removed if nothing reads them.
"""

from functools import partial

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.fold_affine import is_convolution
from beers_deploy.quant.simplify.standard_operators import Shapes

POINTWISE = {"HardSigmoid", "HardSwish", "LeakyRelu", "Relu", "Sigmoid", "Tanh"}
CHANNEL_AXIS = (1, -3)
Part = tuple[str, np.ndarray]
"""The name of a part, and the numbers of its channels."""


def split_channels(shapes: Shapes, graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Return operations that compute the parts of a map (1).

    Args:
        shapes: of each float tensor.
        graph: that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The operations that replace the node, None if it does not split.
    """
    parts = _parts(graph, node, shapes)
    source = node.inputs[0] if parts else ""
    only_parts = all(_parts(graph, reader, shapes) for reader in graph.readers[source])
    if source in graph.outputs or not only_parts:
        compute = partial(_select, graph, source, shapes.get(source, (0, 0))[1])
    else:
        compute = partial(_divide, graph, source, shapes)
    nodes: list[Node] = []
    for name, channels in parts:
        nodes += compute(channels, name)
    return nodes or None


def _parts(graph: OnnxGraph, node: Node, shapes: Shapes) -> list[Part]:
    """Return the parts of a map of known channels that a node selects; none for another node.

    Args:
        graph: that the node belongs to.
        node: any node.
        shapes: of each float tensor.
    """
    source = shapes.get(node.inputs[0], ()) if node.inputs else ()
    if len(source) != 4 or source[1] < 1:
        return []
    numbers = np.arange(source[1])
    if node.op_type == "Split" and node.attributes.get("axis", 0) in CHANNEL_AXIS:
        sizes = [shapes.get(name, ()) for name in node.outputs]
        if not all(len(size) == 4 and size[1] > 0 for size in sizes):
            return []
        ends = np.cumsum([size[1] for size in sizes])
        return list(zip(node.outputs, np.split(numbers, ends[:-1]), strict=True))
    if node.op_type == "Slice":
        starts, stops, axes, steps = (graph.numbers(node, place, "") for place in range(1, 5))
        if starts and stops and axes and len(axes) == 1 and axes[0] in CHANNEL_AXIS:
            step = steps[0] if steps else 1
            return [(node.outputs[0], numbers[starts[0] : stops[0] : step])]
    return []


def _divide(
    graph: OnnxGraph, source: str, shapes: Shapes, channels: np.ndarray, name: str
) -> list[Node]:
    """Return the operations that compute some channels of a map that is never needed as a whole
    (2).

    Args:
        graph: its constants are extended by the weights of the part.
        source: the map.
        shapes: of each float tensor.
        channels: the numbers of the channels, (C,).
        name: of the part.
    """
    before = graph.writers.get(source)
    divided_name = f"{name}.{before.op_type}" if before else ""
    # An activation works on each value by itself, so it is repeated behind the part.
    if before is not None and before.op_type in POINTWISE:
        inner = f"{name}.before"
        behind = Node.of(before.written())
        behind.proto.name = divided_name
        behind.inputs = (inner,)
        behind.outputs = (name,)
        return [*_part_of(graph, before.inputs[0], shapes, channels, inner), behind]
    if before is None or before.op_type != "Conv" or not is_convolution(graph, before):
        return _select(graph, source, shapes[source][1], channels, name)
    weight = graph.constants[before.inputs[1]]
    groups = before.attributes.get("group", 1)
    is_depthwise = groups == len(weight) and weight.shape[1] == 1
    # The channels of a group read others of their group, which the part need not have.
    if groups != 1 and not is_depthwise:
        return _select(graph, source, len(weight), channels, name)
    bias = graph.value(before, 2)
    bias = bias if bias is None else bias[channels]
    attributes = {**before.attributes}
    source = before.inputs[0]
    nodes: list[Node] = []
    if groups != 1:
        # A depthwise kernel reads the channel that it writes, so the map in front has parts too.
        nodes = _part_of(graph, source, shapes, channels, f"{name}.before")
        source = f"{name}.before"
        attributes["group"] = len(channels)
    conv = graph.convolution(source, name, divided_name, weight[channels], bias, **attributes)
    return [*nodes, conv]


def _part_of(
    graph: OnnxGraph, source: str, shapes: Shapes, channels: np.ndarray, name: str
) -> list[Node]:
    """Return the operations that compute some channels of a map that one node reads, or several.

    Args:
        graph: its constants are extended.
        source: the map.
        shapes: of each float tensor.
        channels: the numbers of the channels, (C,).
        name: of the part.
    """
    if graph.n_reads(source) == 1:
        return _divide(graph, source, shapes, channels, name)
    return _select(graph, source, shapes[source][1], channels, name)


def _select(
    graph: OnnxGraph, source: str, width: int, channels: np.ndarray, name: str
) -> list[Node]:
    """Return a convolution of one pixel that selects channels (3).

    Args:
        graph: its constants are extended.
        source: the map.
        width: channels of the map.
        channels: the numbers of those that are selected, (C,).
        name: of the part.
    """
    weight = np.eye(width)[channels][..., None, None]
    return [graph.convolution(source, name, f"{name}.Conv", weight)]
