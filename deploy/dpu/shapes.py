"""Shapes of activations, computed node by node: onnx's own inference stalls at com.microsoft operators."""

import math
from collections.abc import Sequence

import onnx
from onnx import TensorProto, helper, shape_inference

from deploy.dpu.graph import Kind, Shape, Window


def out_shape(
    node: onnx.NodeProto,
    kind: Kind,
    shapes: Sequence[Shape | None],
    window: Window,
    channels: int,
    constants: dict[str, TensorProto],
) -> Shape | None:
    """Shape (C, H, W) of a node's first result; None where it cannot be known.

    Args:
        node: the node.
        kind: what it computes.
        shapes: of its activation inputs.
        window: of a convolution or pool.
        channels: output channels of a convolution.
        constants: the file's constants, for operators that read sizes from them.
    """
    known = [shape for shape in shapes if shape is not None]
    if not known or len(known) != len(shapes):
        return None
    first = known[0]
    if kind in ("conv", "grouped conv", "depthwise"):
        return _slide(first, window, channels)
    if kind == "transposed":
        return _grow(first, window, channels)
    if kind == "pool":
        return (first[0], 1, 1) if "Global" in node.op_type else _slide(first, window, first[0], _ceil_mode(node))
    if node.op_type in ("QLinearConcat", "Concat") and len(known) > 1:
        return (sum(shape[0] for shape in known), first[1], first[2])
    if kind in ("add", "mul") or node.op_type == "Where":
        return (max(s[0] for s in known), max(s[1] for s in known), max(s[2] for s in known))
    if kind in ("activation", "quantise", "dequantise"):
        return first
    return _infer(node, known, constants)


def padding(node_attributes: dict[str, object], shape: Shape | None, window: Window) -> Window:
    """The window with the pads that `auto_pad` asks for (ONNX, operator Conv)."""
    auto = node_attributes.get("auto_pad", b"NOTSET")
    if auto not in (b"SAME_UPPER", b"SAME_LOWER") or shape is None:
        return window
    total = [
        max((math.ceil(size / s) - 1) * s + (k - 1) * d + 1 - size, 0)
        for size, s, k, d in zip(shape[1:], window.stride, window.kernel, window.dilation, strict=True)
    ]
    small, large = [t // 2 for t in total], [t - t // 2 for t in total]
    begin, end = (small, large) if auto == b"SAME_UPPER" else (large, small)
    return Window(window.kernel, window.stride, (begin[0], begin[1], end[0], end[1]), window.dilation)


def _slide(shape: Shape, window: Window, channels: int, up: bool = False) -> Shape | None:
    """floor((size + pads - dilation (kernel - 1) - 1) / stride) + 1, or rounded up in a pool's ceil mode."""
    sizes = []
    for axis in (0, 1):
        padded = shape[1 + axis] + window.pads[axis] + window.pads[axis + 2]
        room = padded - window.dilation[axis] * (window.kernel[axis] - 1) - 1
        sizes.append((-(-room // window.stride[axis]) if up else room // window.stride[axis]) + 1)
    return (channels, sizes[0], sizes[1]) if min(sizes) > 0 else None


def _grow(shape: Shape, window: Window, channels: int) -> Shape | None:
    """Size = stride (size - 1) + output padding + dilation (kernel - 1) + 1 - pads."""
    height, width = (
        window.stride[axis] * (shape[1 + axis] - 1)
        + window.output_padding[axis]
        + window.dilation[axis] * (window.kernel[axis] - 1)
        + 1
        - window.pads[axis]
        - window.pads[axis + 2]
        for axis in (0, 1)
    )
    return (channels, height, width) if min(height, width) > 0 else None


def _ceil_mode(node: onnx.NodeProto) -> bool:
    return any(a.name == "ceil_mode" and a.i for a in node.attribute)


def _infer(node: onnx.NodeProto, known: list[Shape], constants: dict[str, TensorProto]) -> Shape | None:
    """What onnx knows of one standard operator."""
    shapes = iter(known)
    types, data = {}, {}
    for name in filter(None, node.input):
        if name in constants:
            data[name] = constants[name]
            types[name] = helper.make_tensor_type_proto(data[name].data_type, list(data[name].dims))
        elif (shape := next(shapes, None)) is not None:
            types[name] = helper.make_tensor_type_proto(TensorProto.FLOAT, [1, *shape])
        else:  # a scale or a size that is no constant of the file
            return None
    try:
        schema = onnx.defs.get_schema(node.op_type, 17, node.domain)
        opsets = [helper.make_opsetid("", 17)]
        found = shape_inference.infer_node_outputs(schema, node, types, data, opset_imports=opsets)
        sizes = [d.dim_value for d in found[node.output[0]].tensor_type.shape.dim]
    except Exception:  # noqa: BLE001 - an unknown operator and whatever its own inference raises mean: unknown
        return None
    return (sizes[1], sizes[2], sizes[3]) if len(sizes) == 4 and min(sizes) > 0 else None
