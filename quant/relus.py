"""ReLUs of an ONNX file in any encoding: quantisers have been seen to drop them without a word."""

from dataclasses import dataclass

import numpy as np
import onnx

from quant.onnx_file import constants
from quant.saturation import Rounded, rounded_tensors
from quant.untrusted import contradictions


@dataclass(frozen=True)
class Relus:
    """How many a file has.

    Attributes:
        spelt: nodes that are one: Relu, or the larger of a value and zero.
        folded: convolutions whose 8 bits begin at zero, which is a ReLU, unless their results were never below zero.
    """

    explicit: int
    folded: int

    def off_by(self, wanted: int) -> int:
        """How many of `wanted` ReLUs are surely lost, or how many surely added."""
        return max(wanted - self.explicit - self.folded, self.explicit - wanted, 0)

    def __str__(self) -> str:
        return f"{self.explicit}, and up to {self.folded} as 8 bits from zero" if self.folded else str(self.explicit)


def count_relus(model: onnx.ModelProto) -> Relus:
    """The ReLUs of a file.

    Raises:
        ModelError: nodes that contradict it.
    """
    with contradictions("model"):
        known, rounded = constants(model), {tensor.name: tensor for tensor in rounded_tensors(model)}
        convolved = {name for node in model.graph.node if "Conv" in node.op_type for name in node.output}
        explicit = [n.op_type == "Relu" or _cuts_at_zero(n, known, rounded) for n in model.graph.node]
        return Relus(sum(explicit), sum(_begins_at_zero(node, rounded, convolved) for node in model.graph.node))


def _cuts_at_zero(node: onnx.NodeProto, known: dict[str, np.ndarray], rounded: dict[str, Rounded]) -> bool:
    """Whether it is a Max with zero, which in 8 bits is the zero point of what it is compared with."""
    floors = [known[name] for name in node.input if name in known]
    if node.op_type != "Max" or not floors:
        return False
    zeros = [rounded[name].zero_point for name in node.input if name in rounded] or [np.zeros(())]
    return bool((floors[0] == zeros[0]).all())


def _begins_at_zero(node: onnx.NodeProto, rounded: dict[str, Rounded], convolved: set[str]) -> bool:
    """Whether a convolution's result is rounded to numbers of which none is below zero."""
    value = rounded.get(node.output[0]) if node.output else None
    if value is None or not (node.op_type == "QLinearConv" or node.input[0] in convolved):
        return False
    return bool((value.zero_point == value.lowest).all())
