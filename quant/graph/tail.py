"""What a network does behind its last map that a DPU can compute, such as decoding boxes: the
host's, in float.

A detector's file ends in slices, sums with a grid, exponentials and sigmoids. They are kept as the
ONNX nodes that they are, from `correction` to the result, and written behind the core again.
"""

import base64
from collections.abc import Collection
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from onnx import GraphProto, ModelProto, NodeProto, TensorProto, helper
from onnx.reference import ReferenceEvaluator

from beers_deploy.quant.graph.operations import CORRECTION
from beers_deploy.quant.onnx_file import GraphWriter
from beers_deploy.quant.reading.folding import IR_VERSION, OPSET

PLAIN = {
    "Add",
    "Clip",
    "Concat",
    "Div",
    "Exp",
    "Flatten",
    "Mul",
    "Pow",
    "Reshape",
    "Sigmoid",
    "Slice",
    "Softmax",
    "Softplus",
    "Split",
    "Sqrt",
    "Squeeze",
    "Sub",
    "Tanh",
    "Transpose",
    "Unsqueeze",
}
"""What a tail may hold: value by value, or moving values, so that it costs next to nothing.

No weights.
"""

RESULT = "restored"
"""The name of a host file's result."""


@dataclass(frozen=True)
class Tail:
    """Nodes behind the core, which read `correction` and write `restored`.

    Attributes:
        text: an ONNX graph in base64, so that a file can hold it among its words.
    """

    text: str

    @cached_property
    def graph(self) -> GraphProto:
        """The nodes and their constants."""
        try:
            graph: GraphProto = GraphProto.FromString(base64.b64decode(self.text, validate=True))
        except DecodeError as error:
            raise ValueError("a tail that is no graph") from error
        others = {node.op_type for node in graph.node} - PLAIN
        if others or len(graph.input) != 1 or len(graph.output) != 1:
            raise ValueError(f"a tail of {', '.join(sorted(others)) or 'several ends'}")
        return graph

    @property
    def result(self) -> onnx.ValueInfoProto:
        """The name and sizes of what it gives."""
        result: onnx.ValueInfoProto = self.graph.output[0]
        return result

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """What it makes of a map (N, C, H, W), in float32."""
        results: list[np.ndarray] = self._evaluator.run(
            None, {CORRECTION: values.astype(np.float32)}
        )  # type: ignore[assignment]
        return results[0]

    def write(self, writer: GraphWriter, source: str) -> None:
        """Write its nodes behind the tensor `source`."""
        writer.nodes.extend(_renamed(node, {CORRECTION: source}) for node in self.graph.node)
        for tensor in self.graph.initializer:
            writer.weights.setdefault(tensor.name, tensor)

    @cached_property
    def _evaluator(self) -> ReferenceEvaluator:
        opset = [helper.make_opsetid("", OPSET)]
        return ReferenceEvaluator(
            helper.make_model(self.graph, opset_imports=opset, ir_version=IR_VERSION)
        )


def without_tail(model: ModelProto, known: Collection[str]) -> tuple[ModelProto, Tail | None]:
    """The network up to the map behind which operators begin that are not `known`, and these as its
    tail.

    None, and the network as it is, where all are known, where they read more than one map, or where
    something lies behind them that is not the host's to compute.
    """
    nodes = [node for node in model.graph.node if node.op_type != "Constant"]
    first = next((k for k, node in enumerate(nodes) if node.op_type not in known), None)
    if first is None or len(model.graph.output) != 1:
        return model, None
    if any(node.op_type not in PLAIN for node in nodes[first:]):
        return model, None
    constants = {tensor.name for tensor in model.graph.initializer}
    reads: set[str] = set()
    # The tail grows towards the front, one node at a time, until it reads a single map.
    for start in range(len(nodes) - 1, 0, -1):
        node = nodes[start]
        if node.op_type not in PLAIN:
            break
        reads.difference_update(node.output)
        reads.update(name for name in node.input if name and name not in constants)
        if start <= first and len(reads) == 1:
            source = reads.pop()
            if source == model.graph.input[0].name:
                break
            return _parted(model, nodes[:start], nodes[start:], source)
    return model, None


def _parted(
    model: ModelProto, nodes: list[NodeProto], tail: list[NodeProto], source: str
) -> tuple[ModelProto, Tail]:
    body = deepcopy(model)
    output = model.graph.output[0]
    del body.graph.node[:], body.graph.output[:]
    body.graph.node.extend(nodes)
    body.graph.output.append(helper.make_tensor_value_info(source, TensorProto.FLOAT, None))
    # A prefix of its own keeps the tail's tensors apart from those that a host file writes.
    names: dict[str, str] = {}
    for node in tail:
        names |= {name: f"host_tail.{name}" for name in (*node.input, *node.output) if name}
    names |= {source: CORRECTION, output.name: RESULT}
    constants = [tensor for tensor in model.graph.initializer if tensor.name in names]
    correction = onnx.ValueInfoProto(name=CORRECTION)
    result = onnx.ValueInfoProto(name=RESULT, type=output.type)
    correction.type.tensor_type.elem_type = TensorProto.FLOAT
    tail_nodes = [_renamed(node, names) for node in tail]
    graph = helper.make_graph(tail_nodes, "tail", [correction], [result])
    for tensor in constants:
        graph.initializer.add().CopyFrom(tensor)
        graph.initializer[-1].name = names[tensor.name]
    # Deterministic, so that the same network gives the same file.
    content = graph.SerializeToString(deterministic=True)
    return body, Tail(base64.b64encode(content).decode())


def _renamed(node: NodeProto, names: dict[str, str]) -> NodeProto:
    copy = deepcopy(node)
    for field in (copy.input, copy.output):
        field[:] = [names.get(name, name) for name in field]
    if not copy.name.startswith("host_tail."):
        copy.name = f"host_tail.{copy.name or copy.output[0]}"
    return copy
