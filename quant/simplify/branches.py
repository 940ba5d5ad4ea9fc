"""Join the axis of branches with that of channels, as networks stack maps.

SKNet and MIRNet stack the maps of their branches along an axis of its own, (N, K, C, H, W), weight
each by a Softmax over this axis, and add them. Others average stacked maps, or take the largest. A
DPU has four axes, and no Softmax. In (N, K C, H, W):

1. A Reshape or Unsqueeze that adds the axis is not needed. Concat and Mul stay.
2. The Softmax of two branches, Sigmoid(a - b) and Sigmoid(b - a), is a convolution of one pixel and
   a Sigmoid.
3. A sum or mean over the branches is a convolution of one pixel, their maximum is that of halves,
   and one branch is a part of the channels.

All of it is exact.
"""

from dataclasses import dataclass, replace

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement
from beers_deploy.quant.simplify.standard_operators import largest


@dataclass(frozen=True)
class Branches:
    """The map of four axes that has the values of a tensor of five.

    Attributes:
        name: the name of the map.
        axis: the axis of the tensor along which its branches lie.
        count: the number of branches.
        width: the number of channels of each.
    """

    name: str
    axis: int
    count: int
    width: int


class JoinBranches:
    """A pass that joins the axis of branches with that of channels; an instance is given to
    `OnnxGraph.rewrite`.

    It remembers the map of each tensor of five axes.
    """

    def __init__(self) -> None:
        self._maps: dict[str, Branches] = {}

    def __call__(self, graph: OnnxGraph, node: Node) -> Replacement:
        """Return the nodes that replace a node, or that compute the same map in front of it; None
        if it has no axis of branches.
        """
        before = graph.shapes.get(node.source, ())
        after = graph.shapes.get(node.result, ())
        if (len(before), len(after)) == (4, 5):
            self._start(graph, node)
            return None
        branches = self._maps.get(node.source)
        # What an earlier run of the pass has joined remains if a node reads it.
        if branches is None or f"{node.result}.joined" in graph.writers:
            return None
        if len(after) == 4:
            return _out_of(graph, node, branches)
        nodes = self._of_branches(graph, node, branches)
        if not nodes:
            return None
        count = branches.count
        if node.op_type == "Concat":
            count = sum(self._maps[name].count for name in node.inputs)
        self._maps[node.result] = replace(branches, name=nodes[-1].result, count=count)
        # The node itself is removed if nothing else reads it.
        return [*nodes, node]

    def _start(self, graph: OnnxGraph, node: Node) -> None:
        """Remember the map that a node gives an axis of branches (1)."""
        axes = graph.numbers(node, 1, "axes") if node.op_type == "Unsqueeze" else [1]
        if node.op_type not in ("Reshape", "Unsqueeze") or not axes:
            return
        axis = axes[0] % 5
        sizes = list(graph.shapes[node.result])
        count = sizes.pop(axis)
        width = sizes[1]
        sizes[1] *= count
        if sizes[1] and sizes == list(graph.shapes[node.source]):
            self._maps[node.result] = Branches(node.source, axis, count, width)

    def _of_branches(self, graph: OnnxGraph, node: Node, branches: Branches) -> list[Node]:
        """Return the nodes that compute what a node does, in four axes; none for another node."""
        joined = f"{node.result}.joined"
        is_along = node.attribute("axis", -1) % 5 == branches.axis
        if node.op_type == "Softmax" and is_along and branches.count == 2:
            difference = f"{node.result}.difference"
            weight = np.kron([[1, -1], [-1, 1]], np.eye(branches.width))[..., None, None]
            conv = graph.convolution(branches.name, difference, difference, weight)
            return [conv, Node.new("Sigmoid", [difference], joined)]
        factors = graph.value(node, 1) if node.op_type == "Mul" else None
        if factors is not None and factors.ndim == 5:
            # One number for each branch.
            if factors.size != branches.count or factors.shape[branches.axis] != factors.size:
                return []
            scales = np.repeat(factors, branches.width).reshape(1, -1, 1, 1)
            constant = graph.add_constant(f"{joined}.factors", scales)
            return [Node.new("Mul", [branches.name, constant], joined)]
        if not self._maps.keys() >= {*node.inputs}:
            return []
        parts = [self._maps[name] for name in node.inputs]
        maps = [part.name for part in parts]
        if len({(part.axis, part.width) for part in parts}) > 1:
            return []
        if node.op_type == "Concat" and is_along:
            return [Node.new("Concat", maps, joined, axis=1)]
        if node.op_type == "Mul" and len({part.count for part in parts}) == 1:
            return [Node.new("Mul", maps, joined)]
        return []


def _out_of(graph: OnnxGraph, node: Node, branches: Branches) -> Replacement:
    """Return the nodes that compute a map of all branches, or of one; None for another node (3)."""
    count = branches.count
    width = branches.width
    reduced = [axis % 5 for axis in graph.numbers(node, 1, "axes") or ()]
    if node.op_type.startswith("Reduce") and reduced == [branches.axis]:
        if node.op_type == "ReduceMax":
            return largest(graph, node, branches.name, count, width)
        if node.op_type not in ("ReduceMean", "ReduceSum"):
            return None
        share = count if node.op_type == "ReduceMean" else 1
        weight = np.tile(np.eye(width) / share, count)[..., None, None]
        return [graph.convolution(branches.name, node.result, node.name, weight)]
    place = graph.value(node, 1) if node.op_type == "Gather" else None
    if place is None or place.ndim or node.attribute("axis", 0) % 5 != branches.axis:
        return None
    numbers = np.arange(count * width).reshape(count, width)[int(place)]
    chosen = graph.add_constant(f"{node.result}.channels", numbers, np.int64)
    return [node.replaced_by("Gather", [branches.name, chosen], axis=1)]
