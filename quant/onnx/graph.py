"""Represent the one graph of an ONNX file: its nodes, the writers and readers of each tensor, and
its constants.

Simplification edits it, tiling traverses it, the quantiser reads typed operations from it and the
checker sized ones. Nothing is rejected here.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike
from onnx import (
    ModelProto,
    NodeProto,
    TensorProto,
    TypeProto,
    helper,
    numpy_helper,
    shape_inference,
)

from beers_deploy.quant.domains import Functions, functions_of, operator_name, opset_of
from beers_deploy.quant.onnx.messages import constants, free_name, replace_all, sizes_of
from beers_deploy.quant.onnx.window import Sides, Window

WEIGHTS = {"Conv": 1, "ConvInteger": 1, "ConvTranspose": 1, "QLinearConv": 3}
"""Operators with weights, and the input that holds them."""


@dataclass(eq=False)
class Node:
    """An operator of an ONNX graph, with the names of the tensors that it reads and writes.

    Attributes:
        op_type: its operator, as `quant.domains.operator_name` returns it.
        name: the node's own name, or that of its first result if it has none.
        inputs: the tensors that it reads; an omitted one has an empty name.
        outputs: the tensors that it writes.
        attributes: the attributes that the file states, with strings decoded.
        proto: the message that it was read from; inputs and outputs may have changed since.
    """

    op_type: str
    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]
    proto: NodeProto

    @classmethod
    def of(cls, proto: NodeProto, functions: Functions = ()) -> "Node":
        """Build a node from its message in a file.

        Args:
            proto: the message.
            functions: domain and name of each function that the file defines, as `functions_of`
                returns them.
        """
        op_type = operator_name(proto, functions)
        name = proto.name or proto.output[0]
        attributes = {}
        for attribute in proto.attribute:
            value = helper.get_attribute_value(attribute)
            text = value.decode(errors="replace") if isinstance(value, bytes) else value
            attributes[attribute.name] = text
        return cls(op_type, name, tuple(proto.input), tuple(proto.output), attributes, proto)

    @classmethod
    def new(
        cls,
        op_type: str,
        inputs: Sequence[str],
        output: str,
        name: str | None = None,
        **attributes: Any,
    ) -> "Node":
        """Build a node that writes one tensor.

        Args:
            op_type: an operator of ONNX.
            inputs: the names of the tensors that it reads.
            output: the name of the tensor that it writes.
            name: the name of the node; None for that of the tensor.
            attributes: the attributes of the operator.
        """
        return cls.of(helper.make_node(op_type, inputs, [output], name or output, **attributes))

    def replaced_by(self, op_type: str, inputs: Sequence[str], **attributes: Any) -> "Node":
        """Build a node of the same name and result, with another operator or other inputs.

        Args:
            op_type: an operator of ONNX.
            inputs: the names of the tensors that it reads.
            attributes: the attributes of the operator.
        """
        return Node.new(op_type, inputs, self.result, self.name, **attributes)

    @property
    def source(self) -> str:
        """The first tensor that it reads; empty if it reads none."""
        return self.inputs[0] if self.inputs else ""

    @property
    def result(self) -> str:
        """The first tensor that it writes."""
        return self.outputs[0]

    def __str__(self) -> str:
        return f"{self.op_type} {self.name}"

    @property
    def orders(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The inputs in both orders, to find an operand where the order does not matter."""
        return self.inputs, self.inputs[::-1]

    def read_instead(self, name: str, other: str) -> None:
        """Let the node read another tensor wherever it reads `name`."""
        self.inputs = tuple(other if each == name else each for each in self.inputs)

    def written(self) -> NodeProto:
        """Return the node as a message for a file, with its current inputs and outputs."""
        proto = NodeProto()
        proto.CopyFrom(self.proto)
        proto.input[:] = self.inputs
        proto.output[:] = self.outputs
        return proto

    def window(
        self, kernel: Sequence[int] = (), size: Sides = (0, 0)
    ) -> tuple[Sides, Window] | None:
        """Return the kernel of a convolution or pool, and how it moves over the map.

        Args:
            kernel: rows and columns of its weights; empty to use the node's own attribute.
            size: height and width of the map that it reads, from which `auto_pad` is computed. A
                size that differs by whole strides gives the same pads.

        Returns:
            Rows and columns of the kernel, and strides, pads and dilations; None if the kernel is
            not known, or if it or the attributes are not those of two dimensions.
        """
        attribute = self.attribute
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

    def attribute(self, key: str, otherwise: Any = None) -> Any:
        """Return an attribute of the node, or `otherwise` if the file does not state it."""
        return self.attributes.get(key, otherwise)

    @property
    def groups(self) -> int:
        """The number of groups of a convolution."""
        return int(self.attribute("group", 1))

    @property
    def output_padding(self) -> Sequence[int]:
        """The rows and columns that a transposed convolution adds at the end of its result."""
        return self.attribute("output_padding", (0, 0))  # type: ignore[no-any-return]


NO_NODE = Node("", "", (), ("",), {}, NodeProto())
"""The writer of a tensor that no node writes. Its operator equals none."""
Replacement = list[Node] | None
"""The nodes that replace a node; None if it stays."""
Rewriting = Callable[["OnnxGraph", Node], Replacement]


class OnnxGraph:
    """The graph of an ONNX model for reading and editing.

    Nodes that only hold a constant count as constants. Edits reach the model when `save` is called.

    Attributes:
        nodes: the nodes in order.
        constants: initializers and the values of Constant nodes, by name.
        inputs: the sizes of each tensor that is fed to the model, by name; 0 for a free size.
        types: ONNX's number of the element type of each of these inputs, by name.
        outputs: the names of the results.
        result_sizes: the sizes of each result by name, 0 for a free size; empty if the file does
            not state the rank.
        readers: for each tensor the nodes that read it. A node that reads it twice is listed twice.
        writers: for each tensor the node that writes it.
        shapes: the sizes of tensors by name, 0 for an unknown size; empty until they are inferred.
        opset: the version of ONNX's operators that the model states.
    """

    def __init__(self, model: ModelProto) -> None:
        self._model = model
        self.opset = opset_of(model)
        self.shapes: dict[str, tuple[int, ...]] = {}
        functions = functions_of(model)
        self.constants = constants(model)
        nodes = [Node.of(node, functions) for node in model.graph.node]
        inputs = {
            v.name: v.type.tensor_type for v in model.graph.input if v.name not in self.constants
        }
        self.inputs = {name: list(sizes_of(tensor)) for name, tensor in inputs.items()}
        self.types = {name: tensor.elem_type for name, tensor in inputs.items()}
        self.result_sizes = {v.name: sizes_of(v.type.tensor_type) for v in model.graph.output}
        self.outputs = tuple(value.name for value in model.graph.output)
        # The number of names derived from each name, so that a thousand nodes of one name do not
        # try each other's.
        self._name_counts = dict.fromkeys(self.constants, 0)
        for node in nodes:
            self._name_counts.update(dict.fromkeys((*node.inputs, *node.outputs), 0))
        self.set_nodes([node for node in nodes if node.op_type != "Constant"])

    def set_nodes(self, nodes: list[Node]) -> None:
        """Replace all nodes, and update the readers and writers of tensors."""
        self.nodes = nodes
        self.readers: dict[str, list[Node]] = defaultdict(list)
        self.writers: dict[str, Node] = {}
        for node in nodes:
            for name in node.inputs:
                self.readers[name].append(node)
            # An omitted result has an empty name, which no node may read.
            self.writers.update((name, node) for name in node.outputs if name)

    def rewrite(self, rewriting: Rewriting) -> None:
        """Apply a pass to the graph: replace each node, in order, by the nodes that the pass
        returns for it.

        During the pass `readers` are those of the graph before it, and `writers` are up to date.

        Args:
            rewriting: the pass, a function of the graph and a node; None leaves the node as it is.
        """
        nodes = []
        for node in self.nodes:
            replacement = rewriting(self, node)
            new_nodes = [node] if replacement is None else replacement
            # At once, because the pass looks up the writers of tensors that later nodes read.
            for new in new_nodes:
                self.writers.update((name, new) for name in new.outputs if name)
            nodes += new_nodes
        self.set_nodes(nodes)

    def save(self) -> None:
        """Write the nodes and constants into the model that the graph was built from.

        Nodes that lead to no output are dropped.
        """
        needed = set(self.outputs)
        nodes = []
        # Backwards, because a node is needed only where something behind it reads its result.
        for node in reversed(self.nodes):
            if needed.intersection(node.outputs):
                needed.update(node.inputs)
                nodes.append(node)
        self.set_nodes(nodes[::-1])
        graph = self._model.graph
        replace_all(graph.node, [node.written() for node in self.nodes])
        stored = {tensor.name for tensor in graph.initializer}
        new = {name: value for name, value in self.constants.items() if name not in stored}
        graph.initializer.extend(
            numpy_helper.from_array(value, name) for name, value in new.items()
        )

    def tensor_types(self) -> dict[str, TypeProto.Tensor]:
        """Infer ONNX's type of each tensor, which has its sizes; {} if stated sizes contradict."""
        try:
            graph = shape_inference.infer_shapes(self._model).graph
        except shape_inference.InferenceError:
            return {}
        values = (*graph.input, *graph.value_info, *graph.output)
        return {value.name: value.type.tensor_type for value in values}

    def infer_shapes(self) -> None:
        """Infer the sizes of each float32 tensor of known rank, and store them in `shapes`."""
        self.shapes = {
            name: sizes_of(tensor)
            for name, tensor in self.tensor_types().items()
            if tensor.elem_type == TensorProto.FLOAT and tensor.HasField("shape")
        }

    def channels(self, name: str) -> int:
        """Return the number of channels of a map (N, C, H, W); 0 if `shapes` does not state it."""
        sizes = self.shapes.get(name, ())
        return sizes[1] if len(sizes) == 4 else 0

    def n_reads(self, name: str) -> int:
        """Return the number of times a tensor is read, by nodes and as a result of the model."""
        return len(self.readers.get(name, ())) + self.outputs.count(name)

    def writer(self, name: str) -> Node:
        """Return the node that writes a tensor; NO_NODE if none does."""
        return self.writers.get(name, NO_NODE)

    def sole_writer(self, name: str) -> Node:
        """Return the node that writes a tensor which is read exactly once; NO_NODE for others.

        Passes use it to change the node, because no other reader is affected.
        """
        return self.writer(name) if self.n_reads(name) == 1 else NO_NODE

    def rename(self, result: str, name: str) -> None:
        """Let the node that writes one tensor write another instead, whose node is then not needed.

        Args:
            result: the tensor that the node writes.
            name: the tensor that it writes from now on.
        """
        writer = self.writers[result]
        self.writers[name] = writer
        writer.outputs = tuple(name if output == result else output for output in writer.outputs)

    def add_constant(self, name: str, value: ArrayLike, dtype: DTypeLike = np.float32) -> str:
        """Store a constant under a free name, and return that name.

        Args:
            name: the name to use; a number is added if it is taken.
            value: the constant, a number or an array of any shape.
            dtype: the type in which it is stored.
        """
        name = free_name(name, self._name_counts)
        self.constants[name] = np.array(value, dtype)
        return name

    def convolution(
        self,
        source: str,
        output: str,
        name: str,
        weight: np.ndarray,
        bias: np.ndarray | None = None,
        **attributes: Any,
    ) -> Node:
        """Build a convolution node, and store its weights and bias as constants of the graph.

        Args:
            source: the name of the tensor that it reads.
            output: the name of the tensor that it writes.
            name: the name of the node.
            weight: (O, I / groups, kh, kw), stored as float32.
            bias: (O,), stored as float32; None for none.
            attributes: the attributes of the node, besides the size of its kernel.
        """
        inputs = [source, self.add_constant(f"{name}.weight", weight)]
        if bias is not None:
            inputs.append(self.add_constant(f"{name}.bias", bias))
        attributes = {"kernel_shape": list(weight.shape[2:]), **attributes}
        return Node.new("Conv", inputs, output, name, **attributes)

    def mirrored(self, source: str, border_px: int, output: str) -> Node:
        """Build a Pad that mirrors a map beyond its borders.

        Args:
            source: the name of the map.
            border_px: the number of pixels that are added at each side.
            output: the name of the result.
        """
        pads = self.add_constant(f"{output}.pads", [0, 0, border_px, border_px] * 2, np.int64)
        return Node.new("Pad", [source, pads], output, mode="reflect")

    def value(self, node: Node, place: int) -> np.ndarray | None:
        """Return the constant that a node reads as one of its inputs.

        Args:
            node: the node.
            place: the number of the input, from 0 on.

        Returns:
            The constant; None if the input is omitted, or computed by other nodes.
        """
        return self.constants.get(node.inputs[place]) if place < len(node.inputs) else None

    def numbers(self, node: Node, place: int, key: str) -> list[Any] | None:
        """Return the numbers that a node states in a constant input or, in older opsets, in an
        attribute.

        Args:
            node: the node.
            place: the number of the input, from 0 on.
            key: the name of the attribute.

        Returns:
            The numbers, an empty list if the node states none; None if other nodes compute the
            input.
        """
        if place < len(node.inputs) and node.inputs[place]:
            value = self.value(node, place)
            return None if value is None else list(value.ravel().tolist())
        return list(node.attribute(key, ()))
