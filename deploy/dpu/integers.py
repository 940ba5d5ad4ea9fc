"""Which nodes of a file compute on integers, with which scales, and which nodes are mere notation for that.

A tensor holds one of four things:

1. "float": what the host computes with.
2. "int8": written by QuantizeLinear, a cast to int8 or an integer kernel (or the same numbers as uint8 around 128).
3. "seen": int8 seen as float, behind DequantizeLinear.
4. "wide": a sum of products of such, on its way to a QuantizeLinear.
"""

from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np
import onnx
from onnx import TensorProto, numpy_helper

from beers_deploy.dpu.graph import Scale

ONE = {0: (1, 2), -1: (3, 4)}
TWO = {0: (1, 2), 3: (4, 5), -1: (6, 7)}
FORMATS: dict[str, dict[int, tuple[int, int]]] = {
    **dict.fromkeys(("QLinearConv", "QLinearAdd", "QLinearMul"), TWO),
    **dict.fromkeys(("QLinearAveragePool", "QLinearGlobalAveragePool", "QLinearLeakyRelu"), ONE),
    "QuantizeLinear": {-1: (1, 2)},
    "DequantizeLinear": {0: (1, 2)},
}
"""Where an operator names the scale and zero point of input i, or (-1) of its result."""

NO_POINT = "uint8"
"""ONNX's type of what QuantizeLinear writes where no zero point is given."""


def stated(node: onnx.NodeProto, constants: Mapping[str, TensorProto]) -> Iterator[tuple[str, Scale]]:
    """The tensors whose format a node names, constants among them, each with that format."""
    places = FORMATS.get(node.op_type, {})
    if node.op_type == "QLinearConcat":
        places = {-1: (0, 1)} | {i: (i + 1, i + 2) for i in range(2, len(node.input), 3)}
    for place, (scale, zero_point) in places.items():
        name = node.output[0] if place == -1 else node.input[place]
        zero = node.input[zero_point] if len(node.input) > zero_point else ""
        kind = str(numpy_helper.to_array(constants[name]).dtype) if name in constants else NO_POINT
        yield name, _scale(constants.get(node.input[scale]), constants.get(zero), kind)


def _scale(values: TensorProto | None, zeros: TensorProto | None, kind: str) -> Scale:
    scales = tuple(map(float, numpy_helper.to_array(values).ravel())) if values is not None else ()
    if zeros is None:
        return Scale(scales, (0,), kind)
    array = numpy_helper.to_array(zeros)
    return Scale(scales, tuple(map(int, array.ravel())), str(array.dtype))


Content = Literal["float", "int8", "seen", "wide"]

BYTES = (TensorProto.INT8, TensorProto.UINT8)
ACTIVATIONS = {"Relu", "LeakyRelu", "PRelu", "HardSigmoid", "HardSwish", "Clip"}
ACTIVATIONS_MAX = 8
"""Of one after the other, looked past for the QuantizeLinear behind: a chain of thousands is nobody's network."""
OPERANDS = {
    **dict.fromkeys(("QuantizeLinear", "DequantizeLinear"), slice(0, 1)),
    **dict.fromkeys(("QLinearAdd", "QLinearMul"), slice(0, 4, 3)),
    "QLinearConcat": slice(2, None, 3),
}
"""Which inputs are tensors of the network; the rest are scales and zero points."""
ELEMENTWISE = {"Add", "Mul", "Concat", "QLinearAdd", "QLinearMul", "QLinearConcat"}
"""Operators whose constant operands are numbers of the network."""


class Integers:
    """The number formats of one file."""

    def __init__(self, model: onnx.ModelProto, constants: Mapping[str, TensorProto]) -> None:
        nodes = model.graph.node
        self.present = any(n.op_type in FORMATS for n in nodes)
        self._constants = constants
        self._ends = {o.name for o in model.graph.output}
        self._readers: dict[str, list[onnx.NodeProto]] = {}
        for node in nodes:
            for name in node.input:
                self._readers.setdefault(name, []).append(node)
        self._same: dict[str, str] = {}
        self._seen: dict[str, str] = {}
        self._formats: dict[str, tuple[Scale, ...]] = {}  # the writer's first, then whatever contradicts it
        self._content: dict[str, Content] = {
            i.name: "int8" if i.type.tensor_type.elem_type in BYTES else "float" for i in model.graph.input
        }
        for node in nodes:
            self._read_formats(node)
            self._follow(node)

    def resolve(self, name: str) -> str:
        """The tensor that a name stands for once notation is dissolved."""
        while name in self._same:
            name = self._same[name]
        return name

    def is_integer(self, node: onnx.NodeProto) -> bool:
        """Whether the file computes this node on integers."""
        return self._content.get(node.output[0], "float") in ("int8", "wide")

    def is_notation(self, node: onnx.NodeProto) -> bool:
        """Whether a node only says how its neighbours' integers are to be read."""
        result = node.output[0]
        if node.op_type == "DequantizeLinear" and result not in self._same:
            readers = self._readers.get(result, [])
            return result not in self._ends and all(self.is_integer(reader) for reader in readers)
        return result in self._same

    def activations(self, node: onnx.NodeProto) -> tuple[str, ...]:
        """The tensors of the network that a node reads."""
        default = slice(0, 1) if node.op_type.startswith("QLinear") else slice(None)
        names = [name for name in node.input[OPERANDS.get(node.op_type, default)] if name]
        if self.is_integer(node) and node.op_type != "QuantizeLinear":
            names = [self._seen.get(name, name) for name in names]
        resolved = (self.resolve(name) for name in names)
        return tuple(name for name in resolved if name not in self._constants)

    def scales(self, node: onnx.NodeProto) -> dict[str, Scale]:
        """The formats of a node's tensors by role: "input 0", ..., "weight", "bias", "constant 1", "output"."""
        own = dict(stated(node, self._constants))
        numbers = self._numbers(node)
        found = {role: formats[0] for role, name in self._tensors(node).items() if (formats := self._named(name))}
        found |= {role: own[name] for role, name in numbers.items() if name in own}
        return found | {role: self._formats[name][0] for role, name in numbers.items() if name in self._formats}

    def disputed(self, node: onnx.NodeProto) -> dict[str, tuple[Scale, ...]]:
        """The formats of a node's activations to which the file gives more than one, by role as in `scales`."""
        found = {role: self._named(name) for role, name in self._tensors(node).items()}
        return {role: formats for role, formats in found.items() if len(formats) > 1}

    def constants(self, node: onnx.NodeProto) -> dict[str, np.ndarray | None]:
        """The constants of a node as stored, by role as in `scales`; None for one that other nodes compute."""
        found = {role: self._constants.get(self.resolve(name)) for role, name in self._numbers(node).items()}
        return {role: None if t is None else numpy_helper.to_array(t) for role, t in found.items()}

    def _tensors(self, node: onnx.NodeProto) -> dict[str, str]:
        """The activations that an integer node reads and writes, by role."""
        if not self.is_integer(node):
            return {}
        inputs = {f"input {i}": name for i, name in enumerate(self.activations(node))}
        return inputs | {"output": self._requantised(node.output[0])}

    def _numbers(self, node: onnx.NodeProto) -> dict[str, str]:
        """What an integer node computes with besides activations, by role."""
        names: dict[str, str] = {}
        if not self.is_integer(node):
            return names
        if node.op_type in ("Conv", "ConvTranspose", "QLinearConv"):
            behind = node.input[1:] if node.op_type != "QLinearConv" else (node.input[3], *node.input[8:])
            names = dict(zip(("weight", "bias"), behind, strict=False))
        elif node.op_type in ELEMENTWISE:
            operands = enumerate(node.input[OPERANDS.get(node.op_type, slice(None))])
            names = {f"constant {i}": name for i, name in operands if self.resolve(name) in self._constants}
        return {role: name for role, name in names.items() if name}

    def _named(self, tensor: str) -> tuple[Scale, ...]:
        return self._formats.get(self.resolve(tensor), ())

    def _follow(self, node: onnx.NodeProto) -> None:
        """Work out what a node's results hold, from what its inputs hold."""
        if not node.output:
            return
        content = self._result(node)
        self._content |= dict.fromkeys(node.output, content)
        if node.op_type == "DequantizeLinear":
            aliases = self._same if self.resolve(node.input[0]) in self._constants else self._seen
            aliases[node.output[0]] = node.input[0]
        elif node.op_type == "QuantizeLinear" and self._content.get(node.input[0]) == "wide":
            self._same[node.output[0]] = node.input[0]
            self._give(node.input[0], self._formats[node.output[0]][0])
        elif content == "int8" and node.output[0] not in self._formats and node.input[0] in self._formats:
            self._give(node.output[0], self._formats[node.input[0]][0])

    def _result(self, node: onnx.NodeProto) -> Content:
        if node.op_type == "DequantizeLinear":
            return "seen"
        if node.op_type == "QuantizeLinear" or node.op_type in FORMATS or node.op_type == "QLinearConcat":
            return "int8"
        if node.op_type == "Cast":
            return "int8" if any(a.name == "to" and a.i in BYTES for a in node.attribute) else "float"
        names = [self.resolve(name) for name in node.input if name]
        holds = {self._content.get(name, "float") for name in names if name not in self._constants}
        if holds == {"int8"}:
            return "int8"
        return "wide" if holds and holds <= {"seen", "wide"} and self._requantised(node.output[0]) else "float"

    def _requantised(self, tensor: str) -> str:
        """The int8 tensor that a wide one becomes, past an activation; "" where it stays float."""
        for _ in range(ACTIVATIONS_MAX):
            readers = self._readers.get(tensor, [])
            if self._content.get(tensor) == "int8":
                return tensor
            if tensor in self._ends or not readers:
                return ""
            if all(reader.op_type == "QuantizeLinear" for reader in readers):
                return str(readers[0].output[0])
            if len(readers) > 1 or readers[0].op_type not in ACTIVATIONS:
                return ""
            tensor = readers[0].output[0]
        return ""

    def _read_formats(self, node: onnx.NodeProto) -> None:
        """A constant's format is its reader's own: two nodes may read the same bytes at two scales."""
        for name, scale in stated(node, self._constants):
            if name not in self._constants:
                self._give(self.resolve(name), scale)
            elif node.op_type == "DequantizeLinear":
                self._give(node.output[0], scale)

    def _give(self, tensor: str, scale: Scale) -> None:
        known = self._formats.get(tensor, ())
        if scale not in known:
            self._formats[tensor] = (*known, scale)
