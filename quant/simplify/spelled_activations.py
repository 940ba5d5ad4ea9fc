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

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.fold_affine import affine_chain

UNLIMITED = 1e30
"""A Clip above this value limits nothing."""
SLOPE_AND_OFFSET = {"alpha": 1 / 6, "beta": 0.5}
"""Slope and offset of the HardSigmoid in HardSwish; ONNX's default slope differs."""


def join_clips(graph: OnnxGraph, node: Node) -> list[Node] | None:
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
        return graph.add_constant(f"{result}.{role}", np.array(value))

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


def joint_limits(graph: OnnxGraph, node: Node | None) -> tuple[str, float, float, int]:
    """Return what a node and those in front of it, which only clip, have in common.

    Args:
        graph: the graph that the node belongs to.
        node: the last of the nodes; None returns no name and a count of 0.

    Returns:
        The tensor that is clipped, its low and its high limit, and the number of nodes.
    """
    low = -np.inf
    high = np.inf
    source = ""
    count = 0
    while node is not None and (step := _limits(graph, node)) is not None:
        source, *limits = step
        low, high = (float(np.clip(limit, low, high)) for limit in limits)
        node = graph.sole_writer(source)
        count += 1
    return source, low, high, count


def _limits(graph: OnnxGraph, node: Node) -> tuple[str, float, float] | None:
    """Return the tensor that a node clips, and the low and the high limit; None for another."""
    source = node.source
    if node.op_type == "Relu":
        return source, 0.0, np.inf
    if node.op_type == "Clip":
        low, high = (
            _scalar(graph, node, place) if any(node.inputs[place : place + 1]) else limit
            for place, limit in ((1, -np.inf), (2, np.inf))
        )
        if low is None or high is None:
            return None
        return source, low, high if high < UNLIMITED else np.inf
    if node.op_type in ("Max", "Min") and len(node.inputs) == 2:
        for place in (0, 1):
            limit = _scalar(graph, node, 1 - place)
            if limit is not None:
                ends = (limit, np.inf) if node.op_type == "Max" else (-np.inf, limit)
                return (node.inputs[place], *ends)
    return None


def join_hard_swish(graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Replace nodes that together compute a HardSwish or a HardSigmoid by that operator (point 2 of
    the module).

    Args:
        graph: the graph that the node belongs to.
        node: any node; only the last of such nodes is replaced. Those in front of it are removed
            later if nothing else reads them.

    Returns:
        The activation; None if the node completes none.
    """
    sixth = other_operand(graph, node, "Mul", 1 / 6) or other_operand(graph, node, "Div", 6)
    clipped = sixth or ""
    shifted = _shifted_and_clipped(graph, clipped)
    if shifted is not None:
        return [node.replaced_by("HardSigmoid", [shifted], **SLOPE_AND_OFFSET)]
    source = _gated_by(graph, node, _hard_sigmoid_of)
    product = graph.sole_writer(clipped)
    if product is not None:
        source = _gated_by(graph, product, _shifted_and_clipped)
    return None if source is None else [node.replaced_by("HardSwish", [source])]


def join_sigmoid(graph: OnnxGraph, node: Node) -> list[Node] | None:
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
    is_half = (affine.scale == 0.5).all() and (affine.shift == 0.5).all()
    if tanh is None or tanh.op_type != "Tanh" or not is_half:
        return None
    doubled = f"{result}.doubled"
    two = graph.add_constant(f"{result}.two", np.array(2.0))
    return [
        Node.new("Mul", [tanh.source, two], doubled),
        node.replaced_by("Sigmoid", [doubled]),
    ]


def halve_before_gelu(graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Move the factor 1/2 of a GELU in front of its product (point 4 of the module).

    Args:
        graph: the graph that the node belongs to.
        node: any node; only the last multiplication is replaced.

    Returns:
        x / 2, and the product that completes the GELU; None if the node stays.
    """
    for inner, outer in (node.inputs, node.inputs[::-1]) if node.op_type == "Mul" else ():
        product = graph.sole_writer(inner)
        if product is None or product.op_type != "Mul":
            continue
        # Either the half is multiplied last, or the tensor itself.
        for gate, other in (product.inputs, product.inputs[::-1]):
            source = gelu_gate_input(graph, gate)
            halves = {name for name in (other, outer) if _is_number(graph, name, 0.5)}
            if source and halves and {other, outer} == {source, *halves}:
                halved = f"{inner}.half"
                return [
                    Node.new("Mul", [source, *halves], halved),
                    node.replaced_by("Mul", [halved, gate]),
                ]
    return None


def gelu_gate_input(graph: OnnxGraph, name: str) -> str | None:
    """Return the name of x if a tensor is the factor of x in a GELU, without its half: 1 + Erf(x /
    sqrt(2)), or 1 + Tanh(sqrt(2 / pi) (x + 0.044715 x^3)); else None.

    Args:
        graph: the graph that the tensor belongs to.
        name: the name of the tensor.
    """
    function = graph.writers.get(other_operand(graph, graph.writers.get(name), "Add", 1) or "")
    if function is None or function.op_type not in ("Erf", "Tanh"):
        return None
    scaled = graph.writers.get(function.source)
    if function.op_type == "Tanh":
        return _cubic_input(graph, scaled)
    # Exporters divide by sqrt(2), or multiply by its reciprocal.
    by_factor = other_operand(graph, scaled, "Mul", sqrt(0.5))
    return by_factor or other_operand(graph, scaled, "Div", sqrt(2))


def _cubic_input(graph: OnnxGraph, node: Node | None) -> str | None:
    """Return x if a node computes sqrt(2 / pi) (x + 0.044715 x^3)."""
    total = graph.writers.get(other_operand(graph, node, "Mul", sqrt(2 / pi)) or "")
    if total is None or total.op_type != "Add":
        return None
    for source, scaled in (total.inputs, total.inputs[::-1]):
        cube = graph.writers.get(
            other_operand(graph, graph.writers.get(scaled), "Mul", 0.044715) or ""
        )
        if cube is not None and _gated_by(graph, cube, _squared) == source:
            return source
    return None


def _gated_by(
    graph: OnnxGraph, node: Node, gated: Callable[[OnnxGraph, str], str | None]
) -> str | None:
    """Return x if a node computes x times a function of x."""
    if node.op_type != "Mul":
        return None
    pairs = node.inputs, node.inputs[::-1]
    return next((source for source, gate in pairs if source == gated(graph, gate)), None)


def _squared(graph: OnnxGraph, name: str) -> str | None:
    """Return x if a tensor is x times x."""
    node = graph.writers.get(name)
    is_square = node is not None and node.op_type == "Mul" and len(set(node.inputs)) == 1
    return node.source if node is not None and is_square else None


def _hard_sigmoid_of(graph: OnnxGraph, name: str) -> str | None:
    """Return x if a tensor is HardSigmoid(x) of slope 1/6."""
    node = graph.writers.get(name)
    if node is None or node.op_type != "HardSigmoid":
        return None
    slope_and_offset = node.attributes.get("alpha", 0.2), node.attributes.get("beta", 0.5)
    is_of_hard_swish = np.allclose(slope_and_offset, (1 / 6, 0.5), atol=1e-6)
    return node.source if is_of_hard_swish else None


def _shifted_and_clipped(graph: OnnxGraph, name: str) -> str | None:
    """Return x if a tensor is x + 3, clipped from 0 to 6."""
    clip = graph.writers.get(name)
    if clip is None or clip.op_type != "Clip":
        return None
    shift = graph.writers.get(clip.source)
    if (_scalar(graph, clip, 1), _scalar(graph, clip, 2)) != (0, 6) or shift is None:
        return None
    return other_operand(graph, shift, "Add", 3)


def other_operand(graph: OnnxGraph, node: Node | None, kind: str, number: float) -> str | None:
    """Return the name of the tensor that a node combines with a given constant number; None if it
    does not.

    Args:
        graph: the graph that the node belongs to.
        node: any node; None returns None.
        kind: the operator that the node must have, with two operands. The constant may be either of
            them, but for Div it must be the divisor.
        number: the constant, which is compared up to the rounding of float32.
    """
    if node is not None and node.op_type == kind and len(node.inputs) == 2:
        for place in (0, 1)[: 1 if kind == "Div" else 2]:
            if _is_number(graph, node.inputs[1 - place], number):
                return node.inputs[place]
    return None


def _is_number(graph: OnnxGraph, name: str, number: float) -> bool:
    """Return True if a tensor is a constant of this one number, up to the rounding of float32."""
    value = graph.constants.get(name)
    if value is None or value.size != 1 or value.dtype.kind != "f":
        return False
    return bool(np.isclose(value.item(), number, rtol=1e-6, atol=0))


def _scalar(graph: OnnxGraph, node: Node, place: int) -> float | None:
    """Return a constant float of one number that a node reads; None if it reads none there."""
    value = graph.value(node, place)
    is_number = value is not None and value.size == 1 and value.dtype.kind == "f"
    return float(value.item()) if is_number and value is not None else None
