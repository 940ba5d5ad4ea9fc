"""Move activations in front of operations that only move values, into the convolution before.

A DPU computes an activation in one pass with a convolution, and not behind a pixel shuffle, a
concat, a pooling or an enlargement.

1. An activation is computed for each value alone, so that it may as well precede a pixel shuffle, a
   concat or an enlargement that repeats pixels.
2. A rising activation may also precede a maximum.
3. It is moved only where it reaches convolutions that nothing else reads, and through several such
   operations one after the other.

All of it is exact.
"""

from copy import deepcopy

import onnx

from beers_deploy.quant.onnx.graph import Node, OnnxGraph

RISING = {"Clip", "LeakyRelu", "Relu"}
ACTIVATIONS = RISING | {"HardSwish"}
CONVOLUTIONS = {"Conv", "ConvTranspose"}


def activations_first(model: onnx.ModelProto) -> onnx.ModelProto:
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
    # Each time an activation passes one operation, which is then not needed in its old place.
    while _any_moves(graph):
        graph.rewrite(move_in_front)
        graph.save()
    return network


def _any_moves(graph: OnnxGraph) -> bool:
    return any(move_in_front(graph, node) is not None for node in graph.nodes)


def move_in_front(graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Let an activation precede the operation that it reads.

    Args:
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        The activations of what the operation reads, and the operation. None if the node is no
        activation, or does not lead through such operations to convolutions.
    """
    moving = graph.sole_writer(node.inputs[0]) if node.op_type in ACTIVATIONS else None
    if moving is None or not _leads_to_convolutions(graph, node, moving):
        return None
    activations = [
        Node.new(
            node.op_type,
            (source, *node.inputs[1:]),
            f"{node.outputs[0]}.{place}",
            f"{node.name}.{place}" if place else node.name,
            **node.attributes,
        )
        for place, source in enumerate(_values(moving))
    ]
    results = [activation.outputs[0] for activation in activations]
    others = moving.inputs[len(results) :]
    moved = Node.new(
        moving.op_type, (*results, *others), node.outputs[0], moving.name, **moving.attributes
    )
    return [*activations, moved]


def _values(moving: Node) -> tuple[str, ...]:
    """Return the tensors whose values an operation moves; its other inputs state how."""
    return moving.inputs if moving.op_type == "Concat" else moving.inputs[:1]


def _leads_to_convolutions(graph: OnnxGraph, activation: Node, writer: Node) -> bool:
    """Return True if all that an operation moves comes from convolutions that only it reads."""
    kind = writer.op_type
    repeats = kind == "Resize" and writer.attributes.get("mode", "nearest") == "nearest"
    rises = activation.op_type in RISING and activation.attributes.get("alpha", 0) >= 0
    is_maximum = kind == "MaxPool" and rises and len(writer.outputs) == 1
    if not (kind in ("Concat", "DepthToSpace") or repeats or is_maximum):
        return False
    writers = [graph.sole_writer(source) for source in _values(writer)]
    return all(
        each is not None
        and (each.op_type in CONVOLUTIONS or _leads_to_convolutions(graph, activation, each))
        for each in writers
    )
