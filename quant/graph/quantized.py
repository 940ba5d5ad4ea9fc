"""Determine which nodes of a file compute on integers, with which scales, and which nodes are mere
notation.

A tensor holds one of four kinds of values. They are float numbers that the host computes with, or
"int8", written by QuantizeLinear, a cast or an integer kernel (or the same numbers as uint8 around
128). They may also be int8 "seen" as float, behind DequantizeLinear, or a "wide" sum of products of
such, on its way to a QuantizeLinear.
"""

import math
from collections.abc import Container, Iterator
from dataclasses import dataclass

import numpy as np
from onnx import TensorProto, helper

from beers_deploy.quant.onnx.graph import WEIGHTS, Node, OnnxGraph

RESULT = -1
ONE = {0: (1, 2), RESULT: (3, 4)}
TWO = {0: (1, 2), 3: (4, 5), RESULT: (6, 7)}
FORMATS: dict[str, dict[int, tuple[int, int]]] = {
    **dict.fromkeys(("QLinearConv", "QLinearMatMul", "QLinearAdd", "QLinearMul"), TWO),
    **dict.fromkeys(("QLinearAveragePool", "QLinearGlobalAveragePool", "QLinearLeakyRelu"), ONE),
    "QuantizeLinear": {RESULT: (1, 2)},
    "DequantizeLinear": {0: (1, 2)},
}
"""The inputs at which an operator names scale and zero point of input i, or of its result."""


@dataclass(frozen=True)
class Scale:
    """The number format of a quantised tensor: value = scale * (q - zero_point) for the stored
    integer q.

    Attributes:
        scales: one scale, or one for each channel.
        zero_points: one zero point, or one for each channel.
        integer_type: the NumPy name of the type of q, such as "int8".
    """

    scales: tuple[float, ...]
    zero_points: tuple[int, ...]
    integer_type: str

    @property
    def symmetric(self) -> bool:
        """True if zero represents zero: int8 around 0, or the same numbers as uint8 around 128."""
        middle = 128 if self.integer_type == "uint8" else 0
        return self.integer_type in ("int8", "uint8", "int32") and set(self.zero_points) == {middle}

    @property
    def frac_bits(self) -> int | None:
        """The number n of fractional bits of a single scale 2^-n; None for any other scale."""
        if len(self.scales) != 1:
            return None
        # `frexp` splits off a fraction in [0.5, 1), which of a power of two is exactly 0.5.
        fraction, exponent = math.frexp(self.scales[0])
        return 1 - exponent if fraction == 0.5 else None


def stated(graph: OnnxGraph, node: Node) -> Iterator[tuple[str, Scale]]:
    """Yield the tensors whose number format a node states, each with that format.

    A QuantizeLinear, for example, states that of its result. Constants such as weights are
    included.

    Args:
        graph: the graph that the node belongs to, which knows the constants.
        node: a node of the file.
    """
    places = FORMATS.get(node.op_type, {})
    if node.op_type == "QLinearConcat":
        places = {RESULT: (0, 1)} | {i: (i + 1, i + 2) for i in range(2, len(node.inputs), 3)}
    for place, (scale, zero_point) in places.items():
        name = node.result if place == RESULT else node.inputs[place]
        scales = graph.constants.get(node.inputs[scale], np.zeros(0))
        zeros = graph.value(node, zero_point)
        # A missing zero point is 0. Its type is that of the constant, that of `output_dtype`, or
        # ONNX's default, which is uint8.
        if zeros is None:
            output_dtype = node.attribute("output_dtype") or TensorProto.UINT8
            dtype = helper.tensor_dtype_to_np_dtype(output_dtype)
            if name in graph.constants:
                dtype = graph.constants[name].dtype
            zeros = np.zeros(1, dtype)
        values = tuple(scales.astype(float).ravel())
        yield name, Scale(values, tuple(map(int, zeros.ravel())), str(zeros.dtype))


BYTES = (TensorProto.INT8, TensorProto.UINT8)
ACTIVATIONS = {"Relu", "LeakyRelu", "PRelu", "HardSigmoid", "HardSwish", "Clip"}
OPERANDS = {
    **dict.fromkeys(("QuantizeLinear", "DequantizeLinear"), slice(0, 1)),
    **dict.fromkeys(("QLinearAdd", "QLinearMul"), slice(0, 4, 3)),
    "QLinearConcat": slice(2, None, 3),
}
"""The inputs that are tensors of the network; the others are scales and zero points."""
ELEMENTWISE = {"Add", "Mul", "Concat", "QLinearAdd", "QLinearMul", "QLinearConcat"}
"""Operators whose constant operands are numbers of the network."""


class Integers:
    """Tells which nodes of a file compute on integers, and in which number formats.

    The checker and the gate ask it about files of any quantiser, with integer kernels or QDQ. Some
    nodes are notation only: they define how integers are read, and compute nothing.
    """

    def __init__(self, graph: OnnxGraph) -> None:
        self.present = any(node.op_type in FORMATS for node in graph.nodes)
        self._graph = graph
        self._constants = graph.constants
        self._results = frozenset(graph.outputs)
        self._int8 = {name for name, kind in graph.types.items() if kind in BYTES}
        self._wide: set[str] = set()
        # Int8 tensors seen as float, and the int8 tensor that each of them is.
        self._dequantised: dict[str, str] = {}
        # Notation, and the tensor that it stands for.
        self._same: dict[str, str] = {}
        # The writer's format first, then whatever contradicts it.
        self._formats: dict[str, tuple[Scale, ...]] = {}
        self._becomes = self._rounded()
        for node in graph.nodes:
            # The format of a constant is that of its reader, because two nodes may read the same
            # bytes at two scales.
            for name, scale in stated(graph, node):
                if name not in self._constants:
                    self._give(self.resolve(name), scale)
                elif node.op_type == "DequantizeLinear":
                    self._give(node.result, scale)
            self._follow(node)

    def resolve(self, name: str) -> str:
        """Return the tensor whose values a tensor has, once nodes that compute nothing (notation)
        are removed.

        Args:
            name: the name of a tensor, which is returned itself if no such node writes it.
        """
        while name in self._same:
            name = self._same[name]
        return name

    def constant(self, name: str) -> np.ndarray | None:
        """Return a constant in the integers that the file stores, also if a node dequantises them.

        Args:
            name: the name of a tensor.

        Returns:
            The constant; None for a tensor that nodes compute.
        """
        return self._constants.get(self.resolve(name))

    def weight(self, node: Node) -> np.ndarray | None:
        """Return the weights of a convolution in the integers that the file stores.

        Args:
            node: a node of the file.

        Returns:
            The weights; None if the node has none, or if other nodes compute them.
        """
        place = WEIGHTS.get(node.op_type, len(node.inputs))
        return self.constant(node.inputs[place]) if place < len(node.inputs) else None

    def is_integer(self, node: Node) -> bool:
        """Return True if the file computes a node on integers, by integer kernels or between Q/DQ
        nodes.
        """
        return node.result in self._int8 or node.result in self._wide

    def is_notation(self, node: Node) -> bool:
        """Return True if a node computes nothing, and only defines how the integers that it reads
        are interpreted.

        A DequantizeLinear in front of an integer operation is an example.
        """
        result = node.result
        if node.op_type == "DequantizeLinear" and result not in self._same:
            readers = self._graph.readers.get(result, [])
            return result not in self._results and all(map(self.is_integer, readers))
        return result in self._same

    def activations(self, node: Node) -> tuple[str, ...]:
        """Return the names of the tensors that a node reads from other operations of the network.

        Constants, scales and zero points are left out, and notation is skipped as in `resolve`.
        """
        names = [name for name in self._operands(node) if name]
        if self.is_integer(node) and node.op_type != "QuantizeLinear":
            names = [self._dequantised.get(name, name) for name in names]
        return tuple(name for name in map(self.resolve, names) if name not in self._constants)

    def operand(self, node: Node) -> np.ndarray | None:
        """Return the first constant among a node's operands, in the integers that the file stores;
        None without one.
        """
        constants = (self.constant(name) for name in self._operands(node))
        return next((value for value in constants if value is not None), None)

    def formats(self, node: Node) -> dict[str, tuple[Scale, ...]]:
        """Return the number formats of the tensors that a node reads and writes.

        Args:
            node: a node of the file.

        Returns:
            A dict from the tensor's role to its formats. Roles are "input 0", "input 1" and so on,
            "weight", "bias", "constant 1" and "output". If the file contradicts itself, a tensor
            has several formats, that of its writer first. It has none if the file states none.
        """
        formats = {}
        if self.is_integer(node):
            tensors = {f"input {i}": name for i, name in enumerate(self.activations(node))}
            result = node.result
            tensors["output"] = result if result in self._int8 else self._becomes[result]
            for role, name in tensors.items():
                formats[role] = self._formats.get(self.resolve(name), ())
        stated_scales = dict(stated(self._graph, node))
        for role, name in self._numbers(node).items():
            stored = self._formats.get(name, ())
            formats[role] = (stated_scales[name],) if name in stated_scales else stored
        return formats

    def numbers(self, node: Node) -> dict[str, np.ndarray | None]:
        """Return the constants that a node reads, in the integers that the file stores.

        Args:
            node: a node of the file.

        Returns:
            A dict from a role as in `formats` to the constant, or to None if other nodes compute
            it.
        """
        return {role: self.constant(name) for role, name in self._numbers(node).items()}

    def _operands(self, node: Node) -> tuple[str, ...]:
        default = slice(0, 1) if node.op_type.startswith("QLinear") else slice(None)
        return node.inputs[OPERANDS.get(node.op_type, default)]

    def _numbers(self, node: Node) -> dict[str, str]:
        """Return the names of an integer node's operands other than activations, by role."""
        names: dict[str, str] = {}
        if not self.is_integer(node):
            return names
        if node.op_type in ("Conv", "ConvTranspose", "QLinearConv"):
            numbers = node.inputs[1:]
            # A QLinearConv has scales and zero points between its input, weights and bias.
            if node.op_type == "QLinearConv":
                numbers = (node.inputs[3], *node.inputs[8:])
            names = dict(zip(("weight", "bias"), numbers, strict=False))
        elif node.op_type in ELEMENTWISE:
            operands = enumerate(self._operands(node))
            names = {
                f"constant {i}": name for i, name in operands if self.constant(name) is not None
            }
        return {role: name for role, name in names.items() if name}

    def _follow(self, node: Node) -> None:
        """Determine the kind of a node's results from the kinds of its inputs."""
        source = node.source
        result = node.result
        if node.op_type == "Cast":
            writes_int8 = node.attribute("to") in BYTES
        else:
            rounds = node.op_type in FORMATS or node.op_type == "QLinearConcat"
            writes_int8 = rounds or self._reads(node, self._int8)
        if node.op_type == "DequantizeLinear":
            aliases = self._dequantised if self.constant(source) is None else self._same
            # This is done at once, because otherwise each reader would follow a chain of aliases
            # again.
            aliases[result] = self.resolve(source)
        elif node.op_type == "QuantizeLinear" and source in self._wide:
            self._int8.add(result)
            self._same[result] = self.resolve(source)
            self._give(source, self._formats[result][0])
        elif writes_int8:
            self._int8.update(node.outputs)
            if result not in self._formats and source in self._formats:
                self._give(result, self._formats[source][0])
        elif (
            node.op_type != "Cast"
            and result in self._becomes
            and self._reads(node, self._wide, self._dequantised)
        ):
            self._wide.update(node.outputs)

    def _reads(self, node: Node, *tensors: Container[str]) -> bool:
        """Return True if a node reads at least one tensor, and all of its tensors are in the
        groups.

        Constants are ignored.
        """
        resolved = map(self.resolve, filter(None, node.inputs))
        names = [name for name in resolved if name not in self._constants]
        return bool(names) and all(any(name in group for group in tensors) for name in names)

    def _rounded(self) -> dict[str, str]:
        """Map each tensor to the int8 tensor to which it is rounded next, directly or behind
        activations.
        """
        int8_names = {}
        for node in reversed(self._graph.nodes):
            readers = self._graph.readers.get(node.result, [])
            kinds = {reader.op_type for reader in readers}
            if node.result in self._results or not kinds:
                continue
            if kinds == {"QuantizeLinear"}:
                int8_names[node.result] = readers[0].result
            elif len(readers) == 1 and kinds <= ACTIVATIONS and readers[0].result in int8_names:
                int8_names[node.result] = int8_names[readers[0].result]
        return int8_names

    def _give(self, tensor: str, scale: Scale) -> None:
        scales = self._formats.get(tensor, ())
        if scale not in scales:
            self._formats[tensor] = (*scales, scale)
