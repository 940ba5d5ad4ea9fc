"""Find the operators of a float network that a DPU lacks and that can be replaced.

Operators with the same replacement are one kind. `quant.adapt.replacements` lists them by numbers.
"""

from enum import StrEnum

import numpy as np

from beers_deploy.quant.graph.attention import shrinking
from beers_deploy.quant.graph.host_end import host_end
from beers_deploy.quant.graph.mirror import image_mirror, pads_of
from beers_deploy.quant.graph.normalization import Normalization, lone_deviation
from beers_deploy.quant.graph.operations import LEAKY_SLOPE
from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.onnx.resize import Resizing, alone_enlarges_image
from beers_deploy.quant.simplify.fold_affine import per_channel
from beers_deploy.quant.simplify.spelled_activations import (
    gelu_gate_input,
    has_slope_of_dpu,
    other_operand,
    slope_and_offset,
)


class Kind(StrEnum):
    """A kind of operator that a DPU lacks and that can be replaced. Its value is the name in
    tables.
    """

    silu = "SiLU, GELU or Mish"
    sigmoid = "Sigmoid"
    tanh = "Tanh"
    hard_sigmoid = "HardSigmoid of another slope"
    leaky_relu = "LeakyReLU of another slope"
    prelu = "PReLU"
    attention = "spatial attention (ESA)"
    padding = "reflecting padding"
    bilinear = "other bilinear enlargement"
    cubic = "bicubic enlargement"
    deviation = "standard deviation over the image"
    normalization = "normalization of pixels or channels"


APPROXIMATIONS = {
    Kind.silu: "HardSwish",
    Kind.sigmoid: "HardSigmoid",
    Kind.tanh: "a clipped line",
    Kind.leaky_relu: "LeakyReLU of 26/256",
    Kind.prelu: "LeakyReLU of 26/256",
    Kind.attention: "attention on an eighth of the sides",
    Kind.padding: "zeros around the mirrored image",
    Kind.bilinear: "bilinear by 4 and 2 with half-pixel centres",
    Kind.cubic: "a transposed convolution of the mirrored image",
    Kind.deviation: "the mean absolute deviation",
    Kind.normalization: "lines through the inverse of a sum of absolute differences",
}
"""The other function that replaces each kind (1 to 9)."""
EXACT = {
    Kind.hard_sigmoid: "HardSigmoid of a scaled input",
    Kind.leaky_relu: "ReLU in a second branch, and an Add",
    Kind.prelu: "ReLU in a second branch, and an Add",
}
"""The exact replacement of each kind (10 and 11)."""


def kind_of(graph: OnnxGraph, node: Node) -> Kind | None:
    """Return the kind of replaceable operator that a node is, if a DPU lacks it.

    Args:
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        The kind; None if the node is not replaced, such as a Sigmoid that is a part of a SiLU.
    """
    resizing = Resizing.of(graph, node) if node.op_type == "Resize" else None
    kinds = {
        Kind.attention: shrinking(graph, node),
        Kind.silu: silu_input(graph, node),
        Kind.padding: pads_of(graph, node),
        Kind.deviation: lone_deviation(graph, node),
        Kind.normalization: Normalization.of(graph, node),
        Kind.bilinear: resizing is not None and resizing.is_nearly_bilinear,
        Kind.cubic: alone_enlarges_image(graph, node),
    }
    for kind, is_of_kind in kinds.items():
        if is_of_kind:
            return kind
    if node.op_type in ("Sigmoid", "Tanh"):
        readers = graph.readers[node.result]
        if len(readers) == 1 and gelu_gate_input(graph, readers[0].result):
            readers = graph.readers[readers[0].result]
        part_of_silu = readers and all(silu_input(graph, reader) for reader in readers)
        return None if part_of_silu else Kind[node.op_type.lower()]
    if node.op_type == "HardSigmoid":
        slope, _ = slope_and_offset(node)
        return None if has_slope_of_dpu(node) or not slope else Kind.hard_sigmoid
    slopes = slopes_of(graph, node)
    if slopes is None:
        return None
    if node.op_type == "PRelu":
        return Kind.prelu
    return None if slopes[0] == np.float32(LEAKY_SLOPE) else Kind.leaky_relu


def silu_input(graph: OnnxGraph, node: Node) -> str:
    """Return the tensor x if a node completes an activation that HardSwish approximates.

    That is a GELU, by Erf or Tanh, or Mish of x, or x * Sigmoid(c x) with a constant c: 1 for SiLU,
    1.702 for the quick GELU.

    Args:
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        The name of x; "" if the node computes something else.
    """
    if node.op_type in ("Gelu", "Mish"):
        return node.source
    if node.op_type == "Mul":
        for source, gate in node.orders:
            gelu = gelu_gate_input(graph, gate)
            if gelu and other_operand(graph, source, "Mul", 0.5) == gelu:
                return gelu
            if _is_gate(graph, graph.writer(gate), source):
                return source
    return ""


def _is_gate(graph: OnnxGraph, node: Node, source: str) -> bool:
    """Return True if a node is Sigmoid(c x) or Tanh(Softplus(x)) of a tensor x."""
    before = graph.writer(node.source)
    if node.op_type == "Tanh":
        return before.op_type == "Softplus" and before.source == source
    if node.op_type != "Sigmoid":
        return False
    if node.source == source:
        return True
    if before.op_type != "Mul" or source not in before.inputs:
        return False
    factor = before.inputs[1 - before.inputs.index(source)]
    cast = graph.writer(factor)
    # The runtime leaves a Cast of the constant of a Swish.
    value = graph.constants.get(cast.source if cast.op_type == "Cast" else factor)
    return value is not None and value.size == 1


def slopes_of(graph: OnnxGraph, node: Node) -> np.ndarray | None:
    """Return the slopes that a LeakyReLU or PReLU has for values below 0.

    Args:
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        (C,), or (1,) for all channels. None for another node, or if the slopes are not one constant
        per channel.
    """
    if node.op_type == "LeakyRelu":
        return np.array([node.attribute("alpha", 0.01)], np.float32)
    return per_channel(graph.value(node, 1)) if node.op_type == "PRelu" else None


def nodes_by_kind(graph: OnnxGraph) -> dict[Kind, list[Node]]:
    """Return the nodes of a network that can be replaced, in lists by their kind, in the graph's
    order.

    The sizes of the graph's tensors are inferred and stored in it, too.
    """
    nodes: dict[Kind, list[Node]] = {}
    graph.infer_shapes()
    on_host = host_end(graph).replaced
    for node in graph.nodes:
        kind = kind_of(graph, node)
        if kind is not None and node.result not in on_host:
            nodes.setdefault(kind, []).append(node)
    if image_mirror(graph) is not None:
        # The only Pad, which the host does.
        nodes.pop(Kind.padding, None)
    return nodes
