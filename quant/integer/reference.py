"""Compute the DPU's arithmetic in integers, as AMD documents it and independent of any runtime.

    convolution: int8 products added in int32, plus bias << shift_bias, ReLU,
                 >> shift_cut rounded, to [-128, 127]
    add:         the finer input aligned to the coarser, sum shifted by shift_write rounded,
                 to [-128, 127]

Activations round half up; a runtime that computes in float rounds half to even. If a shifted sum
ends in exactly one half, the two differ by one unit. `half_even` selects the runtime's rule, so
that both can be proven and counted.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from beers_deploy.quant.core import IntConv, IntCore, op_shifts
from beers_deploy.quant.frac_bits import INT8_MAX, INT8_MIN
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    Add,
    AveragePool,
    Concat,
    MaxPool,
    Mul,
    Op,
    Pointwise,
    Resize,
    Shuffle,
)
from beers_deploy.quant.integer.arithmetic import (
    accumulator_bias,
    activated,
    activation_table,
    bound_of,
    convolve,
    enlarged,
    means,
    saturated,
    window_maxima,
)

INT32_BITS = 31
"""The number of bits of an accumulator, without the sign."""

NARROW_BITS = 23
"""The number of bits of a 24-bit accumulator, without the sign. The documents suggest one (facts on
the DPU's rules); int32 has 31.
"""
BITS_SOURCE = "128 times the sum of the weights' sizes, plus the bias: no input exceeds it"


@dataclass(frozen=True)
class Faults:
    """Faults that are injected while a core runs, to measure their effect.

    Attributes:
        shifts: wrong shifts in bits, by the names of operation and shift. Shifts are `shift_cut`
            and `shift_bias` of a convolution, and `shift_write` of an add.
        touch: a function that is called with the name and the values of each tensor after it is
            written, and that returns the values which later operations read.
    """

    shifts: Mapping[tuple[str, str], int] = field(default_factory=dict)
    touch: Callable[[str, np.ndarray], np.ndarray] = field(default=lambda _, tensor: tensor)


NO_FAULTS = Faults()
"""The default of a run: no fault is injected."""


@dataclass(frozen=True)
class LayerReport:
    """The behaviour of one operation on the images that it was run on.

    Attributes:
        name: the name of the operation.
        peak_bits: the number of bits, without the sign, that the largest accumulator needed.
        proven_bits: the number of bits that no accumulator can exceed, for any input. For a
            convolution: 128 times the sum of a channel's absolute weights, plus the bias.
        saturated: the share of the results at the ends of int8, in [0, 1].
        ties: the share of the results whose shifted sum ended in exactly one half, so that the rule
            for ties decided.
    """

    name: str
    peak_bits: float
    proven_bits: float
    saturated: float
    ties: float


def run_core(
    core: IntCore, planes: np.ndarray, half_even: bool = False, faults: Faults = NO_FAULTS
) -> tuple[dict[str, np.ndarray], list[LayerReport]]:
    """Run an integer core on the int8 planes of an image, operation by operation, as the DPU
    computes.

    Args:
        core: the integer core.
        planes: (N, P, H, W) int8, as `HostPart.encode` returns them.
        half_even: True rounds ties to even, as onnxruntime does; False rounds them up, as the DPU
            does.
        faults: the faults that are injected; NO_FAULTS has none.

    Returns:
        Every tensor (N, C, H, W) int16 by name, and one report per operation.
    """
    tensors = {PLANES: faults.touch(PLANES, planes.astype(np.int16))}
    reports = []
    for op in core.ops:
        sums = layer_sums(core, op, tensors, faults)
        quotients, ties = rounded(sums.values, sums.shift, half_even)
        result = saturated(quotients)
        tensors[op.output] = faults.touch(op.output, result)
        ends = (result == INT8_MAX) | (result == INT8_MIN)
        largest = max(int(np.abs(sums.values).max()), 1)
        # An activation appends its bits behind the accumulator, which never holds them.
        peak = max(float(np.log2(largest)) - sums.finer, 0.0)
        reports.append(LayerReport(op.name, peak, sums.bound, float(ends.mean()), ties))
    return tensors, reports


def merged_correction(core: IntCore, tensors: Mapping[str, np.ndarray]) -> np.ndarray:
    """Decode the result in a core's tensors as the host does, with one value for the copies of each
    channel.

    Args:
        core: the integer core.
        tensors: the integers of each tensor by name, as `run_core` returns them.

    Returns:
        (N, C, H, W) float32, as `HostPart.decode` returns it.
    """
    scale = core.scale(CORRECTION)
    return core.host_part.decode(tensors[CORRECTION] * np.float32(scale), scale)


class LayerSums(NamedTuple):
    """The integer sums of an operation, before they are shifted and rounded to int8.

    Attributes:
        values: the sums (N, C, H, W).
        shift: the right shift in bits that leads to int8.
        bound: the number of bits, without the sign, that the accumulators cannot exceed.
        finer: the number of fractional bits by which an activation has made the sums longer than
            the accumulators were.
    """

    values: np.ndarray
    shift: int
    bound: float
    finer: int = 0


INT8_BITS = 7.0
"""The number of bits of values that are only moved, without the sign."""


def layer_sums(
    core: IntCore, op: IntConv | Op, tensors: Mapping[str, np.ndarray], faults: Faults = NO_FAULTS
) -> LayerSums:
    """Compute the integer sums of an operation, before they are shifted and rounded to int8.

    Args:
        core: the integer core that the operation belongs to.
        op: the operation.
        tensors: int8 values by tensor name, with those that the operation reads.
        faults: shifts that are replaced by wrong ones, to simulate faults.
    """
    inputs = [tensors[name] for name in op.inputs]
    if isinstance(op, IntConv):
        return _conv(core, op, inputs[0], faults)
    if isinstance(op, Add):
        return _add(core, op, inputs, faults)
    if isinstance(op, Mul):
        product = inputs[0].astype(np.int64) * inputs[1]
        shift = op_shifts(op, core.frac_bits)["shift_cut"]
        # The largest product is that of -128 and -128, which is 2^14.
        return LayerSums(product, shift, bound=14.0)
    if isinstance(op, AveragePool):
        return LayerSums(*means(inputs[0], op))
    if isinstance(op, Resize) and op.bilinear:
        return LayerSums(*enlarged(inputs[0], op.factor))
    # Values that only move have the same scale, and a table's entries are rounded, so no shift
    # remains.
    return LayerSums(_moving(core, op, inputs), 0, INT8_BITS)


def _moving(core: IntCore, op: Op, inputs: list[np.ndarray]) -> np.ndarray:
    """Return values that are moved or looked up in a table."""
    if isinstance(op, Concat):
        return np.concatenate(inputs, axis=1)
    if isinstance(op, MaxPool):
        return window_maxima(inputs[0], op)
    if isinstance(op, Resize):
        return inputs[0].repeat(op.factor, axis=2).repeat(op.factor, axis=3)
    if isinstance(op, Shuffle):
        return op(inputs[0])
    assert isinstance(op, Pointwise)  # noqa: S101
    # 256 values can enter, so the function is a table; its first entry is that of -128.
    return np.asarray(activation_table(op, core.frac_bits)[inputs[0] - INT8_MIN])


def _conv(core: IntCore, op: IntConv, image: np.ndarray, faults: Faults) -> LayerSums:
    needed = op_shifts(op, core.frac_bits)
    shift = faults.shifts.get((op.name, "shift_bias"), needed["shift_bias"])
    bias = accumulator_bias(op, shift)
    sums = convolve(image, op.weight, op.window, op.groups, op.transposed) + bias[:, None, None]
    # The DPU applies the activation to the accumulator, before the one rounding.
    sums, finer = activated(sums, op.activation, op.accumulator_bits(core.frac_bits))
    cut = faults.shifts.get((op.name, "shift_cut"), needed["shift_cut"])
    return LayerSums(sums, cut + finer, bound_of(op, bias), finer)


def _add(core: IntCore, op: Add, inputs: list[np.ndarray], faults: Faults) -> LayerSums:
    """Return the exact sum at the finer input's scale, the shift that remains, and its bits."""
    finest = max(core.frac_bits[name] for name in op.inputs)
    shifts = [finest - core.frac_bits[name] for name in op.inputs]
    # At the finest scale no input loses a bit, so the result is rounded once.
    aligned = [
        values.astype(np.int64) << shift for values, shift in zip(inputs, shifts, strict=True)
    ]
    sums, finer = activated(np.asarray(sum(aligned)), op.activation, finest)
    # An int8 value is at most 128 in size.
    bound = sum(128 << shift for shift in shifts)
    coarsest = min(core.frac_bits[name] for name in op.inputs)
    needed = op_shifts(op, core.frac_bits)["shift_write"]
    write = faults.shifts.get((op.name, "shift_write"), needed)
    return LayerSums(sums, finest - coarsest + write + finer, float(np.log2(bound)), finer)


def rounded(sums: np.ndarray, shift: int, half_even: bool) -> tuple[np.ndarray, float]:
    """Divide integers by 2^shift and round them, without clipping.

    Args:
        sums: integers of any shape.
        shift: the right shift in bits; a negative one shifts left, by at most 8 bits.
        half_even: True rounds ties to even, False up.

    Returns:
        The integers, and the share of the sums that were ties (exactly one half).
    """
    if shift <= 0:
        return sums << min(-shift, 8), 0.0  # by 8 all but 0 lies beyond int8
    half = 1 << (shift - 1)
    # The shift of a negative number rounds down as well, so this is half up for either sign.
    quotients = (sums + half) >> shift
    ties = (sums & ((1 << shift) - 1)) == half
    if half_even:
        # Half up has raised every tie; the odd ones go back to the even number below.
        quotients = quotients - (ties & (quotients % 2 == 1))
    return np.asarray(quotients), float(ties.mean())
