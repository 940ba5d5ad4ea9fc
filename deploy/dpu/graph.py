"""A network as the DPU sees it: a short list of operations, independent of the encoding of its ONNX
file, each with its kind and the shape of its result.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper, shape_inference

from beers_deploy.profiles.errors import CODE_FAULTS, ModelError, printable
from beers_deploy.quant.domains import OPSET
from beers_deploy.quant.graph.quantized import Scale
from beers_deploy.quant.onnx.graph import Node
from beers_deploy.quant.onnx.messages import sizes_of
from beers_deploy.quant.onnx.runnable import LIST_VALUES
from beers_deploy.quant.onnx.window import Sides, Window

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


def out_shape(op: "Operation", node: Node, constants: Mapping[str, np.ndarray]) -> Shape | None:
    """Infer the shape of the first output of an operation.

    Args:
        op: the operation, all of whose other properties are known.
        node: the ONNX node that it was read from.
        constants: the constants of the file by name. Some operators read sizes from them.

    Returns:
        The shape (C, H, W); None if it cannot be inferred.
    """
    inputs = [shape for shape in op.in_shapes if shape is not None]
    if not inputs or len(inputs) != len(op.in_shapes):
        return None
    first = inputs[0]
    if op.kind in WINDOWED:
        rows, columns = (
            op.window.transposed_size(axis, side, size) + node.output_padding[axis]
            if op.kind == "transposed"
            else op.window.output_size(axis, side, size, bool(op.attributes.get("ceil_mode", 0)))
            for axis, (side, size) in enumerate(zip(op.kernel, first[1:], strict=True))
        )
        return (op.channels[1], rows, columns) if min(rows, columns) > 0 else None
    if op.kind == "concat" and len(inputs) > 1:
        # ONNX counts the axis of the images too.
        joined = op.attributes["axis"] % 4 - 1
        channels, rows, columns = (
            sum(sides) if axis == joined else sides[0]
            for axis, sides in enumerate(zip(*inputs, strict=True))
        )
        return (channels, rows, columns)
    if op.kind in ("add", "mul") or op.op_type == "Where":
        channels, rows, columns = map(max, zip(*inputs, strict=True))
        return (channels, rows, columns)
    if op.kind in ("activation", "quantize", "dequantize"):
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


CONVOLUTIONS = frozenset({"conv", "grouped conv", "depthwise", "transposed"})


@dataclass(frozen=True)
class Operation:
    """One operation of a network, as the checker and the cost model read it.

    An activation is a tensor that depends on the image, in contrast to weights and constants. A
    role is the use of a tensor by the node: "input 0", "input 1", ..., "weight", "bias", "output".

    Attributes:
        name: the name of the ONNX node.
        op_type: the ONNX operator, such as "QLinearConv".
        kind: the kind of operation, whatever the encoding of the file.
        inputs: the names of the activations that the node reads.
        outputs: the names of the activations that it writes.
        in_shapes: the shape (C, H, W) of each input; None if unknown.
        out_shape: the shape (C, H, W) of the first output; None if unknown.
        kernel: height and width of the kernel; (1, 1) without one.
        window: strides, pads and dilations of the kernel.
        channels: the numbers of input and output channels.
        weight_bytes: the number of weights, which have a byte each in int8.
        constant_shape: the shape of an element-wise operator's constant operand; None without one.
        attributes: the ONNX attributes.
        follows: the kind of the operation that writes the first input; None for the network's
            input.
        integer: True if the file computes the node on integers.
        scales: the number format (scale and zero point) of each quantised tensor, by role.
        disputed: the number formats of the roles for which the file states several.
        constants: the constants as stored, by role; None for one that other nodes compute.
    """

    name: str
    op_type: str
    kind: Kind
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    in_shapes: tuple[Shape | None, ...] = ()
    out_shape: Shape | None = None
    kernel: Sides = (1, 1)
    window: Window = field(default_factory=Window)
    channels: tuple[int, int] = (0, 0)
    weight_bytes: int = 0
    constant_shape: tuple[int, ...] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    follows: Kind | None = None
    integer: bool = False
    scales: Mapping[str, Scale] = field(default_factory=dict)
    disputed: Mapping[str, tuple[Scale, ...]] = field(default_factory=dict)
    constants: Mapping[str, np.ndarray | None] = field(default_factory=dict, compare=False)

    @property
    def output(self) -> str:
        """The name of the first activation that the node writes."""
        return self.outputs[0]

    @property
    def in_shape(self) -> Shape | None:
        """The shape (C, H, W) of the first input; None if unknown or without inputs."""
        return self.in_shapes[0] if self.in_shapes else None

    @property
    def kernel_area(self) -> int:
        """The number of positions of the kernel."""
        return self.kernel[0] * self.kernel[1]

    @property
    def operations(self) -> int:
        """The number of int8 operations for one image; 0 if the node is no convolution.

        It is 2 kh kw ic oc h w / groups, with the kernel (kh, kw), ic input and oc output channels,
        and h w pixels of the result (of the input for a transposed convolution). A multiplication
        and an addition count as two operations.
        """
        if self.kind not in CONVOLUTIONS:
            return 0
        # A transposed convolution multiplies the weights with each pixel of its input.
        shape = self.in_shape if self.kind == "transposed" else self.out_shape
        # A weight has one byte and is used once a pixel: a product and a sum are two operations.
        return 2 * self.weight_bytes * _pixels(self.name, shape)

    @property
    def out_bytes(self) -> int:
        """The size of the first output as int8 in bytes, for one image.

        Raises:
            ModelError: the shape of the output is unknown.
        """
        return _pixels(self.name, self.out_shape) * (self.out_shape or (0,))[0]


@dataclass(frozen=True)
class SizedGraph:
    """A network as a list of operations, with the shapes that follow from one image size.

    Attributes:
        operations: the operations, in the order in which they are computed.
        inputs: the shape (C, H, W) of each input of the network, by name.
        outputs: the names of the network's outputs.
        quantized: True if the file contains integers, False for a float file.
    """

    operations: tuple[Operation, ...]
    inputs: Mapping[str, Shape]
    outputs: tuple[str, ...]
    quantized: bool


def _pixels(name: str, shape: Shape | None) -> int:
    if shape is None:
        raise ModelError(
            f"The shape of {printable(name)} cannot be computed from the shape of the input. "
            "Replace the node before it that hides the shape."
        )
    return shape[1] * shape[2]
