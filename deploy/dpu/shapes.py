"""The kind of operation of an ONNX node, and the shape of its result."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper, shape_inference

from beers_deploy.profiles.errors import CODE_FAULTS
from beers_deploy.quant.domains import OPSET
from beers_deploy.quant.onnx.graph import Node, sizes_of
from beers_deploy.quant.onnx.runnable import LIST_VALUES
from beers_deploy.quant.onnx.window import Pair, Window

Kind = Literal[
    "conv",
    "grouped conv",
    "depthwise",
    "transposed",
    "add",
    "mul",
    "pool",
    "activation",
    "concat",
    "pad",
    "resize",
    "pixel shuffle",
    "argmax",
    "quantize",
    "dequantize",
    "other",
]
POOLS = ("AveragePool", "GlobalAveragePool")
OPERATORS: dict[Kind, tuple[str, ...]] = {
    "conv": ("Conv", "QLinearConv"),
    "transposed": ("ConvTranspose",),
    "add": ("Add", "QLinearAdd"),
    "mul": ("Mul", "QLinearMul"),
    "concat": ("Concat", "QLinearConcat"),
    "pad": ("Pad",),
    "resize": ("Resize", "Upsample"),
    "pixel shuffle": ("DepthToSpace", "SpaceToDepth"),
    "argmax": ("ArgMax",),
    "quantize": ("QuantizeLinear",),
    "dequantize": ("DequantizeLinear",),
    "activation": ("Relu", "LeakyRelu", "QLinearLeakyRelu", "PRelu", "HardSigmoid", "HardSwish"),
    "pool": ("MaxPool", *POOLS, *(f"QLinear{pool}" for pool in POOLS), "GlobalMaxPool"),
}
KINDS: dict[str, Kind] = {}
for _kind, _op_types in OPERATORS.items():
    KINDS.update(dict.fromkeys(_op_types, _kind))

Shape = tuple[int, int, int]
"""Channels, height, width."""
WINDOWED = ("conv", "grouped conv", "depthwise", "transposed", "pool")


def kind_of(node: Node, weight: np.ndarray | None) -> Kind:
    """Classify an ONNX node by what it computes, whatever the encoding of the file.

    Args:
        node: the ONNX node.
        weight: its weights, whose shape distinguishes depthwise and grouped convolutions; None if
            the node has none.

    Returns:
        The kind; "other" for an operator that the DPU does not know.
    """
    kind = KINDS.get(node.op_type, "other")
    if kind != "conv" or weight is None or node.attributes.get("group", 1) == 1:
        return kind
    return "depthwise" if weight.shape[1] == 1 else "grouped conv"


def out_shape(
    node: Node,
    kind: Kind,
    shapes: Sequence[Shape | None],
    kernel: Pair,
    window: Window,
    channels: int,
    constants: Mapping[str, np.ndarray],
) -> Shape | None:
    """Infer the shape of the first output of a node.

    Args:
        node: the ONNX node.
        kind: its kind of operation.
        shapes: the shape (C, H, W) of each activation that the node reads; None if unknown.
        kernel: height and width of the kernel of a convolution or pool.
        window: strides, pads and dilations of the kernel.
        channels: the number of output channels of a convolution or pool.
        constants: the constants of the file by name. Some operators read sizes from them.

    Returns:
        The shape (C, H, W); None if it cannot be inferred.
    """
    inputs = [shape for shape in shapes if shape is not None]
    if not inputs or len(inputs) != len(shapes):
        return None
    first = inputs[0]
    if kind in WINDOWED:
        ceil = bool(node.attributes.get("ceil_mode", 0))
        rows, columns = (
            window.transposed_size(axis, kernel[axis], first[1 + axis]) + node.output_padding[axis]
            if kind == "transposed"
            else window.output_size(axis, kernel[axis], first[1 + axis], ceil)
            for axis in (0, 1)
        )
        return (channels, rows, columns) if min(rows, columns) > 0 else None
    if kind == "concat" and len(inputs) > 1:
        return (sum(shape[0] for shape in inputs), first[1], first[2])
    if kind in ("add", "mul") or node.op_type == "Where":
        channels, rows, columns = map(max, zip(*inputs, strict=True))
        return (channels, rows, columns)
    if kind in ("activation", "quantize", "dequantize"):
        return first
    return _inferred(node, inputs, constants)


def _inferred(node: Node, inputs: list[Shape], constants: Mapping[str, np.ndarray]) -> Shape | None:
    """Return the shape that onnx infers for one standard operator."""
    shapes = iter(inputs)
    types = {}
    data = {}
    for name in filter(None, node.inputs):
        if name in constants:
            value = constants[name]
            types[name] = helper.make_tensor_type_proto(
                helper.np_dtype_to_tensor_dtype(value.dtype), value.shape
            )
            # Weights are longer, and do not determine sizes.
            if value.size <= LIST_VALUES:
                data[name] = numpy_helper.from_array(value)
        elif (shape := next(shapes, None)) is not None:
            types[name] = helper.make_tensor_type_proto(TensorProto.FLOAT, [1, *shape])
        else:  # a scale or a size that is no constant of the file
            return None
    try:
        schema = onnx.defs.get_schema(node.op_type, OPSET)
        opsets = [helper.make_opsetid("", OPSET)]
        outputs = shape_inference.infer_node_outputs(
            schema, node.written(), types, data, opset_imports=opsets
        )
        sizes = sizes_of(outputs[node.outputs[0]].tensor_type)
    except CODE_FAULTS:
        # A version of onnx that lacks this call would make every size unknown.
        raise
    except Exception:  # noqa: BLE001 - an unknown operator and whatever its own inference raises mean: unknown
        return None
    return (sizes[1], sizes[2], sizes[3]) if len(sizes) == 4 and min(sizes) > 0 else None
