"""What the DPU demands of the constants in a quantised file as they are stored: one rule, one function."""

# ruff: noqa: ARG001 - every rule takes the operation and the DPU

import numpy as np

from deploy.dpu.board import Dpu
from deploy.dpu.finding import Finding
from deploy.dpu.graph import Operation
from deploy.dpu.number_rules import AGAIN, product_position

BYTES = ("int8", "uint8")
"""Whether uint8 lies around 128 is the rule "symmetric"."""


def int8_constants(op: Operation, dpu: Dpu) -> Finding | None:
    """Weights, and constants that are added, multiplied or joined, are stored as int8 (UG1414 3.5, quantisation)."""
    kinds = {role: _kind(values) for role, values in op.constants.items() if role != "bias"}
    faults = [f"{role} is {kind}" for role, kind in kinds.items() if kind not in BYTES]
    faults += [f"{role} has no scale" for role, kind in kinds.items() if kind in BYTES and role not in op.scales]
    return Finding("; ".join(faults), f"store it as int8 with a scale 2^-position; {AGAIN}") if faults else None


def int8_bias(op: Operation, dpu: Dpu) -> Finding | None:
    """A bias is int8 with a position of its own, not int32 at the products' scale (Vitis-AI 3.0, vai_q_pytorch).

    The operator QLinearConv demands int32: its bias has a rule of its own.
    """
    if "bias" not in op.constants or op.op_type == "QLinearConv":
        return None
    kind = _kind(op.constants["bias"])
    return None if kind == "int8" else Finding(f"its bias is {kind}", f"quantise the bias to int8; {AGAIN}")


def int32_bias(op: Operation, dpu: Dpu) -> Finding | None:
    """A QLinearConv's int32 bias is int8 << k, k at most {numbers[shift_bias_max]} (Vitis-AI 3.0, vai_q_pytorch).

    One k for all values: the weight + input - bias position. A change that keeps this form no rule can see: one more
    where k is 0 is another bias, and as legal. Judged where the products have a position.
    """
    if "bias" not in op.constants or op.op_type != "QLinearConv" or product_position(op) is None:
        return None
    values, high = op.constants["bias"], dpu.whole("numbers", "shift_bias_max")
    remedy = f"round the bias to int8 at a position of its own; {AGAIN}"
    if values is None or _kind(values) != "int32":
        return Finding(f"its bias is {_kind(values)}", remedy)
    shift = min(high, _spare_bits(values))
    low, top = (int(end) for end in ((values >> shift).min(initial=0), (values >> shift).max(initial=0)))
    if low >= -128 and top <= 127:
        return None
    return Finding(f"its bias is {low} to {top} shifted left by {shift}, allowed -128 to 127 by 0 to {high}", remedy)


def _kind(values: np.ndarray | None) -> str:
    return "computed by other nodes" if values is None else str(values.dtype)


def _spare_bits(values: np.ndarray) -> int:
    """How many low bits are 0 in every value; 0 where all values are."""
    bits = int(np.bitwise_or.reduce(values, axis=None))
    return (bits & -bits).bit_length() - 1 if bits else 0
