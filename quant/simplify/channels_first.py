"""Convert networks, and parts of them, that have channels last (N, H, W, C) to channels first.

Exporters from TensorFlow transpose the image in front of the first convolution, and the result at
the end. Linear layers of torch stand between two such nodes.

1. A Transpose to channels last is moved behind operations on each value, concats, splits, padding,
   means, and products with a matrix, which become convolutions of one pixel. A LayerNormalization
   over the channels is spelled out for that. A Transpose to channels first then undoes it.
2. If the image has its channels last, it is treated as one of channels first that is transposed
   before anything else. The result is treated likewise.
3. A map that is flattened to (N H W, C) for a product with a matrix is multiplied itself.
"""

from collections.abc import Mapping
from itertools import chain
from typing import Any

import numpy as np
from onnx import ModelProto

from beers_deploy.quant.onnx.elementwise import ELEMENTWISE
from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement

TO_FIRST = [0, 3, 1, 2]
TO_LAST = [0, 2, 3, 1]
AXES_ARE_INPUT = 18
"""The opset from which on operators read axes as an input."""
REDUCING = {"ReduceMax", "ReduceMean", "ReduceSum"}
ON_ANY_AXIS = ELEMENTWISE | REDUCING | {"Concat", "MatMul", "Pad", "Reshape", "Slice", "Split"}
"""Operators that do not show which axis has the channels."""


def channels_first(model: ModelProto) -> None:
    """Convert the parts of a network that have their channels last to channels first.

    Args:
        model: a float network, which is changed in place.
    """
    graph = OnnxGraph(model)
    if not any(
        _is_transpose(node, TO_FIRST) or _is_transpose(node, TO_LAST) for node in graph.nodes
    ):
        return
    images = _images_of_channels_last(graph)
    for name in sorted(images):
        for node in graph.readers[name]:
            node.read_instead(name, f"{name}.last")
        first = Node.new("Transpose", [name], f"{name}.last", perm=TO_LAST)
        graph.set_nodes([first, *graph.nodes])
    graph.rewrite(moved_behind)
    results = {name for name in graph.outputs if _is_last(graph, name, bool(images))}
    for name in sorted(results):
        for node in graph.readers[name]:
            node.read_instead(name, f"{name}.last")
        graph.rename(name, f"{name}.last")
        first = Node.new("Transpose", [f"{name}.last"], name, f"{name}.first", perm=TO_FIRST)
        graph.set_nodes([*graph.nodes, first])
    graph.rewrite(moved_behind)
    graph.save()
    for value in (*model.graph.input, *model.graph.output):
        dims = value.type.tensor_type.shape.dim
        if len(dims) == 4 and value.name in images | results:
            channels = dims.pop()
            dims.insert(1, channels)
            model.graph.ClearField("value_info")


def _is_last(graph: OnnxGraph, name: str, has_images: bool) -> bool:
    """Return True if a result has its channels last: it is transposed so, or reshaped in a network
    with images of channels last, such as by a pixel shuffle.
    """
    source = name
    while (writer := graph.writer(source)).op_type in ELEMENTWISE:
        source = writer.source
    if writer.op_type != "Reshape":
        return _is_transpose(writer, TO_LAST)
    return has_images and len(graph.result_sizes[name]) == 4


def _images_of_channels_last(graph: OnnxGraph) -> set[str]:
    """Return the inputs that are transposed to channels first before any operator of maps."""
    origins = {name: {name} for name in graph.inputs}
    images: set[str] = set()
    for node in graph.nodes:
        reached = set[str]().union(*(origins.get(name, ()) for name in node.inputs))
        if _is_transpose(node, TO_FIRST):
            images |= reached
        elif node.op_type in ON_ANY_AXIS:
            origins.update(dict.fromkeys(node.outputs, reached))
    return images


def moved_behind(graph: OnnxGraph, node: Node) -> Replacement:
    """Move the Transposes to channels last in front of a node behind it (1).

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The operation on maps of channels first, and a Transpose of each result; None if the node
        stays.
    """
    names = {name for name in node.inputs if name and name not in graph.constants}
    transposes = [w for w in map(graph.writer, node.inputs) if _is_transpose(w, TO_LAST)]
    sources = {transpose.result: transpose.source for transpose in transposes}
    if pixel := _of_one_pixel(graph, node):
        return _transposed(node, pixel)
    is_single = len(node.outputs) == 1 or node.op_type == "Split"
    if not names or sources.keys() != names or not is_single:
        return None
    if _is_transpose(node, TO_FIRST):
        return [node.replaced_by("Identity", [*sources.values()])]
    first = f"{node.result}.first"
    if node.op_type == "LayerNormalization":
        return _transposed(node, _layer_normalization(graph, node, sources[node.source], first))
    on_first = _on_first(graph, node, sources, first)
    return None if on_first is None else _transposed(node, [on_first])


def _transposed(node: Node, moved: list[Node]) -> Replacement:
    """Return nodes that compute the results of a node with channels first, and their Transposes;
    None if there are no such nodes.
    """
    if not moved:
        return None
    moved[-1].outputs = tuple(f"{name}.first" for name in node.outputs)
    firsts = zip(node.outputs, moved[-1].outputs, strict=True)
    return [
        *moved,
        *(
            Node.new("Transpose", [first], name, f"{name}.last", perm=TO_LAST)
            for name, first in firsts
        ),
    ]


def _of_one_pixel(graph: OnnxGraph, node: Node) -> list[Node]:
    """Return the Reshape to one pixel of channels first, whose values have the same order, for one
    of channels last that meets such maps; none for other nodes.
    """
    sizes = graph.numbers(node, 1, "") if node.op_type == "Reshape" else None
    others = chain.from_iterable(reader.inputs for reader in graph.readers[node.result])
    meets_last = any(_is_transpose(graph.writer(name), TO_LAST) for name in others)
    if (sizes or [])[1:-1] != [1, 1] or not meets_last:
        return []
    name = graph.add_constant(f"{node.result}.sizes", np.array(sizes)[TO_FIRST], np.int64)
    return [node.replaced_by("Reshape", [node.source, name], **node.attributes)]


def multiplied(graph: OnnxGraph, node: Node) -> Replacement:
    """Multiply a map of channels last by a matrix, in place of the same map flattened (3).

    Args:
        graph: the graph that the node belongs to, which knows its sizes.
        node: any node; the Reshape to a map is replaced.

    Returns:
        The product, and the sum with the bias of a Gemm; None if the node is something else.
    """
    product = graph.writer(node.source)
    flat = graph.writer(product.source)
    weight = graph.value(product, 1)
    is_flattened = node.op_type == flat.op_type == "Reshape"
    if not is_flattened or product.op_type not in ("Gemm", "MatMul") or weight is None:
        return None
    names = flat.source, product.source, node.result
    before, rows, after = (graph.shapes.get(name, ()) for name in names)
    is_map = len(before) == len(after) == 4 and before[:3] == after[:3] and len(rows) == 2
    factors = {product.attribute(key, 1) for key in ("alpha", "beta")}
    if not is_map or before[3] != rows[1] or factors != {1} or product.attribute("transA"):
        return None
    result = node.result
    weight = weight.T if product.attribute("transB") else weight
    matrix = graph.add_constant(f"{result}.matrix", weight)
    if len(product.inputs) == 2:
        return [node.replaced_by("MatMul", [flat.source, matrix])]
    return [
        Node.new("MatMul", [flat.source, matrix], f"{result}.product"),
        node.replaced_by("Add", [f"{result}.product", product.inputs[2]]),
    ]


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
    if kind in REDUCING and attributes.get("keepdims", 1):
        axes = graph.numbers(node, 1, "axes")
        moved_axes = [TO_LAST[axis % 4] for axis in axes or ()]
        inputs = [source]
        if number is None:
            attributes["axes"] = moved_axes
        else:
            inputs.append(graph.add_constant(f"{first}.axes", moved_axes, np.int64))
        return Node.new(kind, inputs, first, node.name, **attributes) if axes else None
    if kind in ("Concat", "Split"):
        attributes["axis"] = TO_LAST[attributes.get("axis", 0) % 4]
    elif kind not in ELEMENTWISE:
        return None
    if kind == "Split":
        return Node.new(kind, [source, *node.inputs[1:]], first, node.name, **attributes)
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
    if node.attribute("axis", -1) not in (-1, 3):
        return []
    scale_name, shift_name = (*node.inputs[1:], "")[:2]
    scale = _of_first(graph, scale_name)
    shift = _of_first(graph, shift_name or graph.add_constant(f"{first}.shift", np.zeros(1)))
    axes = []
    attributes: dict[str, Any] = {"axes": [1]}
    if graph.opset >= AXES_ARE_INPUT:
        axes.append(graph.add_constant(f"{first}.axes", [1], np.int64))
        attributes = {}
    epsilon = graph.add_constant(f"{first}.epsilon", node.attribute("epsilon", 1e-5))
    nodes: list[Node] = []

    def computed(op_type: str, inputs: list[str], role: str, **stated: Any) -> str:
        nodes.append(Node.new(op_type, inputs, f"{first}.{role}", **stated))
        return nodes[-1].result

    mean = computed("ReduceMean", [source, *axes], "mean", **attributes)
    difference = computed("Sub", [source, mean], "difference")
    square = computed("Mul", [difference, difference], "square")
    variance = computed("ReduceMean", [square, *axes], "variance", **attributes)
    root = computed("Sqrt", [computed("Add", [variance, epsilon], "sum")], "root")
    quotient = computed("Div", [difference, root], "quotient")
    product = computed("Mul", [quotient, scale], "product")
    return [*nodes, Node.new("Add", [product, shift], first, node.name)]


def _of_first(graph: OnnxGraph, name: str) -> str:
    """Return the name of a constant of channels last with its channels first; an omitted one."""
    value = graph.constants.get(name)
    if value is None or value.size == 1:
        return name
    value = value.reshape((1,) * (4 - value.ndim) + value.shape).transpose(TO_FIRST)
    return graph.add_constant(f"{name}.first", value, value.dtype)


def _is_transpose(node: Node, order: list[int]) -> bool:
    """Return True if a node transposes in this order."""
    return node.op_type == "Transpose" and node.attribute("perm") == order
