"""Sizes of what a node computes of one image, from those of what it reads."""

from collections.abc import Mapping, Sequence

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper, shape_inference

from beers_deploy.quant.graph.nodes import Kind, Node, Window
from beers_deploy.quant.reading.folding import OPSET
from beers_deploy.quant.untrusted import LIST_VALUES

Shape = tuple[int, int, int]
"""Channels, height, width."""
WINDOWED = ("conv", "grouped conv", "depthwise", "transposed", "pool")


def out_shape(
    node: Node,
    kind: Kind,
    shapes: Sequence[Shape | None],
    window: Window,
    channels: int,
    constants: Mapping[str, np.ndarray],
) -> Shape | None:
    """Shape (C, H, W) of a node's first result; None where it cannot be known.

    Args:
        node: the node.
        kind: what it computes.
        shapes: of the tensors that it reads.
        window: of a convolution or pool.
        channels: of a convolution's result.
        constants: the file's, for operators that read sizes from them.
    """
    known = [shape for shape in shapes if shape is not None]
    if not known or len(known) != len(shapes):
        return None
    first = known[0]
    if kind in WINDOWED:
        ceil = bool(node.attributes.get("ceil_mode", 0))
        rows, columns = (
            window.put_down(axis, first[1 + axis])
            if kind == "transposed"
            else window.slid(axis, first[1 + axis], ceil)
            for axis in (0, 1)
        )
        return (channels, rows, columns) if min(rows, columns) > 0 else None
    if kind == "concat" and len(known) > 1:
        return (sum(shape[0] for shape in known), first[1], first[2])
    if kind in ("add", "mul") or node.op_type == "Where":
        return (max(s[0] for s in known), max(s[1] for s in known), max(s[2] for s in known))
    return first if kind in ("activation", "quantise", "dequantise") else _inferred(node, known, constants)


def _inferred(node: Node, known: list[Shape], constants: Mapping[str, np.ndarray]) -> Shape | None:
    """What onnx knows of one standard operator."""
    shapes = iter(known)
    types, data = {}, {}
    for name in filter(None, node.inputs):
        if name in constants:
            value = constants[name]
            types[name] = helper.make_tensor_type_proto(helper.np_dtype_to_tensor_dtype(value.dtype), value.shape)
            if value.size <= LIST_VALUES:
                data[name] = numpy_helper.from_array(value)
        elif (shape := next(shapes, None)) is not None:
            types[name] = helper.make_tensor_type_proto(TensorProto.FLOAT, [1, *shape])
        else:  # a scale or a size that is no constant of the file
            return None
    try:
        schema = onnx.defs.get_schema(node.op_type, OPSET, node.proto.domain)
        opsets = [helper.make_opsetid("", OPSET)]
        found = shape_inference.infer_node_outputs(schema, node.proto, types, data, opset_imports=opsets)
        sizes = [d.dim_value for d in found[node.outputs[0]].tensor_type.shape.dim]
    except Exception:  # noqa: BLE001 - an unknown operator and whatever its own inference raises mean: unknown
        return None
    return (sizes[1], sizes[2], sizes[3]) if len(sizes) == 4 and min(sizes) > 0 else None
