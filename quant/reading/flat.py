"""Fully connected layers as convolutions of the whole map that they read, the flattening left behind them.

A DPU runs them as such, and a quantiser that knows convolutions knows them too. A Softmax over what is flat becomes
one along the channels of a map of one pixel.
"""

from copy import deepcopy
from math import prod

import numpy as np
from onnx import NodeProto, helper

from beers_deploy.quant.reading.nodes import Nodes, Shapes, attributes_of

POINTWISE = {"Clip", "Elu", "HardSigmoid", "HardSwish", "LeakyRelu", "Relu", "Sigmoid", "Tanh"}
Map = tuple[int, int, int]
"""Channels, height, width."""


class Unflatten:
    """A step of `Nodes.pass_over`: it remembers which tensors are flat maps."""

    def __init__(self, shapes: Shapes) -> None:
        self._shapes = shapes
        self._maps: dict[str, tuple[str, Map]] = {}

    def __call__(self, graph: Nodes, node: NodeProto) -> list[NodeProto] | None:
        """What stands for a node, None where it stays."""
        if self._flattens(graph, node):
            source = node.input[0]
            channels, height, width = self._shapes[source][1:]
            self._maps[node.output[0]] = source, (channels, height, width)
        found = self._maps.get(node.input[0]) if node.input else None
        if found is None or len(node.output) != 1:
            return None
        source, size = found
        if node.op_type == "Gemm":
            return self._connected(graph, node, source, size)
        if node.op_type == "Softmax" and size[1:] == (1, 1) and attributes_of(node).get("axis", -1) in (1, -1):
            return self._flat(helper.make_node("Softmax", [source], node.output, name=node.name, axis=1), size)
        if node.op_type in POINTWISE:
            image = deepcopy(node)
            image.input[0] = source
            return self._flat(image, size)
        unseen = graph.reads[node.input[0]] == 1 and graph.reads[source] <= 1 and source in graph.writers
        maps = [1, *size], [0, *size], [-1, *size]
        if unseen and node.op_type == "Reshape" and graph.integers(node.input[1]) in maps:
            graph.rename(source, node.output[0])  # nothing stands in the place of what makes a map of it again
            return []
        return None

    def _flattens(self, graph: Nodes, node: NodeProto) -> bool:
        """Whether a node makes (N, C H W) of a map whose size is known."""
        sizes = self._shapes.get(node.input[0], ()) if node.input else ()
        if len(sizes) != 4 or min(sizes[1:]) < 1:
            return False
        if node.op_type == "Flatten":
            return attributes_of(node).get("axis", 1) in (1, -3)
        asked = graph.integers(node.input[1]) if len(node.input) == 2 else None
        if node.op_type == "Squeeze" and asked:
            return {axis % 4 for axis in asked} == {2, 3}
        if node.op_type != "Reshape" or asked is None or len(asked) != 2 or attributes_of(node).get("allowzero", 0):
            return False
        return asked[1] == prod(sizes[1:]) or (asked[1] == -1 and asked[0] in (0, sizes[0]))

    def _connected(self, graph: Nodes, node: NodeProto, source: str, size: Map) -> list[NodeProto] | None:
        given = attributes_of(node)
        weight = graph.array(node.input[1])
        bias = graph.array(node.input[2]) if len(node.input) > 2 and node.input[2] else np.zeros(1)
        if weight is None or bias is None or weight.ndim != 2 or given.get("transA", 0):
            return None
        weight = (weight if given.get("transB", 0) else weight.T) * np.float32(given.get("alpha", 1.0))
        if weight.shape[1] != prod(size) or bias.size not in (1, len(weight)):
            return None
        offset = np.broadcast_to(bias.reshape(-1) * given.get("beta", 1.0), len(weight))
        name = node.name or node.output[0]
        values = {"weight": weight.reshape(-1, *size), "bias": offset}
        numbers = [graph.keep(f"{name}.{role}", value) for role, value in values.items()]
        made = helper.make_node("Conv", [source, *numbers], node.output, name=name, kernel_shape=list(size[1:]))
        return self._flat(made, (len(weight), 1, 1))

    def _flat(self, image: NodeProto, size: Map) -> list[NodeProto]:
        """A node that gives a map, and the map flat under the name of its result."""
        name = image.output[0]
        image.output[0] = f"{name}.map"
        self._maps[name] = image.output[0], size
        return [image, helper.make_node("Flatten", image.output, [name], name=f"{name}.flat")]
