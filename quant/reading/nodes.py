"""The nodes of a network while they are rewritten: who writes and reads what, and the numbers they
hold.
"""

from collections import Counter, defaultdict
from collections.abc import Callable
from itertools import chain
from typing import Any

import numpy as np
import onnx
from onnx import NodeProto, TensorProto, helper, numpy_helper, shape_inference

LINEAR = {"Conv", "ConvTranspose"}

Shapes = dict[str, tuple[int, ...]]


def shapes_of(model: onnx.ModelProto) -> Shapes:
    """The sizes of each float32 tensor whose rank is known, 0 for a size that is not; none where
    sizes differ.
    """
    try:
        values = shape_inference.infer_shapes(model).graph
    except shape_inference.InferenceError:
        return {}
    types = {
        v.name: v.type.tensor_type for v in (*values.input, *values.value_info, *values.output)
    }
    floats = {
        n: t for n, t in types.items() if t.elem_type == TensorProto.FLOAT and t.HasField("shape")
    }
    return {name: tuple(d.dim_value for d in t.shape.dim) for name, t in floats.items()}


class Nodes:
    """The nodes in order, and who writes and reads what."""

    def __init__(self, graph: onnx.GraphProto) -> None:
        self._graph = graph
        self.nodes = list(graph.node)
        self.constants = {tensor.name: tensor for tensor in graph.initializer}
        self.ends = [value.name for value in graph.output]
        names = list(self.constants)
        for node in graph.node:
            names += [*node.input, *node.output]
        self._name_counts = dict.fromkeys(names, 0)
        self._find()

    def _find(self) -> None:
        self.reads = Counter(chain.from_iterable(node.input for node in self.nodes))
        self.reads.update(self.ends)
        self.writers: dict[str, NodeProto] = {}
        for node in self.nodes:
            # A result that is left out has an empty name, which nobody may read.
            self.writers.update((name, node) for name in node.output if name)

    def pass_over(self, step: "Step") -> None:
        """Each node replaced by what `step(graph, node)` gives for it, in order; None leaves it as
        it is.
        """
        nodes: list[NodeProto] = []
        for node in self.nodes:
            replacement = step(self, node)
            new_nodes = [node] if replacement is None else replacement
            # At once, because the step looks up the writers of what later nodes read.
            for new in new_nodes:
                self.writers.update((name, new) for name in new.output if name)
            nodes.extend(new_nodes)
        self.nodes = nodes
        self._find()

    def write(self) -> None:
        """Put the nodes that lead to an output, and the constants, into the graph."""
        needed = set(self.ends)
        nodes = list[NodeProto]()
        # Backwards, because a node is needed only where something behind it reads its result.
        for node in reversed(self.nodes):
            if needed.intersection(node.output):
                needed.update(node.input)
                nodes.append(NodeProto.FromString(node.SerializeToString()))
        self.nodes = nodes[::-1]
        del self._graph.node[:]
        self._graph.node.extend(self.nodes)
        names = {tensor.name for tensor in self._graph.initializer}
        self._graph.initializer.extend(t for name, t in self.constants.items() if name not in names)
        self._find()

    def value(self, name: str) -> np.ndarray | None:
        """As `array`, in float64."""
        value = self.array(name)
        return None if value is None else value.astype(np.float64)

    def array(self, name: str) -> np.ndarray | None:
        """A constant of float32 as it is, None where it is none."""
        tensor = self.constants.get(name)
        if tensor is None or tensor.data_type != TensorProto.FLOAT:
            return None
        return numpy_helper.to_array(tensor)

    def integers(self, name: str) -> list[int] | None:
        """A constant list of whole numbers, None where it is none."""
        tensor = self.constants.get(name)
        if tensor is None:
            return None
        return [int(size) for size in numpy_helper.to_array(tensor).ravel()]

    def keep(self, name: str, value: np.ndarray) -> str:
        """Note a constant as float32 under a name that is free, and return it."""
        name = fresh(name, self._name_counts)
        self.constants[name] = numpy_helper.from_array(value.astype(np.float32), name)
        return name

    def rename(self, result: str, name: str) -> None:
        """Let a result have the name of the one that it takes the place of."""
        writer = self.writers[result]
        self.writers[name] = writer
        writer.output[list(writer.output).index(result)] = name

    def sole_writer(self, name: str) -> NodeProto | None:
        """The node that writes a tensor which one node alone reads."""
        return self.writers.get(name) if self.reads[name] == 1 else None

    def readers(self) -> dict[str, list[NodeProto]]:
        """Return the nodes that read each tensor, in order, each of them once."""
        readers: dict[str, list[NodeProto]] = defaultdict(list)
        for node in self.nodes:
            for name in dict.fromkeys(node.input):
                readers[name].append(node)
        return readers

    def is_linear(self, node: NodeProto | None) -> bool:
        """Whether it is a convolution of images, transposed or not, of weights and bias that the
        file holds.
        """
        if node is None or node.op_type not in LINEAR:
            return False
        numbers = [self.constants.get(name) for name in node.input[1:] if name]
        sound = all(t is not None and t.data_type == TensorProto.FLOAT for t in numbers)
        return bool(numbers) and sound and len(self.constants[node.input[1]].dims) == 4

    def width(self, node: NodeProto) -> int:
        """The channels that a convolution writes."""
        dims = self.constants[node.input[1]].dims
        if node.op_type == "Conv":
            return int(dims[0])
        # A transposed convolution has weights (I, O / groups, kh, kw).
        return int(dims[1] * attributes_of(node).get("group", 1))


def fresh(name: str, taken: dict[str, int]) -> str:
    """Return the name, or one like it that is free, and note it.

    Args:
        name: that is wanted.
        taken: of each name how many others were derived from it, so that a thousand nodes of one
            name do not try each other's.
    """
    candidate = name
    while candidate in taken:
        taken[name] += 1
        candidate = f"{name}_{taken[name] if taken[name] > 1 else ''}"
    taken[candidate] = 0
    return candidate


Step = Callable[[Nodes, NodeProto], list[NodeProto] | None]


def attributes_of(node: NodeProto) -> dict[str, Any]:
    """The attributes that a node states, by name, text as such."""
    values = {a.name: helper.get_attribute_value(a) for a in node.attribute}
    return {k: v.decode(errors="replace") if isinstance(v, bytes) else v for k, v in values.items()}
