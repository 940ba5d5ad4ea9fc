"""How often the results inside an INT8 network come to the ends of 8 bits: what lies beyond is clipped, and lost.

Looked at is whatever a node rounds to 8 bits, in any encoding (integer kernels or QDQ), as the graph is written. Two
ends are no loss: the lower one where it stands for zero or where a ReLU reads it, for that is the ReLU, and those of
the fine gain, which the coarse one is there for (`quant.passes.stream`).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import onnx

from quant.graph import CORRECTION
from quant.onnx_file import any_size, constants, with_outputs
from quant.session import open_session, tensors_of
from quant.untrusted import contradictions

ZERO_POINTS = {"QuantizeLinear": 2, "QLinearConv": 7, "QLinearAdd": 7, "QLinearMatMul": 7}
"""ONNX's and onnxruntime's operators that round to 8 bits, of those that may run (`quant.untrusted`), and which input
holds the zero point of their result."""

RELUS = ("Relu", "Max")


@dataclass(frozen=True)
class Rounded:
    """A tensor of 8 bits.

    Attributes:
        name: in the graph.
        zero_point: its value for 0, which says its type too.
        low_is_relu: whether what is clipped at the lower end would have become zero anyway.
    """

    name: str
    zero_point: np.ndarray
    low_is_relu: bool

    @property
    def lowest(self) -> int:
        """The smallest number that its 8 bits hold."""
        return int(np.iinfo(self.zero_point.dtype).min)

    def at_ends(self, values: np.ndarray) -> np.ndarray:
        """Which of its values (N, C, H, W) lie at an end."""
        kept = values[:, 1:] if self.name == CORRECTION and values.shape[1:2] == (2,) else values
        low = (kept == self.lowest) & (not self.low_is_relu and bool(self.zero_point.min() > self.lowest))
        return np.asarray((kept == self.lowest + 255) | low)


def saturated_shares(model: onnx.ModelProto, images: Iterable[np.ndarray]) -> dict[str, float]:
    """The share, in [0, 1], of each 8-bit tensor's values that lie at an end, over images (N, 1, H, W) in [0, 1].

    Empty where no node rounds to 8 bits.

    Raises:
        ModelError: onnxruntime refuses the model, or cannot run it.
    """
    looked_at = rounded_tensors(model)
    if not looked_at:
        return {}
    kinds = {t.name: onnx.helper.np_dtype_to_tensor_dtype(t.zero_point.dtype) for t in looked_at}
    session = open_session(with_outputs(any_size(model), kinds), optimise=False)
    ends, counts = np.zeros(len(looked_at)), np.zeros(len(looked_at))
    for image in images:
        results = tensors_of(session, [tensor.name for tensor in looked_at], image)
        flags = [tensor.at_ends(values) for tensor, values in zip(looked_at, results, strict=True)]
        ends += [flag.sum() for flag in flags]
        counts += [flag.size for flag in flags]
    shares = ends / np.maximum(counts, 1)
    return {tensor.name: float(share) for tensor, share in zip(looked_at, shares, strict=True)}


def rounded_tensors(model: onnx.ModelProto) -> list[Rounded]:
    """What the graph's nodes round to 8 bits, in the graph's order.

    Raises:
        ModelError: nodes that contradict it.
    """
    with contradictions("INT8 model"):
        return [tensor for tensor in _rounded(model) if tensor.zero_point.dtype in (np.int8, np.uint8)]


def _rounded(model: onnx.ModelProto) -> list[Rounded]:
    known = constants(model)
    read_as = {node.output[0]: node.input[0] for node in model.graph.node if node.op_type == "DequantizeLinear"}
    relus = {name for node in model.graph.node if node.op_type in RELUS for name in node.input}
    relus |= {read_as[name] for name in relus & set(read_as)}
    found = []
    for node in model.graph.node:
        place = ZERO_POINTS.get(node.op_type)
        if place is not None and node.input[0] not in known:
            stored = known.get(node.input[place]) if len(node.input) > place else None
            zero_point = _default_zero_point(node) if stored is None else stored
            found.append(Rounded(node.output[0], zero_point, node.output[0] in relus))
    return found


def _default_zero_point(node: onnx.NodeProto) -> np.ndarray:
    """Of a node that names none: 0, of the type that it asks for, or uint8."""
    kinds = [a.i for a in node.attribute if a.name == "output_dtype" and a.i]
    kind = onnx.helper.tensor_dtype_to_np_dtype(kinds[0]) if kinds else np.uint8
    return np.zeros((), kind)
