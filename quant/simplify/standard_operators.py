"""Replace operators that exporters write in several ways by the one operator that a DPU has."""

from onnx import TensorProto

from beers_deploy.quant.onnx.graph import Node, OnnxGraph, sizes_of

Shapes = dict[str, tuple[int, ...]]


def float_shapes(graph: OnnxGraph) -> Shapes:
    """Infer the sizes of each float32 tensor of a graph.

    Returns:
        The sizes by tensor name, 0 for an unknown size. Tensors of unknown rank are left out.
    """
    return {
        name: sizes_of(tensor)
        for name, tensor in graph.tensor_types().items()
        if tensor.elem_type == TensorProto.FLOAT and tensor.HasField("shape")
    }


def channels_in(shapes: Shapes, name: str) -> int:
    """Return the number of channels of a map (N, C, H, W); 0 if it is not known.

    Args:
        shapes: the sizes of each float tensor by name, as `float_shapes` returns them.
        name: the name of the map.
    """
    sizes = shapes.get(name, ())
    return sizes[1] if len(sizes) == 4 else 0


def slices_of(graph: OnnxGraph, node: Node) -> dict[int, slice]:
    """Return which part of each axis a Slice of a tensor of four axes selects.

    Args:
        graph: the graph that the node belongs to.
        node: a Slice.

    Returns:
        The slice of each axis that is cut, by the axis' number from 0 to 3; empty if other nodes
        compute the positions.
    """
    starts, stops, axes, steps = (graph.numbers(node, place, "") for place in range(1, 5))
    if not (starts and stops and axes) or steps is None:
        return {}
    steps = steps or [1] * len(axes)
    cuts = map(slice, starts, stops, steps)
    return {axis % 4: cut for axis, cut in zip(axes, cuts, strict=True)}


def split_sums(_: OnnxGraph, node: Node) -> list[Node] | None:
    """Replace a Sum of several tensors by Adds of two, one after the other.

    Args:
        node: any node.

    Returns:
        The Adds; None if the node is no Sum of several tensors.
    """
    if node.op_type != "Sum" or len(node.inputs) < 2:
        return None
    subtotal = node.inputs[0]
    (output,) = node.outputs
    adds = []
    for number, name in enumerate(node.inputs[1:], 1):
        is_last = number == len(node.inputs) - 1
        result = output if is_last else f"{output}.{number}"
        own_name = node.proto.name if is_last else result
        adds.append(Node.new("Add", [subtotal, name], result, own_name))
        subtotal = result
    return adds


def drop_cast(shapes: Shapes, graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Remove a Cast to float32 of a tensor that is float32 already.

    onnxruntime leaves such a Cast if it writes a result.

    Args:
        shapes: the sizes of each float tensor by name, as `float_shapes` returns them.
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        An empty list if the node is removed; None if it stays.
    """
    if node.op_type != "Cast" or node.inputs[0] not in shapes:
        return None
    if graph.sole_writer(node.inputs[0]) is None or node.attributes["to"] != TensorProto.FLOAT:
        return None
    graph.rename(node.inputs[0], node.outputs[0])
    return []


def pool_mean(shapes: Shapes, graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Replace a mean over rows and columns by GlobalAveragePool, and a Flatten if both axes are
    dropped.

    Args:
        shapes: the sizes of each float tensor by name, as `float_shapes` returns them. That of a
            new tensor is added.
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        The nodes that replace the mean; None if the node is something else.
    """
    # From opset 18 on the axes are an input.
    axes = {axis % 4 for axis in graph.numbers(node, 1, "axes") or ()}
    size = shapes.get(node.inputs[0], ()) if node.op_type == "ReduceMean" else ()
    if len(size) != 4 or axes != {2, 3}:
        return None
    (output,) = node.outputs
    if node.attributes.get("keepdims", 1):
        return [Node.new("GlobalAveragePool", node.inputs[:1], output, node.proto.name)]
    pooled = f"{output}.pooled"
    shapes[pooled] = (*size[:2], 1, 1)
    return [
        Node.new("GlobalAveragePool", node.inputs[:1], pooled, node.proto.name),
        Node.new("Flatten", [pooled], output, f"{output}.flat"),
    ]
