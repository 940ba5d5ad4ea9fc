"""The DPU's rules for the numbers in a quantised file, one function for each rule.

n fractional bits mean the scale 2^-n. Shifts are differences of fractional bits.
"""

import numpy as np

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.checker.finding import Finding, outside
from beers_deploy.dpu.graph import Operation
from beers_deploy.profiles.errors import counted
from beers_deploy.quant.graph.quantized import Scale

# ruff: noqa: ARG001 - every rule takes the operation and the DPU

AGAIN = "'beers-deploy quantize' does"
MOVE = "move the output's scale until it fits: 'beers-deploy quantize' does"


def on_integers(op: Operation, dpu: Dpu) -> Finding | None:
    """A node on the DPU computes on int8 tensors ({documents[numbers]})."""
    remedy = f"quantise this node too; {AGAIN}"
    return None if op.integer else Finding("the file computes it in floating point", remedy)


def symmetric(op: Operation, dpu: Dpu) -> Finding | None:
    """Tensors are int8 around zero, or the same numbers as uint8 around 128
    ({documents[numbers]}).
    """
    faults = [
        f"{role} {scale.integer_type} around {scale.zero_points[0]}"
        for role, scale in op.scales.items()
        if not scale.symmetric
        or (scale.integer_type == "int32" and role.startswith(("input", "output")))
    ]
    return _reported(faults, f"calibrate with a zero point of 0; {AGAIN}")


def int8_alone(op: Operation, dpu: Dpu) -> Finding | None:
    """Tensors are int8 around {numbers[zero_point]} ({numbers[zero_point].source})."""
    zero_points = {dpu.value("numbers", "zero_point")}
    # A bias has rules of its own, `int8_bias` and `int32_bias`.
    faults = [
        role
        for role, scale in op.scales.items()
        if role != "bias"
        and (scale.integer_type != "int8" or set(scale.zero_points) != zero_points)
    ]
    if not faults:
        return None
    return Finding(f"{', '.join(faults)}: not int8 around 0", f"quantise to int8; {AGAIN}")


def per_tensor(op: Operation, dpu: Dpu) -> Finding | None:
    """A tensor has one scale, not one a channel ({documents[quantiser]})."""
    faults = [
        f"{role} has {len(scale.scales)} scales"
        for role, scale in op.scales.items()
        if len(scale.scales) != 1
    ]
    return _reported(faults, f"quantise with one scale a tensor; {AGAIN}")


def power_of_two(op: Operation, dpu: Dpu) -> Finding | None:
    """Scales are powers of two ({documents[quantiser]})."""
    # A tensor of several scales is reported by `per_tensor`.
    faults = [
        f"{role} scale {scale.scales[0]:.4g}"
        for role, scale in op.scales.items()
        if len(scale.scales) == 1 and scale.frac_bits is None
    ]
    remedy = f"round each scale to 2^-n; {AGAIN}, and so does AMD Quark's XINT8"
    return _reported(faults, remedy)


def one_format(op: Operation, dpu: Dpu) -> Finding | None:
    """All nodes give a tensor the same scale and zero point ({documents[quantiser]})."""
    faults = [
        f"{role} is {' and '.join(map(_words, formats))}" for role, formats in op.disputed.items()
    ]
    return _reported(faults, f"give each tensor one scale and zero point; {AGAIN}")


def shift_cut(op: Operation, dpu: Dpu) -> Finding | None:
    """Weight + input - output fractional bits: {numbers[shift_cut]} ({documents[quantiser]})."""
    return _shift(_cut(op), dpu, "shift_cut")


def shift_bias(op: Operation, dpu: Dpu) -> Finding | None:
    """Weight + input - bias fractional bits: at most {numbers[shift_bias_max]}
    ({documents[quantiser]}).

    And at least min(0, shift_cut + 8 - {numbers[accumulator_bits]}).
    """
    cut = _cut(op)
    shift = _difference(product_frac_bits(op), op, "bias")
    if cut is None or shift is None:
        return None
    # The vendor writes it as min(0, -(24 - (8 + shift_cut))).
    low = min(0, cut + 8 - dpu.whole("numbers", "accumulator_bits"))
    high = dpu.whole("numbers", "shift_bias_max")
    if low <= shift <= high:
        return None
    return Finding(f"shift_bias {shift}, allowed {low} to {high}", MOVE)


def bias_width(op: Operation, dpu: Dpu) -> Finding | None:
    """A bias shifted to the products' scale fits {numbers[bias_bits]} bits
    ({numbers[bias_bits].source}).
    """
    shift = _difference(product_frac_bits(op), op, "bias")
    values = op.constants.get("bias")
    if shift is None or values is None:
        return None
    # In float64, because the magnitude of the lowest integer does not fit its own type.
    largest = np.abs(values.astype(np.float64)).max(initial=0)
    most = 2 ** (dpu.whole("numbers", "bias_bits") - 1) - 1
    size = largest * 2.0**shift
    if size <= most:
        return None
    remedy = "train with smaller biases, or with larger weights behind a smaller scale"
    return Finding(f"a bias of {size:g} in units of the products, at most {most}", remedy)


def shift_read(op: Operation, dpu: Dpu) -> Finding | None:
    """The fractional bits of an add's inputs lie {numbers[shift_read]} apart
    ({documents[quantiser]}).
    """
    inputs = _inputs(op)
    return _shift(max(inputs) - min(inputs) if inputs else None, dpu, "shift_read")


def shift_write(op: Operation, dpu: Dpu) -> Finding | None:
    """An add's coarsest input - output fractional bits: {numbers[shift_write]}
    ({documents[quantiser]}).
    """
    return _shift(_difference(min(_inputs(op), default=None), op, "output"), dpu, "shift_write")


def same_scale(op: Operation, dpu: Dpu) -> Finding | None:
    """Inputs and output of a concat or a pool share one scale ({documents[quantiser]})."""
    frac_bits = {role: p for role in op.scales if (p := _frac_bits(op, role)) is not None}
    if len(set(frac_bits.values())) < 2:
        return None
    reason = ", ".join(f"{role} {counted(p, 'fractional bit')}" for role, p in frac_bits.items())
    return Finding(reason, f"give them the smallest one; {AGAIN}")


def product_frac_bits(op: Operation) -> int | None:
    """Return the number of fractional bits of a convolution's sums before the bias is added.

    It is the sum of those of the weights and of the input, because products add them. Return None
    if the scale of either is missing or no power of two.
    """
    weight = _frac_bits(op, "weight")
    source = _frac_bits(op, "input 0")
    return None if weight is None or source is None else weight + source


def _reported(faults: list[str], remedy: str) -> Finding | None:
    """Return a finding that lists the faults, or None if there are none."""
    return Finding("; ".join(faults), remedy) if faults else None


def _frac_bits(op: Operation, role: str) -> int | None:
    scale = op.scales.get(role)
    return scale.frac_bits if scale else None


def _inputs(op: Operation) -> list[int]:
    """Return the fractional bits of the tensors and constants that an element-wise operator
    reads.
    """
    frac_bits = (
        _frac_bits(op, role) for role in op.scales if role.startswith(("input", "constant"))
    )
    return [p for p in frac_bits if p is not None]


def _cut(op: Operation) -> int | None:
    return _difference(product_frac_bits(op), op, "output")


def _difference(frac_bits: int | None, op: Operation, role: str) -> int | None:
    """Return the number of fractional bits that a tensor of an operation has less."""
    own = _frac_bits(op, role)
    return None if frac_bits is None or own is None else frac_bits - own


def _shift(shift: int | None, dpu: Dpu, key: str) -> Finding | None:
    """Return a finding if a shift lies outside the limit of that key, or None."""
    limit = dpu.limit("numbers", key)
    if shift is None or not outside((shift,), limit):
        return None
    return Finding(f"{key} {shift}, allowed {limit}", MOVE)


def _words(scale: Scale) -> str:
    scales = ", ".join(f"{s:.9g}" for s in scale.scales[:1])
    zeros = ", ".join(map(str, scale.zero_points[:1]))
    return f"{scale.integer_type} at scale {scales or 'unknown'} around {zeros or 'nothing'}"


BYTES = ("int8", "uint8")
"""The accepted types. The rule "symmetric" checks that uint8 is centred on 128."""


def int8_constants(op: Operation, dpu: Dpu) -> Finding | None:
    """Weights, and constants that are added, multiplied or joined, are stored as int8
    ({documents[numbers]}).
    """
    kinds = {role: _kind(values) for role, values in op.constants.items() if role != "bias"}
    faults = [f"{role} is {kind}" for role, kind in kinds.items() if kind not in BYTES]
    faults += [
        f"{role} has no scale"
        for role, kind in kinds.items()
        if kind in BYTES and role not in op.scales
    ]
    return _reported(faults, f"store it as int8 with a scale 2^-n; {AGAIN}")


def int8_bias(op: Operation, dpu: Dpu) -> Finding | None:
    """A bias is int8 with a scale of its own, not int32 at the products' scale
    ({documents[quantiser]}).

    The operator QLinearConv demands int32: its bias has a rule of its own. Judged where weights are
    in 8 bits.
    """
    byte_weights = _kind(op.constants.get("weight")) in BYTES
    if "bias" not in op.constants or op.op_type == "QLinearConv" or not byte_weights:
        return None
    kind = _kind(op.constants["bias"])
    if kind == "int8":
        return None
    return Finding(f"its bias is {kind}", f"quantise the bias to int8; {AGAIN}")


def int32_bias(op: Operation, dpu: Dpu) -> Finding | None:
    """A QLinearConv's int32 bias is int8 << k, k at most {numbers[shift_bias_max]}
    ({documents[quantiser]}).

    One k for all values: weight + input - bias fractional bits. Another bias of this form is as
    legal. Judged where the products have a scale.
    """
    if "bias" not in op.constants or op.op_type != "QLinearConv" or product_frac_bits(op) is None:
        return None
    values = op.constants["bias"]
    high = dpu.whole("numbers", "shift_bias_max")
    remedy = f"round the bias to int8 at a scale of its own; {AGAIN}"
    if values is None or _kind(values) != "int32":
        return Finding(f"its bias is {_kind(values)}", remedy)
    # The lowest bit that is set in any value, if not all values are 0.
    bits = int(np.bitwise_or.reduce(values, axis=None))
    shift = min(high, max((bits & -bits).bit_length() - 1, 0))
    # The bits that are shifted out are 0 in every value: nothing is rounded.
    shifted = values >> shift
    low = int(shifted.min(initial=0))
    top = int(shifted.max(initial=0))
    if low >= -128 and top <= 127:
        return None
    return Finding(
        f"its bias is {low} to {top} shifted left by {shift}, allowed -128 to 127 by 0 to {high}",
        remedy,
    )


def _kind(values: np.ndarray | None) -> str:
    return "computed by other nodes" if values is None else str(values.dtype)
