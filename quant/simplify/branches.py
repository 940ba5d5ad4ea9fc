"""Join the axis of branches with that of channels, as SKNet and MIRNet choose among branches.

Such a block stacks the maps of its branches along an axis of its own, (N, K, C, H, W), weights each
by a Softmax over this axis, and adds them. A DPU has four axes, and no Softmax. In (N, K C, H, W):

1. A Reshape or Unsqueeze that divides the channels is not needed. Concat and Mul stay.
2. The Softmax of two branches, Sigmoid(a - b) and Sigmoid(b - a), is a convolution of one pixel and
   a Sigmoid.
3. A sum over the branches is a convolution of one pixel, and one branch is a part of the channels.

All of it is exact.
"""

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement

BRANCH_AXES = (1, -4)


class JoinBranches:
    """A pass that joins the axis of branches with that of channels; an instance is given to
    `OnnxGraph.rewrite`.

    It remembers for each tensor of five axes the map of four that has the same values.
    """

    def __init__(self) -> None:
        self._maps: dict[str, str] = {}

    def __call__(self, graph: OnnxGraph, node: Node) -> Replacement:
        """Return the nodes that replace a node, or that compute the same map in front of it; None
        if it has no axis of branches.
        """
        before = graph.shapes.get(node.source, ())
        after = graph.shapes.get(node.result, ())
        if len(after) == 5 and node.op_type in ("Reshape", "Unsqueeze"):
            batch, branches, channels, *sides = after
            if branches * channels and before == (batch, branches * channels, *sides):
                self._maps[node.result] = node.source
            return None
        if len(before) != 5 or node.source not in self._maps:
            return None
        _, branches, channels, *_ = before
        if len(after) != 5:
            return self._out_of(graph, node, branches, channels)
        nodes = self._of_branches(graph, node, branches, channels)
        if not nodes:
            return None
        self._maps[node.result] = nodes[-1].result
        # The node itself is removed if nothing else reads it.
        return [*nodes, node]

    def _of_branches(
        self, graph: OnnxGraph, node: Node, branches: int, channels: int
    ) -> list[Node]:
        """Return the nodes that compute what a node does, in four axes; none for another node."""
        joined = f"{node.result}.joined"
        axis = node.attribute("axis", -1)
        if node.op_type == "Softmax" and axis in BRANCH_AXES and branches == 2:
            difference = f"{node.result}.difference"
            weight = np.kron([[1, -1], [-1, 1]], np.eye(channels))[..., None, None]
            conv = graph.convolution(self._maps[node.source], difference, difference, weight)
            return [conv, Node.new("Sigmoid", [difference], joined, node.name)]
        if not self._maps.keys() >= {*node.inputs}:
            return []
        maps = [self._maps[name] for name in node.inputs]
        if node.op_type == "Concat" and axis in BRANCH_AXES:
            return [Node.new("Concat", maps, joined, node.name, axis=1)]
        are_alike = len({graph.shapes[name][:3] for name in node.inputs}) == 1
        if node.op_type == "Mul" and are_alike:
            return [Node.new("Mul", maps, joined, node.name)]
        return []

    def _out_of(self, graph: OnnxGraph, node: Node, branches: int, channels: int) -> Replacement:
        """Return the nodes that compute a map of all branches, or of one; None for another node."""
        source = self._maps[node.source]
        if node.op_type == "ReduceSum" and graph.numbers(node, 1, "axes") in ([1], [-4]):
            weight = np.tile(np.eye(channels), branches)[..., None, None]
            return [graph.convolution(source, node.result, node.name, weight)]
        place = graph.value(node, 1) if node.op_type == "Gather" else None
        if place is None or place.ndim or node.attribute("axis", 0) not in BRANCH_AXES:
            return None
        numbers = np.arange(branches * channels).reshape(branches, channels)[int(place)]
        chosen = graph.add_constant(f"{node.result}.channels", numbers, np.int64)
        return [node.replaced_by("Gather", [source, chosen], axis=1)]
