"""Convert networks, and parts of them, that have channels last (N, H, W, C) to channels first.

Exporters from TensorFlow transpose the image in front of the first convolution, and the result at
the end. Linear layers of torch stand between two such nodes.

1. A Transpose to channels last is moved behind operations on each value, concats, padding, means,
   and products with a matrix, which become convolutions of one pixel. A LayerNormalization over the
   channels is spelled out for that. A Transpose to channels first then undoes it.
2. If the image has its channels last, it is treated as one of channels first that is transposed
   before anything else. The result is treated likewise.
"""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numpy as np
from onnx import ModelProto

from beers_deploy.quant.onnx.graph import Node, OnnxGraph

TO_FIRST = [0, 3, 1, 2]
TO_LAST = [0, 2, 3, 1]
AXES_ARE_INPUT = 18
"""The opset from which on operators read axes as an input."""
ON_VALUES = {
    *("Abs", "Add", "Cast", "Clip", "Div", "Dropout", "Elu", "Erf", "Exp", "Gelu", "HardSigmoid"),
    *("HardSwish", "Identity", "LeakyRelu", "Log", "Max", "Min", "Mul", "Neg", "PRelu", "Pow"),
    *("Relu", "Sigmoid", "Softplus", "Sqrt", "Sub", "Sum", "Tanh"),
}
"""Operators on each value, which no order of axes changes."""


def channels_first(model: ModelProto) -> None:
    """Convert the parts of a network that have their channels last to channels first.

    Args:
        model: a float network, which is changed in place.
    """
    if not any(_is_transpose(node, TO_FIRST) for node in OnnxGraph(model).nodes):
        return
    network = deepcopy(model)
    graph = OnnxGraph(network)
    for name in graph.inputs:
        first = Node.new("Transpose", [name], f"{name}.last", perm=TO_LAST)
        for node in graph.readers[name]:
            node.inputs = tuple(first.result if each == name else each for each in node.inputs)
        graph.set_nodes([first, *graph.nodes])
    graph.rewrite(_moved_behind)
    graph.save()
    ends = [node for node in graph.nodes if _is_transpose(node, TO_LAST)]
    if any(node.result not in graph.outputs for node in ends):
        # The image has its channels first.
        graph = OnnxGraph(model)
        graph.rewrite(_moved_behind)
        graph.save()
        return
    results = [node.result for node in ends]

    graph.rewrite(
        lambda _, node: (
            [node.replaced_by("Identity", node.inputs)] if node.result in results else None
        )
    )
    graph.save()
    for value in (*network.graph.input, *network.graph.output):
        dims = value.type.tensor_type.shape.dim
        if len(dims) == 4 and (value.name in graph.inputs or value.name in results):
            channels = dims.pop()
            dims.insert(1, channels)
    network.graph.ClearField("value_info")
    model.CopyFrom(network)


def _moved_behind(graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Move the Transposes to channels last in front of a node behind it (1)."""
    names = [name for name in node.inputs if name and name not in graph.constants]
    writers = [graph.writers.get(name) for name in names]
    sources = {
        writer.result: writer.source
        for writer in writers
        if writer is not None and _is_transpose(writer, TO_LAST)
    }
    if not names or sources.keys() != {*names} or len(node.outputs) > 1:
        return None
    (result,) = node.outputs
    if _is_transpose(node, TO_FIRST):
        return [node.replaced_by("Identity", [*sources.values()])]
    first = f"{result}.first"
    if node.op_type == "LayerNormalization":
        moved = _layer_normalization(graph, node, sources[node.source], first)
    else:
        on_first = _on_first(graph, node, sources, first)
        moved = [] if on_first is None else [on_first]
    if not moved:
        return None
    return [*moved, Node.new("Transpose", [first], result, f"{result}.last", perm=TO_LAST)]


def _on_first(graph: OnnxGraph, node: Node, sources: Mapping[str, str], first: str) -> Node | None:
    """Return the same operation on maps that have their channels first; None for one that needs
    them last.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: the operation on maps of channels last.
        sources: the map of channels first by the name of the map of channels last.
        first: the name of the result.
    """
    kind = node.op_type
    attributes = dict(node.attributes)
    source = sources.get(node.source, "")
    number = graph.value(node, 1)
    if kind == "MatMul" and number is not None and number.ndim == 2:
        return graph.convolution(source, first, node.name, number.T[:, :, None, None])
    if kind == "Pad" and number is not None:
        stated = graph.value(node, 3)
        # Without axes a Pad states all four; with them some, in any order.
        places = [TO_LAST[axis % 4] for axis in (range(4) if stated is None else stated.tolist())]
        pads = np.zeros((2, 4), number.dtype)
        pads[:, places] = number.reshape(2, -1)
        name = graph.add_constant(f"{first}.pads", pads.ravel(), number.dtype)
        return Node.new(kind, [source, name, *node.inputs[2:3]], first, node.name, **attributes)
    if kind == "ReduceMean" and attributes.get("keepdims", 1):
        axes = graph.numbers(node, 1, "axes")
        moved_axes = [TO_LAST[axis % 4] for axis in axes or ()]
        inputs = [source]
        if number is None:
            attributes["axes"] = moved_axes
        else:
            inputs.append(graph.add_constant(f"{first}.axes", np.array(moved_axes), np.int64))
        return Node.new(kind, inputs, first, node.name, **attributes) if axes else None
    if kind not in ON_VALUES and kind != "Concat":
        return None
    if kind == "Concat":
        attributes["axis"] = TO_LAST[attributes["axis"] % 4]
    inputs = [sources.get(name) or _of_first(graph, name) for name in node.inputs]
    return Node.new(kind, inputs, first, node.name, **attributes)


def _layer_normalization(graph: OnnxGraph, node: Node, source: str, first: str) -> list[Node]:
    """Return the operators of a normalisation over the channels of a map that has these first; none
    if it is one over other axes.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: a LayerNormalization of the map with its channels last.
        source: the name of the map with its channels first.
        first: the name of the result.
    """
    if node.attributes.get("axis", -1) not in (-1, 3):
        return []
    scale_name, shift_name = (*node.inputs[1:], "")[:2]
    scale = _of_first(graph, scale_name)
    shift = _of_first(graph, shift_name or graph.add_constant(f"{first}.shift", np.zeros(1)))
    names = ("mean", "difference", "square", "variance", "sum", "root", "quotient", "product")
    mean, difference, square, variance, total, root, quotient, product = (
        f"{first}.{name}" for name in names
    )
    axes = []
    attributes: dict[str, Any] = {"axes": [1]}
    if graph.opset >= AXES_ARE_INPUT:
        axes.append(graph.add_constant(f"{first}.axes", np.array([1]), np.int64))
        attributes = {}
    epsilon = np.array(node.attributes.get("epsilon", 1e-5))
    return [
        Node.new("ReduceMean", [source, *axes], mean, **attributes),
        Node.new("Sub", [source, mean], difference),
        Node.new("Mul", [difference, difference], square),
        Node.new("ReduceMean", [square, *axes], variance, **attributes),
        Node.new("Add", [variance, graph.add_constant(f"{first}.epsilon", epsilon)], total),
        Node.new("Sqrt", [total], root),
        Node.new("Div", [difference, root], quotient),
        Node.new("Mul", [quotient, scale], product),
        Node.new("Add", [product, shift], first, node.name),
    ]


def _of_first(graph: OnnxGraph, name: str) -> str:
    """Return the name of a constant of channels last with its channels first; an omitted one."""
    value = graph.constants.get(name)
    if value is None or value.size == 1:
        return name
    value = value.reshape((1,) * (4 - value.ndim) + value.shape).transpose(TO_FIRST)
    return graph.add_constant(f"{name}.first", value, value.dtype)


def _is_transpose(node: Node, order: list[int]) -> bool:
    """Return True if a node transposes in this order."""
    return node.op_type == "Transpose" and list(node.attributes.get("perm", [])) == order
