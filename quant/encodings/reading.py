"""An INT8 file of the legal regime read back: its core as numbers to reason about, and whether it says what they ask.

A file describes its operations in its metadata, without weights and scales: those are its nodes' own. What is read is
written again, so that any node or constant which differs from what the numbers ask for is a fault.
"""

import numpy as np
import onnx

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.encodings.description import KEY, described_core
from beers_deploy.quant.encodings.host import host_model
from beers_deploy.quant.ends import ZERO, Ends
from beers_deploy.quant.graph import CORRECTION, PLANES, Activation, Add, Op, Window
from beers_deploy.quant.onnx_file import constants, fixed_tile_px, metadata
from beers_deploy.quant.untrusted import contradictions


def read_core(model: onnx.ModelProto) -> IntCore:
    """The core of an INT8 file of the legal regime, its int32 bias at the accumulator's own scale.

    Raises:
        ModelError: another encoding, float scales, or asymmetric numbers.
    """
    said = metadata(model).get(KEY)
    if said is not None:
        with contradictions("INT8 model"):
            return described_core(said, constants(model))
    reader = _Reader(model)
    for node in model.graph.node:
        if node.op_type == "QLinearConv":
            reader.conv(node)
        elif node.op_type == "QLinearAdd":
            reader.add(node)
        elif node.op_type == "Max":
            reader.relu(node)
    if not reader.ops or PLANES not in reader.frac_bits or CORRECTION not in reader.frac_bits:
        raise _refuse("no such core")
    first, last = reader.ops[0], reader.ops[-1]
    if not (isinstance(first, IntConv) and isinstance(last, IntConv)):
        raise _refuse("ends that are no convolutions")
    ends = Ends(planes=first.weight.shape[1], gains=len(last.weight))
    return IntCore(tuple(reader.ops), reader.frac_bits, ends)


def encoding_faults(model: onnx.ModelProto) -> list[str] | None:
    """Where a file of the legal regime is not what its integers ask for: the host's ends, ReLUs, a reader's scale.

    None for files of others.

    Raises:
        ModelError: nodes that contradict it.
    """
    with contradictions("INT8 model"):
        return _encoding_faults(model)


def _encoding_faults(model: onnx.ModelProto) -> list[str] | None:
    ours = metadata(model).get("precision") == "int8 legal"
    try:
        core = read_core(model)
    except ModelError as error:
        return [error.got] if ours else None
    meant, faults = host_model(core, {}, fixed_tile_px(model)).graph, []
    for kind, found, wanted in (
        ("constant", model.graph.initializer, meant.initializer),
        ("node", model.graph.node, meant.node),
    ):
        faults += [f"{kind} {a.name}" for a, b in zip(found, wanted, strict=False) if a != b]
        faults += [f"{len(found)} {kind}s instead of {len(wanted)}"] if len(found) != len(wanted) else []
    return faults


class _Reader:
    """Collects operations and scales."""

    def __init__(self, model: onnx.ModelProto) -> None:
        self._values = constants(model)
        self.ops: list[IntConv | Op] = []
        self.frac_bits: dict[str, int] = {}

    def conv(self, node: onnx.NodeProto) -> None:
        source, *_, bias = node.input
        weight, frac_bits = self._value(node.input[3]), self._frac_bits(node.input[4], node.input[5], 0)
        self.frac_bits[source] = self._frac_bits(node.input[1], node.input[2], ZERO)
        self.frac_bits[node.output[0]] = self._frac_bits(node.input[6], node.input[7], ZERO)
        whole, product = self._value(bias).astype(np.int64), frac_bits + self.frac_bits[source]
        edge = weight.shape[2] // 2
        numbers = weight, frac_bits, whole, product, Activation.none, Window(pads=(edge,) * 4)
        self.ops.append(IntConv(node.name, source, node.output[0], *numbers))

    def add(self, node: onnx.NodeProto) -> None:
        for name, scale, zero in ((node.input[0], 1, 2), (node.input[3], 4, 5), (node.output[0], 6, 7)):
            self.frac_bits[name] = self._frac_bits(node.input[scale], node.input[zero], ZERO)
        self.ops.append(Add(node.name, (node.input[0], node.input[3]), node.output[0]))

    def relu(self, node: onnx.NodeProto) -> None:
        """The larger of a value and the zero point; it becomes part of the convolution."""
        last = self.ops[-1] if self.ops else None
        if not isinstance(last, IntConv) or last.output != node.input[0]:
            return
        self.ops[-1] = IntConv(**{**vars(last), "output": node.output[0], "activation": Activation.relu})
        self.frac_bits[node.output[0]] = self.frac_bits.pop(last.output)

    def _value(self, name: str) -> np.ndarray:
        if name not in self._values:
            raise _refuse(f"no constant {name}")
        return self._values[name]

    def _frac_bits(self, scale: str, zero: str, symmetric: int) -> int:
        """Of a power-of-two scale around the middle."""
        unit, middle = self._value(scale), self._value(zero)
        mantissa, exponent = np.frexp(unit.ravel()[:1].astype(np.float64))
        if unit.size != 1 or mantissa[0] != 0.5 or int(middle.ravel()[0]) != symmetric:
            raise _refuse(f"scale {float(unit.ravel()[0]):g}, zero point {int(middle.ravel()[0])}")
        return 1 - int(exponent[0])


def _refuse(got: str) -> ModelError:
    remedy = "make it with 'beers-deploy quantize --regime legal'"
    return ModelError("INT8 core", expected="power-of-two scales, symmetric, from planes", got=got, remedy=remedy)
