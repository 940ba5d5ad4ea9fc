"""Turn fully connected layers into convolutions as large as the map that was flattened for them.

1. The nodes that flatten a map of known size are recorded: Flatten, Reshape and Squeeze.
2. A Gemm on such a map becomes a convolution of the whole map.
3. Activations of a flat tensor, and its arithmetic with one number, are applied to the map instead,
   and a Softmax over a flat tensor becomes one along the channels of one pixel.
4. A Reshape or Unsqueeze that restores the map is removed, and the flattening with it.
5. A convolution along the channels of one pixel, as in efficient channel attention (ECA), becomes a
   convolution of that pixel that connects neighbouring channels.

A flattening remains behind each of them, and is removed if nothing reads it.
"""

from dataclasses import replace
from math import prod

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement

POINTWISE = {"Clip", "Elu", "HardSigmoid", "HardSwish", "LeakyRelu", "Relu", "Sigmoid", "Tanh"}
ARITHMETIC = {"Add", "Div", "Mul", "Sub"}
MOVES = {"Flatten", "Reshape", "Squeeze", "Transpose", "Unsqueeze"}
Map = tuple[int, int, int]
"""Channels, height, width."""


class ConnectByConvolutions:
    """A pass that turns fully connected layers into convolutions; an instance is given to
    `OnnxGraph.rewrite`.

    It remembers which tensors are flattened maps, and the maps that they were made from.
    """

    def __init__(self) -> None:
        self._maps: dict[str, tuple[str, Map]] = {}

    def __call__(self, graph: OnnxGraph, node: Node) -> Replacement:
        """Return the nodes that replace a node, an empty list if it is not needed, and None if it
        stays.
        """
        name = node.source
        if self._flattens(graph, node):
            channels, height, width = graph.shapes[name][1:]
            self._maps[node.result] = name, (channels, height, width)
        if name not in self._maps or len(node.outputs) != 1:
            return None
        source, size = self._maps[name]
        if node.op_type == "Gemm":
            return self._connected(graph, node, source, size)
        is_over_channels = size[1:] == (1, 1) and node.attribute("axis", -1) in (1, -1)
        if node.op_type == "Softmax" and is_over_channels:
            softmax = Node.new("Softmax", [source], node.result, node.proto.name, axis=1)
            return self._flat(softmax, size)
        operand = graph.value(node, 1)
        is_scaled = node.op_type in ARITHMETIC and operand is not None and operand.size == 1
        if node.op_type in POINTWISE or is_scaled:
            return self._flat(replace(node, inputs=(source, *node.inputs[1:])), size)
        return self._restored(graph, node) if node.op_type in ("Reshape", "Unsqueeze") else None

    def _restored(self, graph: OnnxGraph, node: Node) -> Replacement:
        """Return an empty list for a node that only restores a map; None for another (4)."""
        source, size = self._maps[node.source]
        sides = graph.shapes.get(node.result, ())[1:]
        is_private = graph.n_reads(node.source) == 1 and graph.n_reads(source) <= 1
        if is_private and source in graph.writers and sides == size:
            graph.rename(source, node.result)
            return []
        # One pixel may get its axes one after the other.
        if sides == size[:2] and size[1:] == (1, 1):
            self._maps[node.result] = source, size
        return None

    def _flattens(self, graph: OnnxGraph, node: Node) -> bool:
        """Return True if a node makes (N, C H W) of a map whose size is known (1)."""
        sizes = graph.shapes.get(node.source, ())
        if len(sizes) != 4 or min(sizes[1:]) < 1:
            return False
        if node.op_type == "Flatten":
            return node.attribute("axis", 1) in (1, -3)
        operand = graph.numbers(node, 1, "") or []
        if node.op_type == "Squeeze" and operand:
            return {axis % 4 for axis in operand} == {2, 3}
        if node.op_type != "Reshape" or len(operand) != 2:
            return False
        # In ONNX's Reshape a 0 copies the source's size and -1 stands for the remaining values.
        rows, columns = operand
        return (columns or sizes[1]) == prod(sizes[1:]) or (columns == -1 and rows in (0, sizes[0]))

    def _connected(self, graph: OnnxGraph, node: Node, source: str, size: Map) -> Replacement:
        """Return the convolution that computes a Gemm on a map of this size (2)."""
        weight = graph.value(node, 1)
        bias = graph.value(node, 2)
        bias = bias if any(node.inputs[2:]) else np.zeros(1)
        attribute = node.attribute
        if weight is None or bias is None or weight.ndim != 2 or attribute("transA", 0):
            return None
        weight = weight if attribute("transB", 0) else weight.T
        if weight.shape[1] != prod(size) or bias.size not in (1, len(weight)):
            return None
        weight = weight * np.float32(attribute("alpha", 1.0))
        offset = np.broadcast_to(bias.reshape(-1) * attribute("beta", 1.0), len(weight))
        kernel = weight.reshape(-1, *size)
        conv = graph.convolution(source, node.result, node.name, kernel, offset)
        return self._flat(conv, (len(weight), 1, 1))

    def _flat(self, image: Node, size: Map) -> list[Node]:
        """Return a node that makes a map, and the map flat under the name of its result."""
        (name,) = image.outputs
        image.outputs = (f"{name}.map",)
        self._maps[name] = image.result, size
        return [image, Node.new("Flatten", image.outputs, name, f"{name}.flat")]


def connect_neighbours(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a convolution along the channels of one pixel by one of that pixel (5).

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node; the last one that moves values behind the convolution is replaced.

    Returns:
        The convolution and the activations behind it; None if the node is something else.
    """
    result = node.result
    size = graph.shapes.get(result, ())
    channels = size[1] if len(size) == 4 else 0
    if node.op_type not in MOVES or not channels or size[2:] != (1, 1):
        return None
    activations, convolution = _in_front(graph, result, MOVES | POINTWISE)
    weight = graph.value(convolution, 1)
    if convolution.op_type != "Conv" or len(convolution.inputs) != 2:
        return None
    # Nodes that move values keep the order of the channels, because each other size is 1.
    source = _in_front(graph, convolution.source, MOVES)[1].result
    is_of_channels = weight is not None and weight.shape[:-1] == (1, 1)
    if weight is None or not is_of_channels or graph.shapes.get(source, ())[1:] != size[1:]:
        return None
    taps = weight.ravel()
    pad = len(taps) // 2
    attribute = convolution.attribute
    is_plain = attribute("strides", [1]) == attribute("dilations", [1]) == [1]
    if attribute("pads") != [pad] * 2 or not is_plain:
        return None
    band = sum(tap * np.eye(channels, k=k - pad) for k, tap in enumerate(taps))
    nodes = [graph.convolution(source, f"{result}.0", convolution.name, band[..., None, None])]
    for number, activation in enumerate(activations, 1):
        inputs = (nodes[-1].result, *activation.inputs[1:])
        nodes.append(replace(activation, inputs=inputs, outputs=(f"{result}.{number}",)))
    nodes[-1].outputs = (result,)
    return nodes


def _in_front(graph: OnnxGraph, name: str, skipped: set[str]) -> tuple[list[Node], Node]:
    """Return the first node in front of a tensor whose operator is not to be skipped, and the
    activations between, in order.
    """
    activations: list[Node] = []
    while (node := graph.writer(name)).op_type in skipped:
        if node.op_type in POINTWISE:
            activations.insert(0, node)
        name = node.source
    return activations, node
