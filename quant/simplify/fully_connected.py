"""Turn fully connected layers into convolutions as large as the map that was flattened for them.

1. The nodes that flatten a map of known size are recorded: Flatten, Reshape and Squeeze.
2. A Gemm on such a map becomes a convolution of the whole map.
3. Activations on a flat tensor are applied to the map instead, and a Softmax over a flat tensor
   becomes one along the channels of one pixel.
4. A Reshape that restores the map is removed, and the flattening with it.

A flattening remains behind each of them, and is removed if nothing reads it.
"""

from math import prod

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.standard_operators import Shapes

POINTWISE = {"Clip", "Elu", "HardSigmoid", "HardSwish", "LeakyRelu", "Relu", "Sigmoid", "Tanh"}
Map = tuple[int, int, int]
"""Channels, height, width."""


class ConnectByConvolutions:
    """A pass that turns fully connected layers into convolutions; an instance is given to
    `OnnxGraph.rewrite`.

    It remembers which tensors are flattened maps, and the maps that they were made from.
    """

    def __init__(self, shapes: Shapes) -> None:
        self._shapes = shapes
        self._maps: dict[str, tuple[str, Map]] = {}

    def __call__(self, graph: OnnxGraph, node: Node) -> list[Node] | None:
        """Return the nodes that replace a node, an empty list if it is not needed, and None if it
        stays.
        """
        name = node.inputs[0] if node.inputs else ""
        if self._flattens(graph, node):
            channels, height, width = self._shapes[name][1:]
            self._maps[node.outputs[0]] = name, (channels, height, width)
        if name not in self._maps or len(node.outputs) != 1:
            return None
        source, size = self._maps[name]
        if node.op_type == "Gemm":
            return self._connected(graph, node, source, size)
        is_over_channels = size[1:] == (1, 1) and node.attributes.get("axis", -1) in (1, -1)
        if node.op_type == "Softmax" and is_over_channels:
            softmax = Node.new("Softmax", [source], node.outputs[0], node.proto.name, axis=1)
            return self._flat(softmax, size)
        if node.op_type in POINTWISE:
            image = Node.of(node.written())
            image.inputs = (source, *node.inputs[1:])
            return self._flat(image, size)
        is_private = (
            graph.n_reads(name) == 1 and graph.n_reads(source) <= 1 and source in graph.writers
        )
        maps = [1, *size], [0, *size], [-1, *size]
        if is_private and node.op_type == "Reshape" and graph.numbers(node, 1, "") in maps:
            graph.rename(source, node.outputs[0])
            return []
        return None

    def _flattens(self, graph: OnnxGraph, node: Node) -> bool:
        """Return True if a node makes (N, C H W) of a map whose size is known (1)."""
        sizes = self._shapes.get(node.inputs[0], ()) if node.inputs else ()
        if len(sizes) != 4 or min(sizes[1:]) < 1:
            return False
        if node.op_type == "Flatten":
            return node.attributes.get("axis", 1) in (1, -3)
        operand = graph.numbers(node, 1, "") or []
        if node.op_type == "Squeeze" and operand:
            return {axis % 4 for axis in operand} == {2, 3}
        if node.op_type != "Reshape" or len(operand) != 2 or node.attributes.get("allowzero", 0):
            return False
        # In ONNX's Reshape a 0 copies the source's size and -1 stands for the remaining values.
        rows, columns = operand
        return columns == prod(sizes[1:]) or (columns == -1 and rows in (0, sizes[0]))

    def _connected(self, graph: OnnxGraph, node: Node, source: str, size: Map) -> list[Node] | None:
        """Return the convolution that computes a Gemm on a map of this size (2)."""
        weight = graph.value(node, 1)
        bias = graph.value(node, 2)
        has_bias = len(node.inputs) > 2 and node.inputs[2] != ""
        bias = bias if has_bias else np.zeros(1, np.float32)
        if weight is None or bias is None or {weight.dtype, bias.dtype} != {np.dtype(np.float32)}:
            return None
        attribute = node.attributes.get
        if weight.ndim != 2 or attribute("transA", 0):
            return None
        weight = weight if attribute("transB", 0) else weight.T
        if weight.shape[1] != prod(size) or bias.size not in (1, len(weight)):
            return None
        weight = weight * np.float32(attribute("alpha", 1.0))
        offset = np.broadcast_to(bias.reshape(-1) * attribute("beta", 1.0), len(weight))
        kernel = weight.reshape(-1, *size)
        conv = graph.convolution(source, node.outputs[0], node.name, kernel, offset)
        return self._flat(conv, (len(weight), 1, 1))

    def _flat(self, image: Node, size: Map) -> list[Node]:
        """Return a node that makes a map, and the map flat under the name of its result."""
        (name,) = image.outputs
        image.outputs = (f"{name}.map",)
        self._maps[name] = image.outputs[0], size
        return [image, Node.new("Flatten", image.outputs, name, f"{name}.flat")]
