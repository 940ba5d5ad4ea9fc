"""Let activations and pixel shuffles follow convolutions.

A DPU computes an activation in one pass with a convolution, and not behind a pixel shuffle, a
concat, a pooling or an enlargement. It shuffles the results of convolutions alone.

1. An activation is computed for each value alone, so that it can also precede a pixel shuffle, a
   concat or an enlargement that repeats pixels.
2. A rising activation may also precede a maximum.
3. It is moved only where it reaches convolutions that nothing else reads, and through several such
   operations one after the other.
4. Anywhere else a convolution of one pixel that changes nothing is put in front. It takes in the
   arithmetic with constants that it reads.

All of it is exact.
"""

from copy import deepcopy
from dataclasses import replace

import numpy as np
from onnx import ModelProto

from beers_deploy.quant.onnx.graph import NO_NODE, Node, OnnxGraph, Replacement
from beers_deploy.quant.simplify.fold_affine import fold_in_front

RISING = {"Clip", "LeakyRelu", "Relu"}
ACTIVATIONS = RISING | {"HardSwish"}
CONVOLUTIONS = {"Conv", "ConvTranspose"}
MAY_FOLLOW = {
    "Clip": CONVOLUTIONS,
    "DepthToSpace": CONVOLUTIONS | ACTIVATIONS,
    "HardSwish": CONVOLUTIONS,
    "Relu": CONVOLUTIONS | {"Add"},
}
"""The operators behind which a DPU computes each of these."""
HOST = {"Add", "Clip", "DepthToSpace"}
"""Operators that may follow a pixel shuffle that the host computes."""


def activations_first(model: ModelProto) -> ModelProto:
    """Move the activations of a float network in front of operations that only move values.

    Args:
        model: the network.

    Returns:
        A network of the same function; `model` itself if nothing can be moved.
    """
    if not _any_moves(OnnxGraph(model)):
        return model
    network = deepcopy(model)
    graph = OnnxGraph(network)
    # In each round an activation passes one operation, and is removed from its old place.
    while _any_moves(graph):
        graph.rewrite(move_in_front)
        graph.save()
    return network


def behind_convolutions(model: ModelProto) -> ModelProto:
    """Put convolutions that change nothing in front of activations and pixel shuffles that follow
    no convolution (point 4 of the module).

    Args:
        model: the network.

    Returns:
        A network of the same function; `model` itself if nothing is missing.
    """
    network = deepcopy(model)
    graph = OnnxGraph(network)
    if not any(_lacks_convolution(graph, node) for node in graph.nodes):
        return model
    graph.infer_shapes()

    def with_copy(graph: OnnxGraph, node: Node) -> Replacement:
        source = node.source
        channels = graph.channels(source)
        if not channels or not _lacks_convolution(graph, node):
            return None
        copy = f"{node.result}.copy"
        ones = np.ones((channels, 1, 1, 1))
        inputs = [copy, *node.inputs[1:]]
        return [
            graph.convolution(source, copy, copy, ones, group=channels),
            node.replaced_by(node.op_type, inputs, **node.attributes),
        ]

    graph.rewrite(with_copy)
    fold_in_front(graph)
    graph.save()
    return network


def _lacks_convolution(graph: OnnxGraph, node: Node) -> bool:
    """Return True for an activation or an inner pixel shuffle that no convolution precedes."""
    before = graph.writer(node.source)
    if node.op_type not in MAY_FOLLOW or before is NO_NODE or node.result in graph.outputs:
        return False
    readers = {reader.op_type for reader in graph.readers[node.result]}
    if node.op_type == "DepthToSpace" and readers <= HOST:
        return False
    # The sum with a constant becomes part of the convolution.
    adds_constant = before.op_type == "Add" and not graph.constants.keys().isdisjoint(before.inputs)
    return before.op_type not in MAY_FOLLOW[node.op_type] or adds_constant


def _any_moves(graph: OnnxGraph) -> bool:
    return any(move_in_front(graph, node) is not None for node in graph.nodes)


def move_in_front(graph: OnnxGraph, node: Node) -> Replacement:
    """Let an activation precede the operation that it reads.

    Args:
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        An activation of each tensor that the operation reads, and the operation. None if the node
        is no activation, or its input does not come from convolutions through such operations.
    """
    # The host clips the result.
    is_end = node.op_type == "Clip" and node.result in graph.outputs
    moving = graph.sole_writer(node.source)
    if node.op_type not in ACTIVATIONS or is_end or not _leads_to_convolutions(graph, node, moving):
        return None
    activations = [
        Node.new(
            node.op_type,
            (source, *node.inputs[1:]),
            f"{node.result}.{place}",
            f"{node.name}.{place}" if place else node.name,
            **node.attributes,
        )
        for place, source in enumerate(_values(moving))
    ]
    results = [activation.result for activation in activations]
    others = moving.inputs[len(results) :]
    return [*activations, replace(moving, inputs=(*results, *others), outputs=node.outputs)]


def _values(moving: Node) -> tuple[str, ...]:
    """Return the tensors whose values an operation moves; its other inputs state how."""
    return moving.inputs if moving.op_type == "Concat" else moving.inputs[:1]


def _leads_to_convolutions(graph: OnnxGraph, activation: Node, writer: Node) -> bool:
    """Return True if all that an operation moves comes from convolutions that only it reads."""
    kind = writer.op_type
    repeats = kind == "Resize" and writer.attribute("mode", "nearest") == "nearest"
    rises = activation.op_type in RISING and activation.attribute("alpha", 0) >= 0
    is_maximum = kind == "MaxPool" and rises and len(writer.outputs) == 1
    if not (kind in ("Concat", "DepthToSpace") or repeats or is_maximum):
        return False
    return all(
        each.op_type in CONVOLUTIONS or _leads_to_convolutions(graph, activation, each)
        for each in map(graph.sole_writer, _values(writer))
    )
