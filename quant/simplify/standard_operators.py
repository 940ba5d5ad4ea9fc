"""Replace operators that exporters write in several ways by the one operator that a DPU has."""

import numpy as np
from onnx import TensorProto

from beers_deploy.quant.onnx.graph import NO_NODE, Node, OnnxGraph, Replacement
from beers_deploy.quant.onnx.resize import PLACES, ROUNDINGS, Resizing


def split_sums(_: OnnxGraph, node: Node) -> Replacement:
    """Replace a Sum of several tensors by Adds of two, one after the other.

    Args:
        node: any node.

    Returns:
        The Adds; None if the node is no Sum of several tensors.
    """
    if node.op_type != "Sum" or len(node.inputs) < 2:
        return None
    *others, last = node.inputs[1:]
    subtotal = node.source
    adds = []
    for number, name in enumerate(others, 1):
        adds.append(Node.new("Add", [subtotal, name], f"{node.result}.{number}"))
        subtotal = adds[-1].result
    return [*adds, Node.new("Add", [subtotal, last], node.result, node.proto.name)]


def split_soft_threshold(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a soft threshold, as unfolded optimisers such as ISTA-Net have it, by two ReLUs:
    Sign(x) ReLU(Abs(x) - t) = ReLU(x - t) - ReLU(-x - t) for t >= 0.

    Args:
        graph: the graph that the node belongs to.
        node: any node; the product is replaced.

    Returns:
        The nodes that replace the product; None if it is something else.
    """
    before = {writer.op_type: writer for writer in map(graph.writer, node.inputs)}
    if node.op_type != "Mul" or before.keys() != {"Relu", "Sign"}:
        return None
    source = before["Sign"].source
    difference = graph.writer(before["Relu"].source)
    threshold = graph.value(difference, 1)
    size = graph.writer(difference.source)
    is_of_size = (difference.op_type, size.op_type, size.source) == ("Sub", "Abs", source)
    if not is_of_size or threshold is None or (threshold < 0).any():
        return None
    parts = [f"{node.result}.{part}" for part in ("negative", "above", "below", "more", "less")]
    negative, above, below, more, less = parts
    return [
        Node.new("Neg", [source], negative),
        Node.new("Sub", [source, difference.inputs[1]], above),
        Node.new("Sub", [negative, difference.inputs[1]], below),
        Node.new("Relu", [above], more),
        Node.new("Relu", [below], less),
        node.replaced_by("Sub", [more, less]),
    ]


def choose_by_relu(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace the larger or the smaller of two maps, and the size of a map, by sums with ReLU:
    max(a, b) = a + ReLU(b - a), min(a, b) = a - ReLU(a - b), and abs(a) = ReLU(a) + ReLU(-a).

    Args:
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        The nodes that replace the node; None if it is something else.
    """
    if node.op_type not in ("Abs", "Max", "Min"):
        return None
    result = node.result
    rest = f"{result}.difference"
    limited = f"{result}.relu"
    relu = Node.new("Relu", [rest], limited)
    a, *others = node.inputs
    if node.op_type == "Abs":
        positive = f"{result}.positive"
        return [
            Node.new("Neg", [a], rest),
            relu,
            Node.new("Relu", [a], positive),
            node.replaced_by("Add", [positive, limited]),
        ]
    if len(others) != 1 or not graph.constants.keys().isdisjoint(node.inputs):
        return None
    is_max = node.op_type == "Max"
    return [
        Node.new("Sub", [*others, a] if is_max else [a, *others], rest),
        relu,
        node.replaced_by("Add" if is_max else "Sub", [a, limited]),
    ]


def replace_powers(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace the square and the cube of a map by its products with itself, and a power of 0.5 by
    the root.

    Args:
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        The products or the root; None if the node is no such power.
    """
    exponent = graph.value(node, 1) if node.op_type == "Pow" else None
    power = exponent.item() if exponent is not None and exponent.size == 1 else None
    if power == 2:
        return [node.replaced_by("Mul", [node.source] * 2)]
    if power == 3:
        square = f"{node.result}.square"
        return [
            Node.new("Mul", [node.source] * 2, square),
            node.replaced_by("Mul", [square, node.source]),
        ]
    return [node.replaced_by("Sqrt", [node.source])] if power == 0.5 else None


def divide_by_reciprocal(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a product with a Reciprocal by a quotient, as torch writes rsqrt.

    Args:
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        The quotient; None if the node is something else.
    """
    for source, factor in node.orders if node.op_type == "Mul" else ():
        before = graph.writer(factor)
        if before.op_type == "Reciprocal":
            return [node.replaced_by("Div", [source, before.source])]
    return None


def drop_where(graph: OnnxGraph, node: Node) -> Replacement:
    """Remove a Where by a constant that chooses one of two maps everywhere, as torch writes a lerp.

    Args:
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        An empty list if the node is removed; None if it stays.
    """
    chooses = graph.value(node, 0) if node.op_type == "Where" else None
    if chooses is None or chooses.size != 1:
        return None
    source = node.inputs[1] if chooses.item() else node.inputs[2]
    result = node.result
    # A smaller map would have been repeated.
    is_of_size = source in graph.shapes and graph.shapes[source] == graph.shapes.get(result)
    if graph.sole_writer(source) is NO_NODE or not is_of_size:
        return None
    graph.rename(source, result)
    return []


def drop_cast_or_reshape(graph: OnnxGraph, node: Node) -> Replacement:
    """Remove a Cast to float32 of a tensor that is float32 already, and a Reshape to its own size.

    onnxruntime leaves such a Cast if it writes a result. torch writes such a Reshape around an
    InstanceNorm2d that tracks its statistics.

    Args:
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        An empty list if the node is removed; None if it stays.
    """
    size = graph.shapes.get(node.source)
    if size is None or graph.sole_writer(node.source) is NO_NODE:
        return None
    is_cast = node.op_type == "Cast" and node.attribute("to") == TensorProto.FLOAT
    # 0 copies a side, and the one that is -1 follows from the others.
    stated = graph.numbers(node, 1, "") or ()
    is_kept = [number in (0, -1, side) for number, side in zip(stated, size, strict=False)]
    keeps_sides = node.op_type == "Reshape" and len(stated) == len(size) and all(is_kept)
    if not (is_cast or keeps_sides):
        return None
    graph.rename(node.source, node.result)
    return []


def reduced_axes(graph: OnnxGraph, node: Node) -> set[int]:
    """Return the axes, from 0 to 3, over which a node computes a sum, mean or maximum; an empty set
    if it states none.

    Args:
        graph: the graph that the node belongs to.
        node: the node.
    """
    # From opset 18 on the axes are an input.
    return {axis % 4 for axis in graph.numbers(node, 1, "axes") or ()}


def pool_mean(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a mean over rows and columns by GlobalAveragePool, and a Flatten if both axes are
    dropped, and a sum or mean over channels by a convolution of one pixel.

    Args:
        graph: the graph that the node belongs to, to whose shapes that of a new tensor is added.
        node: any node.

    Returns:
        The nodes that replace the mean; None if the node is something else.
    """
    size = graph.shapes.get(node.source, ())
    if node.op_type not in ("ReduceMean", "ReduceSum") or len(size) != 4:
        return None
    axes = reduced_axes(graph, node)
    output = node.result
    keeps_axes = node.attribute("keepdims", 1)
    if axes == {1} and size[1] and keeps_axes:
        # A layer normalisation, which has a root, is refused by its mean.
        if any(other.op_type == "Sqrt" for other in graph.nodes):
            return None
        weight = np.ones((1, size[1], 1, 1))
        if node.op_type == "ReduceMean":
            weight /= size[1]
        return [graph.convolution(node.source, output, node.name, weight)]
    if axes != {2, 3} or node.op_type != "ReduceMean":
        return None
    if keeps_axes:
        return [Node.new("GlobalAveragePool", node.inputs[:1], output, node.proto.name)]
    pooled = f"{output}.pooled"
    graph.shapes[pooled] = (*size[:2], 1, 1)
    return [
        Node.new("GlobalAveragePool", node.inputs[:1], pooled, node.proto.name),
        Node.new("Flatten", [pooled], output, f"{output}.flat"),
    ]


def pool_sums(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace sums over rows and columns, divided by the number of pixels, by GlobalAveragePool.

    Args:
        graph: the graph that the node belongs to.
        node: any node; the division is replaced.

    Returns:
        The mean; None if the node is something else, or the number is not known.
    """
    divisor = graph.value(node, 1) if node.op_type == "Div" else None
    axes: set[int] = set()
    name = node.source
    while (total := graph.writer(name)).op_type == "ReduceSum":
        if not total.attribute("keepdims", 1):
            return None
        axes |= reduced_axes(graph, total)
        name = total.source
    size = graph.shapes.get(name, ())
    if axes != {2, 3} or len(size) != 4 or divisor is None or (divisor != size[2] * size[3]).any():
        return None
    return [node.replaced_by("GlobalAveragePool", [name])]


def pool_maximum(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a maximum over rows and columns of known number by a MaxPool, and one over channels
    by maxima of two halves, until one channel is left: max(a, b) = b + ReLU(a - b).

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The nodes that replace the maximum; None if the node is something else.
    """
    if node.op_type not in ("GlobalMaxPool", "ReduceMax"):
        return None
    source = node.source
    size = graph.shapes.get(source, ())
    axes = reduced_axes(graph, node)
    result = node.result
    if len(size) != 4 or not node.attribute("keepdims", 1):
        return None
    is_global = node.op_type == "GlobalMaxPool" or axes == {2, 3}
    if is_global and all(size[2:]):
        return [Node.new("MaxPool", [source], result, node.name, kernel_shape=list(size[2:]))]
    return largest(graph, node, source, size[1], 1) if axes == {1} and size[1] else None


def largest(graph: OnnxGraph, node: Node, source: str, count: int, width: int) -> list[Node]:
    """Return the nodes that compute the largest of parts of the channels, by maxima of two halves
    of the parts until one is left: max(a, b) = b + ReLU(a - b).

    Args:
        graph: the graph, whose constants are extended.
        node: the maximum that is replaced.
        source: the name of the map.
        count: the number of parts.
        width: the channels of each part.
    """
    result = node.result
    nodes: list[Node] = []
    while count > 1:
        half = -(-count // 2)
        first = np.eye(half, count)
        # The last part of an odd number is its own partner.
        second = np.eye(count)[np.minimum(np.arange(half) + half, count - 1)]
        names = [f"{result}.{half}.{role}" for role in ("difference", "relu", "second")]
        difference, limited, other = names
        larger = result if half == 1 else f"{result}.{half}"
        parts = np.eye(width)
        weights = [np.kron(weight, parts)[..., None, None] for weight in (first - second, second)]
        nodes += [
            graph.convolution(source, difference, difference, weights[0]),
            Node.new("Relu", [difference], limited),
            graph.convolution(source, other, other, weights[1]),
            Node.new("Add", [other, limited], larger, node.name if half == 1 else larger),
        ]
        source = larger
        count = half
    identity = np.eye(width)[..., None, None]
    return nodes or [graph.convolution(source, result, node.name, identity)]


def shrink_by_convolution(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a Resize to every n-th part of rows and columns by a depthwise convolution.

    Its kernel of n x n pixels and stride n has the weights of the interpolation.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The convolution; None if the node is something else, or reads pixels beyond its block.
    """
    if node.op_type != "Resize" or node.attribute("antialias", 0):
        return None
    resizing = Resizing.of(graph, node)
    channels = graph.channels(node.source)
    *_, factor, other_factor = resizing.factors or (0.0, 0.0)
    is_known = resizing.where in PLACES and resizing.mode in ("linear", "nearest")
    if not (channels and is_known and 0 < factor < 1) or factor != other_factor:
        return None
    block = round(1 / factor)
    if not np.isclose(block * factor, 1, atol=1e-6):
        return None
    # The place in a block at which the result is interpolated.
    place = PLACES[resizing.where](0, factor)
    if resizing.mode == "nearest":
        place = ROUNDINGS[resizing.rounding](place)
    taps = np.maximum(1 - abs(np.arange(block) - place), 0)
    weight = np.broadcast_to(np.outer(taps, taps), (channels, 1, block, block))
    strides = [block, block]
    result = node.result
    return [
        graph.convolution(node.source, result, node.name, weight, strides=strides, group=channels)
    ]
