"""Run INT8 operators that add exactly, also on processors whose fast kernels do not.

x86 processors without VNNI multiply unsigned activations by signed weights and add neighbouring
products in saturating int16 (`vpmaddubsw`). Values beyond the range are clipped silently, which
gives other numbers than the DPU's. On such processors a session computes each operator in the
fastest way that is proven exact, chosen when the file is opened:

1. SIGNED: weights are not changed, because no two neighbouring products can leave int16, for any
   activations. a. A tensor behind a ReLU is stored as 128..255 around 128. Moved down to 0..127
   around 0, no weights saturate. b. Otherwise all pairs of weights that a kernel may form are
   checked.
2. UNSIGNED: weights are stored as uint8, 128 higher and around 128. These kernels add in int32, at
   half the speed.
3. CONVERTED: the same for signed activations, which are converted to uint8 before the operator, and
   back behind it.

Each is the same sum of the same integers, so the results are those of an exact processor, bit for
bit. Float operators between 8-bit tensors (QDQ), of which onnxruntime makes integer ones, are
checked as those integer operators.
"""

import hashlib
from abc import ABC, abstractmethod
from collections import defaultdict
from copy import deepcopy
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from beers_deploy.profiles.errors import ModelError, printable
from beers_deploy.quant.domains import opset_of
from beers_deploy.quant.onnx.graph import constants

INT16_MAX = 32767
INT16_MIN = -32768
MIDDLE = 128
UINT8_MAX = 255


class Way(StrEnum):
    """The way in which an operator is computed if the fast kernels saturate."""

    signed = "int8 weights, proven not to saturate"
    unsigned = "uint8 weights"
    converted = "uint8 weights and activations"


@dataclass(frozen=True)
class Places:
    """The inputs at which an operator has its activations' zero point, its weights, their zero
    point and the zero point of its result.
    """

    zero: int
    weight: int
    weight_zero: int
    result_zero: int | None


OPERATORS = {
    "QLinearConv": Places(2, 3, 5, 7),
    "QLinearMatMul": Places(2, 3, 5, 7),
    "ConvInteger": Places(2, 1, 3, None),
    "MatMulInteger": Places(2, 1, 3, None),
}
"""ONNX's operators whose kernels multiply 8-bit numbers.

Activations are the first input; a None result is int32.
"""

FLOAT_OPERATORS = {"Conv": "QLinearConv", "MatMul": "QLinearMatMul", "Gemm": "QLinearMatMul"}
"""Operators on dequantised tensors (QDQ), and the integer operator that
onnxruntime makes of each.
"""

REQUANTISING = {"QLinearConv": 7, "QLinearAdd": 7}
"""Operators whose result may be stored 128 lower if a ReLU follows, and the input that holds the
zero point of that result.
"""


class _Rewriting(ABC):
    """A copy of a model whose nodes are replaced one by one, and its constants."""

    def __init__(self, model: onnx.ModelProto) -> None:
        self.model = deepcopy(model)
        self.arrays = constants(model)

    @abstractmethod
    def around(self, node: onnx.NodeProto) -> list[onnx.NodeProto]:
        """Return the nodes that replace a node."""

    def rewritten(self) -> onnx.ModelProto:
        """Replace every node, and return the model."""
        nodes = list(chain.from_iterable(map(self.around, self.model.graph.node)))
        del self.model.graph.node[:]
        self.model.graph.node.extend(nodes)
        return self.model

    def constant(self, value: np.ndarray | np.generic, name: str = "") -> str:
        """Return the name of a constant that holds this value; equal values share one unless they
        are named.
        """
        array = np.asarray(value)
        if not name:
            digest = hashlib.sha256(array.tobytes()).hexdigest()[:16]
            name = f"exact.{array.dtype}.{'x'.join(map(str, array.shape))}.{digest}"
        if name not in self.arrays:
            self.arrays[name] = array
            self.model.graph.initializer.append(numpy_helper.from_array(array, name))
        return name


def made_exact(model: onnx.ModelProto) -> tuple[onnx.ModelProto, dict[str, Way]]:
    """Return the model with the same results on kernels that add exactly, and the way of each
    operator by its name.
    """
    work = _Exact(model)
    for relu in [node for node in work.model.graph.node if node.op_type == "Max"]:
        work.move_relu_down(relu)
    return work.rewritten(), work.ways


def cannot_saturate(kind: str, weight: np.ndarray, largest: int) -> bool:
    """Return True if no pair of neighbouring products can leave int16.

    This holds for any activations from 0 to `largest`.

    Args:
        kind: the ONNX operator.
        weight: int8, (O, I, kh, kw) of a convolution, (..., I, O) of a product of matrices.
        largest: the largest activation as it is stored.
    """
    rows = _rows(kind, weight)
    # Pairs begin at even places. Where an odd number of channels lets them straddle taps, all
    # neighbours count.
    step = 2 if kind == "QLinearConv" and weight.shape[1] % 2 == 0 else 1
    first = rows[:, :-1:step]
    second = rows[:, 1::step]
    highest = np.maximum(first, 0) + np.maximum(second, 0)
    lowest = np.minimum(first, 0) + np.minimum(second, 0)
    return bool((largest * highest <= INT16_MAX).all() and (largest * lowest >= INT16_MIN).all())


def _rows(kind: str, weight: np.ndarray) -> np.ndarray:
    """Return the weights of each result in the order of the sum, (O, terms) int64."""
    # A convolution's kernels add over the channels of a tap, then tap by tap.
    if kind == "QLinearConv":
        ordered = np.moveaxis(weight.reshape(*weight.shape[:2], -1), 1, 2)
    else:
        ordered = weight if kind == "ConvInteger" else np.moveaxis(weight, -1, 0)
    return ordered.reshape(len(ordered), -1).astype(np.int64)


class _Exact(_Rewriting):
    """Computes each operator in a way that adds exactly."""

    def __init__(self, model: onnx.ModelProto) -> None:
        super().__init__(model)
        self.ways = dict[str, Way]()
        self.writers: dict[str, onnx.NodeProto] = {}
        self.readers: dict[str, list[onnx.NodeProto]] = defaultdict(list)
        for node in self.model.graph.node:
            self.writers.update((name, node) for name in node.output)
            for name in node.input:
                self.readers[name].append(node)
        self.outputs = {value.name for value in self.model.graph.output}
        self.largest: dict[str, int] = {}
        self.moved: set[str] = set()

    def move_relu_down(self, relu: onnx.NodeProto) -> None:
        """Store the result of a ReLU, max(result, its zero point), around 0: the result is moved
        down, and the ReLU becomes a Min.

        Nothing is changed if another operator than those above reads the tensor.
        """
        source = relu.input[0]
        result = relu.output[0]
        middle = self.arrays.get(relu.input[1]) if len(relu.input) == 2 else None
        writer = self.writers.get(source)
        if middle is None or middle.dtype != np.uint8 or middle.size != 1 or writer is None:
            return
        if len(self.readers[source]) != 1 or self.outputs & {source, result}:
            return
        place = REQUANTISING.get(writer.op_type)
        if place is None or not self._holds(writer, place, middle):
            return
        readers = self.readers[result]
        if not all(self._reads(node, result, middle) for node in readers):
            return
        # With a zero point of 0 the writer clips at 0 itself, which is the ReLU. What remains is
        # the upper end: 255 around the old zero point is 255 - middle around 0.
        zero = self.constant(np.uint8(0))
        self.largest[result] = UINT8_MAX - int(middle.ravel()[0])
        writer.input[place] = zero
        relu.op_type = "Min"
        relu.input[1] = self.constant(np.uint8(self.largest[result]))
        for reader in readers:
            reader.input[OPERATORS[reader.op_type].zero] = zero

    def _reads(self, node: onnx.NodeProto, name: str, zero: np.ndarray) -> bool:
        """Return True if an operator reads the tensor as activations around this zero point."""
        places = OPERATORS.get(node.op_type)
        return (
            places is not None
            and list(node.input).count(name) == 1
            and self._holds(node, places.zero, zero)
        )

    def _holds(self, node: onnx.NodeProto, place: int, value: np.ndarray) -> bool:
        constant = self.arrays.get(node.input[place]) if place < len(node.input) else None
        return (
            constant is not None
            and constant.dtype == value.dtype
            and constant.ravel().tolist() == value.ravel().tolist()
        )

    def around(self, node: onnx.NodeProto) -> list[onnx.NodeProto]:
        """Return the node computed in an exact way, with the conversions before and behind it."""
        if node.op_type in FLOAT_OPERATORS:
            return self._between(node)
        places = OPERATORS.get(node.op_type)
        if places is None:
            return [node]
        weight = self.arrays.get(node.input[places.weight])
        if weight is None:
            name = printable(repr(node.name or node.output[0]))
            raise ModelError(
                f"{node.op_type} {name} in the INT8 network has computed weights, but this "
                "processor needs constant ones. Store them as constants, or run the network on a "
                "processor with VNNI."
            )
        if weight.dtype != np.int8:
            return [node]
        name = node.name or node.output[0]
        if cannot_saturate(node.op_type, weight, self.largest.get(node.input[0], UINT8_MAX)):
            self.ways[name] = Way.signed
            return [node]
        self._lift(node, places.weight, places.weight_zero)
        zero = self.arrays.get(node.input[places.zero])
        signed = zero is not None and zero.dtype == np.int8
        self.ways[name] = Way.converted if signed else Way.unsigned
        return self._converted(node, places) if signed else [node]

    def _between(self, node: onnx.NodeProto) -> list[onnx.NodeProto]:
        """Return a float operator on dequantised weights, after the nodes that dequantise uint8
        ones.
        """
        source = self.writers.get(node.input[1])
        weight = (
            self.arrays.get(source.input[0])
            if source and source.op_type == "DequantizeLinear"
            else None
        )
        if source is None or weight is None or weight.dtype != np.int8:
            return [node]
        if any(attribute.name == "transB" and attribute.i for attribute in node.attribute):
            weight = weight.T
        if cannot_saturate(FLOAT_OPERATORS[node.op_type], weight, UINT8_MAX):
            self.ways[node.name or node.output[0]] = Way.signed
            return [node]
        self.ways[node.name or node.output[0]] = Way.unsigned
        # A copy, because another node may read the same weights as int8.
        lifted = deepcopy(source)
        self._lift(lifted, 0, 2)
        name = f"{node.output[0]}.weight_from_uint8"
        lifted.name = name
        lifted.output[0] = name
        node.input[1] = name
        return [lifted, node]

    def _lift(self, node: onnx.NodeProto, *places: int) -> None:
        """Store int8 constants as uint8, 128 higher."""
        for place in places:
            node.input.extend([""] * (place + 1 - len(node.input)))
            # A missing zero point is 0.
            value = self.arrays.get(node.input[place], np.zeros((), np.int8))
            # The sum is formed in int16, because int8 wraps around above 127.
            node.input[place] = self.constant((value.astype(np.int16) + MIDDLE).astype(np.uint8))

    def _converted(self, node: onnx.NodeProto, places: Places) -> list[onnx.NodeProto]:
        """Return the node on uint8 activations, between the nodes that convert these and its
        result.
        """
        self._lift(node, places.zero)
        before, node.input[0] = self._moved(node.input[0], MIDDLE, TensorProto.UINT8)
        if places.result_zero is None:
            return [*before, node]
        self._lift(node, places.result_zero)
        result = node.output[0]
        node.output[0] = f"{result}.unsigned"
        self.moved.add(node.output[0])
        behind, _ = self._moved(node.output[0], -MIDDLE, TensorProto.INT8, result)
        return [*before, node, *behind]

    def _moved(
        self, source: str, by: int, kind: int, result: str = ""
    ) -> tuple[list[onnx.NodeProto], str]:
        """Return the node that converts an 8-bit tensor to another 8-bit type, once for all its
        readers.
        """
        result = result or f"{source}.unsigned"
        if result in self.moved:
            return [], result
        wide = f"{result}.wide"
        # ONNX's Add of 8-bit integers would wrap around, so the sum is formed in int32.
        total = f"{result}.moved"
        nodes = [
            helper.make_node("Cast", [source], [wide], name=wide, to=TensorProto.INT32),
            helper.make_node("Add", [wide, self.constant(np.int32(by))], [total], name=total),
            helper.make_node("Cast", [total], [result], name=f"{result}.cast", to=kind),
        ]
        self.moved.add(result)
        return nodes, result


# On onnxruntime's integer kernels two output channels took four times as long as sixteen.
FEWEST_OUTPUTS = 16
INPUTS_OF = 4
FIRST_OPSET = 11
"""The first opset in which Pad and Slice have their positions as inputs."""


def filled(model: onnx.ModelProto) -> onnx.ModelProto:
    """Return the model with the same results, its integer convolutions no narrower than suits
    onnxruntime.
    """
    if opset_of(model) < FIRST_OPSET:
        return model
    return _ChannelPadding(model).rewritten()


class _ChannelPadding(_Rewriting):
    """Widens narrow convolutions; convolutions may share a widened input."""

    def __init__(self, model: onnx.ModelProto) -> None:
        super().__init__(model)
        self.wide_inputs = set[str]()

    def around(self, node: onnx.NodeProto) -> list[onnx.NodeProto]:
        """Return the node, and the nodes that widen its input and narrow its output."""
        weight = self.arrays.get(node.input[3]) if node.op_type == "QLinearConv" else None
        if weight is None or weight.ndim != 4 or not self._takes_zeros(node):
            return [node]
        outputs, inputs = weight.shape[:2]
        more_inputs = -inputs % INPUTS_OF if inputs < FEWEST_OUTPUTS else 0
        more_outputs = max(FEWEST_OUTPUTS - outputs, 0)
        if not more_inputs and not more_outputs:
            return [node]
        self._widen(node, more_outputs, more_inputs)
        before = self._padded(node, more_inputs) if more_inputs else []
        return [*before, node, *(self._cut(node, outputs) if more_outputs else [])]

    def _takes_zeros(self, node: onnx.NodeProto) -> bool:
        """Return True if a stored 0 is a weight of 0, and each output reads every input."""
        middle = self.arrays.get(node.input[5])
        grouped = any(
            attribute.name == "group" and attribute.i != 1 for attribute in node.attribute
        )
        return middle is not None and not middle.any() and not grouped

    def _widen(self, node: onnx.NodeProto, outputs: int, inputs: int) -> None:
        """Pad the weights with zeros, and extend scales and zero points per channel, which have no
        effect there.
        """
        name = node.output[0]
        weight = self.arrays[node.input[3]]
        padded_weight = np.pad(weight, [(0, outputs), (0, inputs), (0, 0), (0, 0)])
        # These inputs are scale and zero point of the weights, and the bias.
        for place in (4, 5, 8):
            value = self.arrays.get(node.input[place]) if place < len(node.input) else None
            if value is not None and value.shape == (len(weight),) and outputs:
                widened = np.pad(value, (0, outputs), mode="edge")
                node.input[place] = self.constant(widened, f"{name}.filled.{place}")
        node.input[3] = self.constant(padded_weight, f"{name}.filled.weight")

    def _padded(self, node: onnx.NodeProto, count: int) -> list[onnx.NodeProto]:
        source = node.input[0]
        node.input[0] = f"{source}.padded"
        if source in self.wide_inputs:
            return []
        self.wide_inputs.add(source)
        pads = self.constant(np.array([0, 0, 0, 0, 0, count, 0, 0]))
        return [
            helper.make_node("Pad", [source, pads], [f"{source}.padded"], name=f"{source}.padded")
        ]

    def _cut(self, node: onnx.NodeProto, count: int) -> list[onnx.NodeProto]:
        name = node.output[0]
        node.output[0] = f"{name}.filled"
        places = [self.constant(np.array([place])) for place in (0, count, 1)]
        feeds = [f"{name}.filled", *places]
        return [helper.make_node("Slice", feeds, [name], name=f"{name}.cut")]
