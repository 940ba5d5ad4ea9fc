"""Replace operators that a DPU lacks, in the simplified ONNX graph of a float network.

By another function:

1. Four functions become HardSwish: SiLU, x * Sigmoid(x); the quick GELU, x * Sigmoid(c x); the
   GELU, x * (1 + Erf(x / sqrt(2))) / 2 or its approximation by Tanh, which differs from the quick
   one by 0.02 at most if c = 1.702; and Mish, x * Tanh(Softplus(x)).
2. Any other Sigmoid becomes HardSigmoid. A Tanh becomes a line of slope `TANH_SLOPE` that is
   clipped at -1 and 1, computed as ReLU6 of a scaled and shifted input.
3. LeakyReLU of another slope, and PReLU, become LeakyReLU of 26/256.
4. Spatial attention that shrinks and enlarges by no whole factors is aligned with its map
   (`quant.graph.attention`).
5. Maps that are padded by reflection or by their edge are padded by zeros. The host mirrors the
   image beyond its borders and crops the result, so that the zeros lie outside of it.
6. Bilinear enlargement by a power of two becomes enlargements by 4 and 2 with half-pixel centres.
   Aligned corners are up to a quarter of a small pixel away.
7. Bicubic enlargement of the image becomes a transposed convolution with the same weights. Where
   the original repeats the border of the image, the host mirrors it.
8. The standard deviation over the image, in IMDN's attention, becomes the mean absolute deviation
   (`quant.graph.deviation`).
9. A normalisation of each pixel over its channels, or of each channel over the image, divides by
   lines through sums of absolute differences (`quant.graph.normalization`).

Exactly, but for the rounding of float32:

10. LeakyReLU and PReLU of slopes s become s x + ReLU((1 - s) x): two branches and an Add. If s is
    above 1, the branches compute the negative of that, and convolutions behind it are negated.
11. HardSigmoid of another slope and offset becomes that of 1/6 and 0.5 behind a scaled input.

ELU, SELU and Softplus are not replaced: lines that bend twice, by two ReLUs, lose 0.4 to 0.8 dB of
U-Nets even if the convolutions behind are fitted.
"""

from collections.abc import Collection, Mapping
from copy import deepcopy

import numpy as np
import onnx

from beers_deploy.quant.adapt.kinds import Kind, nodes_by_kind, silu_input, slopes_of
from beers_deploy.quant.adapt.zero_padding import pad_by_zeros
from beers_deploy.quant.graph.attention import aligned
from beers_deploy.quant.graph.base import REACH_PX, Base
from beers_deploy.quant.graph.host_end import host_end
from beers_deploy.quant.graph.normalization import (
    InverseDeviation,
    Normalization,
    lone_deviation,
)
from beers_deploy.quant.graph.operations import LEAKY_SLOPE
from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.onnx.resize import Resizing, enlarged_bilinearly
from beers_deploy.quant.simplify.activations_first import activations_first
from beers_deploy.quant.simplify.fold_affine import (
    fold_behind,
    fold_in_front,
    is_convolution,
)
from beers_deploy.quant.simplify.spelled_activations import SLOPE_AND_OFFSET, slope_and_offset

TANH_SLOPE = 0.8
"""The slope, of 0.6 to 1, with the least error for inputs whose standard deviation is 1 to 2."""


def replaced(
    model: onnx.ModelProto,
    approximated: Collection[Kind],
    exact: Collection[Kind],
    inverses: Mapping[str, InverseDeviation],
) -> onnx.ModelProto:
    """Return a copy of a network in which operators of some kinds are replaced by ones that a DPU
    computes.

    Tensors keep their names. New names occur only within an exact replacement, which has several
    nodes.

    Args:
        model: a simplified float network; not changed.
        approximated: the kinds that are replaced by another function, which is near the original.
        exact: the kinds that are replaced by several operators with the same result. A kind in both
            is approximated.
        inverses: the inverse deviation of each normalisation by the name of its result; a missing
            one gets placeholder numbers.
    """
    network = deepcopy(model)
    graph = OnnxGraph(network)
    # Before the graph changes, because a SiLU is known by the Sigmoid in front of it.
    plan: dict[Node, list[Node]] = {}
    for kind, nodes in nodes_by_kind(graph).items():
        if kind is Kind.attention and kind in approximated:
            for node in nodes:
                plan |= aligned(graph, node)
        elif kind in approximated and kind is not Kind.padding:
            plan |= {node: _approximation(graph, node, kind, inverses) for node in nodes}
        elif kind in exact and kind is Kind.hard_sigmoid:
            plan |= {node: _scaled_hard_sigmoid(graph, node) for node in nodes}
        elif kind in exact:
            plan |= {node: _two_branches(graph, node) for node in nodes}
    graph.rewrite(lambda _, node: plan.get(node))
    graph.rewrite(fold_behind)
    graph.save()
    graph.infer_shapes()
    fold_in_front(graph)
    graph.save()
    network = activations_first(network)
    if Kind.padding in approximated:
        pad_by_zeros(network)
    return network


def _approximation(
    graph: OnnxGraph, node: Node, kind: Kind, inverses: Mapping[str, InverseDeviation]
) -> list[Node]:
    """Return the nodes of another function that replaces an operator.

    Args:
        graph: the graph that the node belongs to.
        node: a node of that kind; of several that spell an operator, the last.
        kind: its kind.
        inverses: the inverse deviations of normalisations.
    """
    if kind is Kind.silu:
        return [node.replaced_by("HardSwish", [silu_input(graph, node)])]
    if kind is Kind.sigmoid:
        return [node.replaced_by("HardSigmoid", node.inputs, **SLOPE_AND_OFFSET)]
    if kind is Kind.tanh:
        return _clipped_line(graph, node)
    if kind is Kind.bilinear:
        factor = int(Resizing.of(graph, node).factors[2])
        return enlarged_bilinearly(graph, node.source, factor, node)
    if normalization := Normalization.of(graph, node):
        return normalization.nodes(graph, inverses.get(node.result))
    if deviation := lone_deviation(graph, node):
        return deviation.nodes(graph)
    if kind is Kind.cubic:
        return _cubic_convolution(graph, node)
    return [node.replaced_by("LeakyRelu", [node.source], alpha=LEAKY_SLOPE)]


def _clipped_line(graph: OnnxGraph, node: Node) -> list[Node]:
    """Return clip(slope x, -1, 1) in place of tanh(x), as ReLU6(3 slope x + 3) / 3 - 1."""
    output = node.result
    three, zero, six, minus_one = (
        graph.add_constant(f"{output}.{number}", number) for number in (3, 0, 6, -1)
    )
    scaled = _times(graph, node.source, np.array([3 * TANH_SLOPE]), f"{output}.scaled")
    shifted = Node.new("Add", [scaled.result, three], f"{output}.shifted")
    clipped = Node.new("Clip", [shifted.result, zero, six], f"{output}.clipped", node.name)
    shrunk = _times(graph, clipped.result, np.array([1 / 3]), f"{output}.shrunk")
    lowered = Node.new("Add", [shrunk.result, minus_one], output, f"{output}.lowered")
    return [scaled, shifted, clipped, shrunk, lowered]


def _cubic_convolution(graph: OnnxGraph, node: Node) -> list[Node]:
    """Return a transposed convolution of the mirrored image in place of a bicubic Resize.

    The Resize remains for a sum that the host computes.
    """
    image = node.source
    result = node.result
    convolved = f"{result}.convolved"
    on_host = host_end(graph).replaced
    for reader in graph.readers[result]:
        if reader.result not in on_host:
            reader.read_instead(result, convolved)
    factor = int(Resizing.of(graph, node).factors[2])
    base = Base(factor=factor, mode="cubic")
    weight = base.kernel(graph.channels(image))
    mirrored = f"{result}.mirrored"
    weight_name = graph.add_constant(f"{result}.weight", weight)
    convolution = Node.new(
        "ConvTranspose",
        [mirrored, weight_name],
        convolved,
        kernel_shape=list(weight.shape[2:]),
        strides=[factor] * 2,
        # The pads crop the results of the mirrored border.
        pads=[base.kernel_pad + REACH_PX * factor] * 4,
    )
    return [graph.mirrored(image, REACH_PX, mirrored), convolution, node]


def _scaled_hard_sigmoid(graph: OnnxGraph, node: Node) -> list[Node]:
    """Return clip(slope x + offset, 0, 1) as HardSigmoid of 6 slope x + 6 (offset - 0.5)."""
    slope, offset = slope_and_offset(node)
    output = node.result
    scaled = _times(graph, node.source, np.array([6 * slope]), f"{output}.scaled")
    # With z = 6 (slope x + offset - 0.5), clip(z / 6 + 0.5, 0, 1) is the original function.
    shift = graph.add_constant(f"{output}.offset", 6 * (offset - 0.5))
    shifted = Node.new("Add", [scaled.result, shift], f"{output}.shifted")
    hard = node.replaced_by("HardSigmoid", shifted.outputs, **SLOPE_AND_OFFSET)
    return [scaled, shifted, hard]


def _two_branches(graph: OnnxGraph, node: Node) -> list[Node]:
    """Return slopes x + ReLU((1 - slopes) x), negated where a slope above 1 bends the other way.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: a LeakyReLU or PReLU with constant slopes.
    """
    slopes = slopes_of(graph, node)
    assert slopes is not None  # noqa: S101 - `kind_of` has asked
    # ReLU adds nothing negative, so a slope s above 1 is computed as -(-s x + ReLU((s - 1) x)).
    signs = np.where(slopes > 1, -1, 1)
    source = node.source
    output = node.result
    nodes = []
    bent_source = source
    before = graph.sole_writer(source)
    # A convolution that only this node reads is computed twice, each time with the factors in its
    # weights, so that each branch is rounded once. For other tensors, each branch gets a depthwise
    # convolution.
    if is_convolution(graph, before):
        bent_source = f"{output}.source"
        name = f"{before.name}.bent"
        nodes.append(
            Node.new(before.op_type, before.inputs, bent_source, name, **before.attributes)
        )
    straight = _times(graph, source, signs * slopes, f"{output}.straight")
    scaled = _times(graph, bent_source, np.abs(1 - slopes), f"{output}.scaled")
    bent = Node.new("Relu", scaled.outputs, f"{output}.bent")
    names = [straight.result, bent.result]
    nodes += [straight, scaled, bent]
    if (signs > 0).all():
        return [*nodes, Node.new("Add", names, output, node.name)]
    negated = Node.new("Add", names, f"{output}.negated")
    return [*nodes, negated, _times(graph, negated.result, signs, output)]


def _times(graph: OnnxGraph, source: str, factors: np.ndarray, output: str) -> Node:
    """Return the product of a tensor and one number a channel.

    Args:
        graph: the graph whose constants are extended.
        source: name of the tensor (N, C, H, W).
        factors: (C,), or (1,) for all channels.
        output: name of the product and of its node.
    """
    shape = (1, -1, 1, 1) if factors.size > 1 else ()
    constant = graph.add_constant(f"{output}.factor", factors.reshape(shape))
    return Node.new("Mul", [source, constant], output)
