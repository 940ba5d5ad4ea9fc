"""Replace activations that exporters write as several operators by the one operator that a DPU has.

1. Clip, Max, Min and ReLU, also one after the other, are ReLU, or ReLU6 of a scaled map.
2. A shift by 3, a clip from 0 to 6 and a sixth are HardSigmoid. They are HardSwish if they are
   multiplied by the tensor itself, in any order.
3. (Tanh(x) + 1) / 2 is Sigmoid(2 x).
4. GELU, x (1 + Erf(x / sqrt(2))) / 2 or x (1 + Tanh(sqrt(2 / pi) (x + 0.044715 x^3))) / 2, stays
   spelled out, but its half comes first. Behind the product it would be folded into the next
   convolution, and in front of it be a part of a Sigmoid, and nobody would recognise the rest.
"""

from collections.abc import Callable
from math import pi, sqrt
from typing import NamedTuple

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement
from beers_deploy.quant.simplify.fold_affine import affine_chain

UNLIMITED = 1e30
"""A Clip above this value limits nothing."""
SLOPE_AND_OFFSET = {"alpha": 1 / 6, "beta": 0.5}
"""Slope and offset of the HardSigmoid in HardSwish; ONNX's default slope differs."""


def join_clips(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace nodes that clip one after the other by one Relu or Clip from 0 to 6 (point 1 of the
    module).

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The activation, between a scaling and its inverse if it has other limits. None if the node
        is something else.
    """
    source, low, high, count = joint_limits(graph, node)
    result = node.result
    if count == 1 and (node.op_type == "Relu" or (low, high) == (0, 6)):
        return None
    if low == 0 and high == np.inf:
        return [node.replaced_by("Relu", [source])]
    readers = {reader.op_type for reader in graph.readers[result]}
    is_last = result in graph.outputs or "DepthToSpace" in readers
    # A bank of filters for a sensor is mirrored, and is quantised from its weights.
    is_bank = any(other.op_type == "Pad" for other in graph.nodes)
    if is_last or is_bank or not -np.inf < low < high < np.inf:
        return None
    unit = (high - low) / 6

    def constant(role: str, value: float) -> str:
        return graph.add_constant(f"{result}.{role}", value)

    ends = [constant("zero", 0), constant("six", 6)]
    if (low, high) == (0, 6):
        return [node.replaced_by("Clip", [source, *ends])]
    names = [f"{result}.{role}" for role in ("shifted", "divided", "clipped", "times")]
    shifted, divided, clipped, times = names
    return [
        Node.new("Sub", [source, constant("low", low)], shifted),
        Node.new("Div", [shifted, constant("unit", unit)], divided),
        Node.new("Clip", [divided, *ends], clipped, node.name),
        Node.new("Mul", [clipped, constant("unit", unit)], times),
        Node.new("Add", [times, constant("low", low)], result, f"{result}.raised"),
    ]


class Clipping(NamedTuple):
    """What nodes that clip one after the other compute together.

    Attributes:
        source: the tensor that is clipped; "" without nodes.
        low: the low limit.
        high: the high limit.
        nodes: the number of the nodes.
    """

    source: str = ""
    low: float = -np.inf
    high: float = np.inf
    nodes: int = 0

    @property
    def limits(self) -> tuple[float, float]:
        """The low and the high limit."""
        return self.low, self.high


def joint_limits(graph: OnnxGraph, node: Node) -> Clipping:
    """Return what a node and those in front of it, which only clip, compute together.

    Args:
        graph: the graph that the node belongs to.
        node: the last of the nodes; another node returns a clipping of 0 nodes.
    """
    joint = Clipping()
    while first := _clipping(graph, node):
        low, high = np.clip(first.limits, *joint.limits).tolist()
        joint = Clipping(first.source, low, high, joint.nodes + 1)
        node = graph.sole_writer(first.source)
    return joint


def _clipping(graph: OnnxGraph, node: Node) -> Clipping | None:
    """Return what a single node clips; None if it does not clip, or by computed limits."""
    if node.op_type == "Relu":
        return Clipping(node.source, low=0.0)
    if node.op_type == "Clip":
        source, low_name, high_name = (*node.inputs, "", "")[:3]
        low = _number(graph, low_name) if low_name else -np.inf
        high = _number(graph, high_name) if high_name else np.inf
        if low is None or high is None:
            return None
        return Clipping(source, low, high if high < UNLIMITED else np.inf)
    is_binary = node.op_type in ("Max", "Min") and len(node.inputs) == 2
    for source, name in node.orders if is_binary else ():
        if (limit := _number(graph, name)) is not None:
            by_max = node.op_type == "Max"
            return Clipping(source, low=limit) if by_max else Clipping(source, high=limit)
    return None


def join_hard_swish(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace nodes that together compute a HardSwish or a HardSigmoid by that operator (point 2 of
    the module).

    Args:
        graph: the graph that the node belongs to.
        node: any node; only the last of such nodes is replaced. Those in front of it are removed
            later if nothing else reads them.

    Returns:
        The activation; None if the node completes none.
    """
    name = node.result
    clipped = other_operand(graph, name, "Mul", 1 / 6) or other_operand(graph, name, "Div", 6)
    if shifted := _shifted_and_clipped(graph, clipped):
        return [node.replaced_by("HardSigmoid", [shifted], **SLOPE_AND_OFFSET)]
    product = graph.sole_writer(clipped)
    source = _gated_by(graph, product, _shifted_and_clipped)
    source = source or _gated_by(graph, node, _hard_sigmoid_of)
    return [node.replaced_by("HardSwish", [source])] if source else None


def join_sigmoid(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace (Tanh(x) + 1) / 2, in any spelling, by Sigmoid(2 x) (point 3 of the module).

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node; only the last of the arithmetic is replaced.

    Returns:
        A product and the Sigmoid; None if the node is something else.
    """
    result = node.result
    source, affine = affine_chain(graph, result)
    tanh = graph.sole_writer(source)
    if tanh.op_type != "Tanh" or {*affine.scale, *affine.shift} != {0.5}:
        return None
    doubled = f"{result}.doubled"
    two = graph.add_constant(f"{result}.two", 2)
    return [
        Node.new("Mul", [tanh.source, two], doubled),
        node.replaced_by("Sigmoid", [doubled]),
    ]


def halve_before_gelu(graph: OnnxGraph, node: Node) -> Replacement:
    """Move the factor 1/2 of a GELU in front of its product (point 4 of the module).

    Args:
        graph: the graph that the node belongs to.
        node: any node; only the last multiplication is replaced.

    Returns:
        x / 2, and the product that completes the GELU; None if the node stays.
    """
    for inner, outer in node.orders if node.op_type == "Mul" else ():
        product = graph.sole_writer(inner)
        # Either the half is multiplied last, or the tensor itself.
        for gate, other in product.orders if product.op_type == "Mul" else ():
            source = gelu_gate_input(graph, gate)
            halves = {name for name in (other, outer) if _is_number(graph, name, 0.5)}
            if source and halves and {other, outer} == {source, *halves}:
                halved = f"{inner}.half"
                return [
                    Node.new("Mul", [source, *halves], halved),
                    node.replaced_by("Mul", [halved, gate]),
                ]
    return None


def gelu_gate_input(graph: OnnxGraph, name: str) -> str:
    """Return the name of x if a tensor is the factor of x in a GELU, without its half: 1 + Erf(x /
    sqrt(2)), or 1 + Tanh(sqrt(2 / pi) (x + 0.044715 x^3)); else "".

    Args:
        graph: the graph that the tensor belongs to.
        name: the name of the tensor.
    """
    function = graph.writer(other_operand(graph, name, "Add", 1))
    scaled = function.source
    if function.op_type == "Erf":
        # Exporters divide by sqrt(2), or multiply by its reciprocal.
        by_factor = other_operand(graph, scaled, "Mul", sqrt(0.5))
        return by_factor or other_operand(graph, scaled, "Div", sqrt(2))
    total = graph.writer(other_operand(graph, scaled, "Mul", sqrt(2 / pi)))
    is_cubic = function.op_type == "Tanh" and total.op_type == "Add"
    for source, cubic in total.orders if is_cubic else ():
        cube = graph.writer(other_operand(graph, cubic, "Mul", 0.044715))
        if _gated_by(graph, cube, squared) == source:
            return source
    return ""


def _gated_by(graph: OnnxGraph, node: Node, gated: Callable[[OnnxGraph, str], str]) -> str:
    """Return x if a node computes x times a function of x; else ""."""
    pairs = node.orders if node.op_type == "Mul" else ()
    return next((source for source, gate in pairs if source == gated(graph, gate)), "")


def squared(graph: OnnxGraph, name: str) -> str:
    """Return the name of x if a tensor is x times x; else "".

    Args:
        graph: the graph that the tensor belongs to.
        name: the name of the tensor.
    """
    node = graph.writer(name)
    return node.source if node.op_type == "Mul" and len({*node.inputs}) == 1 else ""


def _hard_sigmoid_of(graph: OnnxGraph, name: str) -> str:
    """Return x if a tensor is HardSigmoid(x) of slope 1/6; else ""."""
    node = graph.writer(name)
    return node.source if node.op_type == "HardSigmoid" and has_slope_of_dpu(node) else ""


def has_slope_of_dpu(node: Node) -> bool:
    """Return True if a HardSigmoid has the slope 1/6 and the offset 0.5, as a DPU computes it."""
    return np.allclose(slope_and_offset(node), (1 / 6, 0.5), 1e-4)


def slope_and_offset(node: Node) -> tuple[float, float]:
    """Return the slope and the offset of a HardSigmoid, with ONNX's defaults filled in."""
    return node.attribute("alpha", 0.2), node.attribute("beta", 0.5)


def _shifted_and_clipped(graph: OnnxGraph, name: str) -> str:
    """Return x if a tensor is x + 3, clipped from 0 to 6; else ""."""
    clipping = joint_limits(graph, graph.writer(name))
    return other_operand(graph, clipping.source, "Add", 3) if clipping.limits == (0, 6) else ""


def other_operand(graph: OnnxGraph, name: str, kind: str, number: float) -> str:
    """Return the name of the tensor that is combined with a constant number to another one; "" if
    that is computed in another way.

    Args:
        graph: the graph that the tensors belong to.
        name: the name of the result.
        kind: the operator that writes it, with two operands. The constant may be either of them,
            but for Div it must be the divisor.
        number: the constant, which is compared up to the rounding of float32.
    """
    node = graph.writer(name)
    orders = node.orders if node.op_type == kind and len(node.inputs) == 2 else ()
    for source, constant in orders[:1] if kind == "Div" else orders:
        if _is_number(graph, constant, number):
            return source
    return ""


def _is_number(graph: OnnxGraph, name: str, number: float) -> bool:
    """Return True if a tensor is a constant of this one number, up to the rounding of float32."""
    value = _number(graph, name)
    return value is not None and bool(np.isclose(value, number, rtol=1e-6, atol=0))


def _number(graph: OnnxGraph, name: str) -> float | None:
    """Return the value of a constant of one float; None for any other tensor."""
    value = graph.constants.get(name)
    if value is None or value.size != 1 or value.dtype.kind != "f":
        return None
    return float(value.item())
