"""An ONNX file read once: its nodes with their attributes, kinds and windows, and its constants as
arrays.

Nothing is refused here: `quantize` takes a short list of operations of it, tiling what it can
prove, `check` all, with the sizes of what each node computes of one image.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper, shape_inference

from beers_deploy.profiles.errors import CODE_FAULTS
from beers_deploy.quant.domains import Functions, functions_of, operator_name
from beers_deploy.quant.onnx_file import constants
from beers_deploy.quant.reading.folding import OPSET
from beers_deploy.quant.reading.nodes import attributes_of
from beers_deploy.quant.untrusted import LIST_VALUES
from beers_deploy.quant.window import Pair, Window

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
WEIGHTS = {"Conv": 1, "ConvInteger": 1, "ConvTranspose": 1, "QLinearConv": 3}
"""Operator, and which input holds its weights."""


@dataclass(frozen=True, eq=False)
class Node:
    """An operator, in ONNX's words; an input that is left out has no name."""

    op_type: str  # as `quant.domains.operator_name` has it
    name: str  # its own, or its first result's
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]
    proto: onnx.NodeProto  # as the file holds it

    @classmethod
    def of(cls, proto: onnx.NodeProto, functions: Functions = ()) -> "Node":
        """What a file holds of it, which may define functions."""
        name = proto.name or proto.output[0]
        op_type = operator_name(proto, functions)
        return cls(
            op_type, name, tuple(proto.input), tuple(proto.output), attributes_of(proto), proto
        )

    def __str__(self) -> str:
        return f"{self.op_type} {self.name}"

    def window(self, kernel: Sequence[int] = (), size: Pair = (0, 0)) -> tuple[Pair, Window] | None:
        """Return its kernel and how that moves over rows and columns; None if the node states none.

        Args:
            kernel: sides of its weights; empty for what the node states itself.
            size: of the map that it reads, or any that differs by whole strides: for `auto_pad`.
        """
        attribute = self.attributes.get
        sides = (
            kernel or attribute("kernel_shape", ()),
            attribute("strides", (1, 1)),
            attribute("dilations", (1, 1)),
            self.output_padding,
        )
        pads = attribute("pads", (0, 0, 0, 0))
        # In one dimension or three the lists are shorter or longer.
        if any(len(numbers) != 2 for numbers in sides) or len(pads) != 4:
            return None
        (rows, columns), strides, dilations, _ = sides
        window = Window(tuple(strides), tuple(pads), tuple(dilations))
        auto_pad = attribute("auto_pad", "NOTSET")
        if auto_pad in ("VALID", "SAME_UPPER", "SAME_LOWER"):
            window = window.padded(auto_pad, (rows, columns), size)
        return (rows, columns), window

    @property
    def output_padding(self) -> Sequence[int]:
        """Rows and columns that a transposed convolution adds behind its result."""
        return self.attributes.get("output_padding", (0, 0))  # type: ignore[no-any-return]


class OnnxGraph:
    """The nodes of a model in order, but for those that only hold a constant.

    Attributes:
        nodes: in order.
        constants: initializers and what nodes of the kind Constant hold, by name.
        inputs: tensors that are no constants, with their sizes, 0 where the file states none.
        types: ONNX's number of what each of them holds.
        outputs: the names of the results.
    """

    def __init__(self, model: onnx.ModelProto, nodes: Sequence[Node] | None = None) -> None:
        """Of a model as it is, or with other nodes in the place of its own."""
        self.constants = constants(model)
        functions = functions_of(model)
        if nodes is None:
            nodes = [Node.of(node, functions) for node in model.graph.node]
        self.nodes = tuple(node for node in nodes if node.op_type != "Constant")
        inputs = {
            v.name: v.type.tensor_type for v in model.graph.input if v.name not in self.constants
        }
        self.inputs = {
            name: [dim.dim_value for dim in tensor.shape.dim] for name, tensor in inputs.items()
        }
        self.types = {name: tensor.elem_type for name, tensor in inputs.items()}
        self.outputs = tuple(value.name for value in model.graph.output)

    @cached_property
    def readers(self) -> Mapping[str, list[Node]]:
        """The nodes that read each tensor, one as often as it does."""
        readers = defaultdict(list)
        for node in self.nodes:
            for name in node.inputs:
                readers[name].append(node)
        return readers

    def reads(self, name: str) -> int:
        """How often a tensor is read, by nodes and as a result."""
        return len(self.readers.get(name, ())) + self._written_out[name]

    @cached_property
    def _written_out(self) -> Counter[str]:
        return Counter(self.outputs)

    def value(self, node: Node, place: int) -> np.ndarray | None:
        """A constant that a node reads, None where it reads none there."""
        return self.constants.get(node.inputs[place]) if place < len(node.inputs) else None

    def numbers(
        self, node: Node, place: int, key: str, otherwise: Sequence[float] = ()
    ) -> list[Any] | None:
        """What a node states in a constant input or, of older opsets, in an attribute; None where
        it is computed.
        """
        if place < len(node.inputs) and node.inputs[place]:
            value = self.value(node, place)
            return None if value is None else list(value.ravel().tolist())
        return list(node.attributes.get(key, otherwise))


def kind_of(node: Node, weight: np.ndarray | None) -> Kind:
    """What a node is, of a convolution by its weights."""
    kind = KINDS.get(node.op_type, "other")
    if kind != "conv" or weight is None or node.attributes.get("group", 1) == 1:
        return kind
    return "depthwise" if weight.shape[1] == 1 else "grouped conv"


Shape = tuple[int, int, int]
"""Channels, height, width."""
WINDOWED = ("conv", "grouped conv", "depthwise", "transposed", "pool")


def out_shape(
    node: Node,
    kind: Kind,
    shapes: Sequence[Shape | None],
    kernel: Pair,
    window: Window,
    channels: int,
    constants: Mapping[str, np.ndarray],
) -> Shape | None:
    """Shape (C, H, W) of a node's first result; None where it cannot be known.

    Args:
        node: the node.
        kind: what it computes.
        shapes: of the tensors that it reads.
        kernel: of a convolution or pool.
        window: of the same.
        channels: of a convolution's result.
        constants: the file's, for operators that read sizes from them.
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
        return (max(s[0] for s in inputs), max(s[1] for s in inputs), max(s[2] for s in inputs))
    return (
        first
        if kind in ("activation", "quantize", "dequantize")
        else _inferred(node, inputs, constants)
    )


def _inferred(node: Node, inputs: list[Shape], constants: Mapping[str, np.ndarray]) -> Shape | None:
    """What onnx knows of one standard operator."""
    shapes = iter(inputs)
    types = {}
    data = {}
    for name in filter(None, node.inputs):
        if name in constants:
            value = constants[name]
            types[name] = helper.make_tensor_type_proto(
                helper.np_dtype_to_tensor_dtype(value.dtype), value.shape
            )
            # Weights are longer, and say nothing of sizes.
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
            schema, node.proto, types, data, opset_imports=opsets
        )
        sizes = [d.dim_value for d in outputs[node.outputs[0]].tensor_type.shape.dim]
    except CODE_FAULTS:
        # A version of onnx that lacks this call would make every size unknown.
        raise
    except Exception:  # noqa: BLE001 - an unknown operator and whatever its own inference raises mean: unknown
        return None
    return (sizes[1], sizes[2], sizes[3]) if len(sizes) == 4 and min(sizes) > 0 else None
