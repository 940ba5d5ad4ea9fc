"""Define the integer core: int8 weights and bias, and a power-of-two scale for every tensor, as the
DPU requires.

A tensor with n fractional bits holds integer multiples of its scale 2^-n, in [-128, 127] times that
(UG1414 3.5, vai_q). `frac_bits` is n everywhere; a finer scale has more fractional bits.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.frac_bits import INT8_MAX, INT8_MIN, best_frac_bits, quantize
from beers_deploy.quant.graph import (
    PLANES,
    SIX,
    Activation,
    Add,
    Conv,
    Graph,
    Mul,
    OneInput,
    Op,
    Window,
    ties_scales,
)
from beers_deploy.quant.host_part import ONE_CHANNEL, HostPart


@dataclass(frozen=True)
class Shifts:
    """The ranges of the shifts that a DPU's arithmetic allows (UG1414 3.5 and the quantiser's
    source, Vitis-AI 3.0).

    A DPU moves between scales 2^-n by shifting, and each kind of shift has a smallest and a largest
    value in bits. The quantiser writes within these ranges. Files are checked against
    `deploy.dpu.checker.number_rules`, which allows a little more (a bias finer than the
    accumulator).

    Attributes:
        shift_cut: the fractional bits of a convolution's weights plus those of its input, minus
            those of its result.
        shift_bias: the fractional bits of weights plus input, minus those of the int8 bias. Below 0
            the bias would be finer than the accumulator.
        shift_read: the difference of fractional bits between the inputs of an add.
        shift_write: the fractional bits of an add's coarsest input minus those of its result.
    """

    shift_cut: tuple[int, int] = (0, 16)
    shift_bias: tuple[int, int] = (0, 16)
    shift_read: tuple[int, int] = (0, 15)
    shift_write: tuple[int, int] = (-15, 15)


SHIFTS = Shifts()


def target_shifts(target: TargetProfile) -> Shifts:
    """Return the smallest and largest shifts that the DPU of a target board allows.

    Args:
        target: the profile of the board, whose table `numbers` states the constants of each shift.
    """

    def allowed(key: str) -> tuple[int, int]:
        constant = target.constant("numbers", key)
        return int(constant.low), int(constant.high)

    # Boards allow a bias finer than the accumulator, whose lowest bits are lost: none is written.
    bias = 0, int(target.value("numbers", "shift_bias_max"))
    return Shifts(allowed("shift_cut"), bias, allowed("shift_read"), allowed("shift_write"))


def clamp(bits: int, allowed: tuple[int, int]) -> int:
    """Return the shift that is nearest to `bits` among those allowed."""
    low, high = allowed
    return min(max(bits, low), high)


ROUNDS = 8
"""The maximum number of rounds. An add may change the scale of an earlier tensor, whose writer must
then follow. Two rounds suffice in practice.
"""


@dataclass(frozen=True)
class IntConv(OneInput):
    """An int8 convolution of the integer core.

    It adds int8 products in an int32 accumulator, adds bias << shift_bias, applies the activation,
    shifts right by shift_cut with rounding, and clips to int8. Both shifts follow from the
    fractional bits of the tensors, and are not stored.

    Attributes:
        weight: (O, I / groups, kh, kw) int8, multiples of 2^-weight_frac_bits.
        weight_frac_bits: the number of fractional bits of the weights.
        bias: (O,) int8, multiples of 2^-bias_frac_bits.
        bias_frac_bits: the number of fractional bits of the bias.
        activation: applied to the sums.
        window: strides, pads and dilations; if transposed, the strides enlarge and the pads crop.
        groups: 1, or the number of channels of a depthwise convolution.
        transposed: True for a transposed convolution.
    """

    weight: np.ndarray
    weight_frac_bits: int
    bias: np.ndarray
    bias_frac_bits: int
    activation: Activation = Activation.none
    window: Window = field(default_factory=Window)
    groups: int = 1
    transposed: bool = False

    @property
    def float_bias(self) -> np.ndarray:
        """The real values (O,) float64 that the integer bias represents."""
        return self.bias * 2.0**-self.bias_frac_bits

    def accumulator_bits(self, frac_bits: Mapping[str, int]) -> int:
        """Return the number of fractional bits of the accumulator: those of the weights plus those
        of the input.

        Args:
            frac_bits: the number of fractional bits of each tensor by its name.
        """
        return self.weight_frac_bits + frac_bits[self.input]


@dataclass(frozen=True)
class IntCore:
    """The integer core: the part of a network that a DPU computes in int8, between the host's pre-
    and post-processing.

    Attributes:
        ops: the operations in order. Convolutions hold integers.
        frac_bits: the number n of fractional bits of each tensor by its name. The tensor's int8
            integers are multiples of its scale 2^-n.
        host_part: the computations of the host in front of the operations and behind them.
    """

    ops: tuple[IntConv | Op, ...]
    frac_bits: Mapping[str, int]
    host_part: HostPart = ONE_CHANNEL

    def scale(self, tensor: str) -> float:
        """Return the scale 2^-n of a tensor, which is the real value of the integer 1.

        Args:
            tensor: the name of the tensor.
        """
        return float(2.0 ** -self.frac_bits[tensor])

    @property
    def convolutions(self) -> list[IntConv]:
        """The operations that have weights, in order."""
        return [op for op in self.ops if isinstance(op, IntConv)]


def dequantized(op: Conv, int_op: IntConv) -> Conv:
    """Return a float convolution with the real values that the int8 weights and bias represent.

    Args:
        op: the float convolution, whose other properties are unchanged.
        int_op: the convolution in integers that `op` was rounded to.
    """
    weight = (int_op.weight * 2.0**-int_op.weight_frac_bits).astype(np.float32)
    return replace(op, weight=weight, bias=int_op.float_bias.astype(np.float32))


def rounded_to(values: np.ndarray, frac_bits: int) -> np.ndarray:
    """Round real values to an int8 scale, and return them as real values.

    This is the DPU's rounding of activations: half up, as floor(x * 2^frac_bits + 1/2), then
    clipping to [-128, 127].

    Args:
        values: float32 values of any shape.
        frac_bits: the number n of fractional bits of the scale 2^-n.

    Returns:
        Multiples of 2^-n in the unit and shape of `values`.
    """
    scale = np.float32(2.0**frac_bits)
    # np.rint would round half to even, as onnxruntime does.
    units = np.floor(values * scale + np.float32(0.5))
    return np.asarray(np.clip(units, INT8_MIN, INT8_MAX) / scale)


class RoundedConv(NamedTuple):
    """A convolution before and after it was rounded to integers.

    Attributes:
        op: the float convolution.
        rounded: the convolution in integers.
        output_frac_bits: the number of fractional bits of its result, which the shifts reach.
    """

    op: Conv
    rounded: IntConv
    output_frac_bits: int


RoundedConvs = dict[tuple[str, int, int], RoundedConv]
"""Convolutions that were rounded before, by name and the requested fractional bits of input and
output.
"""


def build_core(
    graph: Graph,
    frac_bits: Mapping[str, int],
    shifts: Shifts = SHIFTS,
    host_part: HostPart = ONE_CHANNEL,
    earlier: RoundedConvs | None = None,
) -> IntCore:
    """Round the weights of a float graph to integers, and change scales where the DPU's shifts
    cannot reach from one to the next.

    Args:
        graph: a float graph that reads the int8 planes that an image is split into (`PLANES`), not
            the image itself.
        frac_bits: the number of fractional bits wanted for each activation by its tensor's name,
            such as those of least squared error.
        shifts: the smallest and largest shifts that the target allows.
        host_part: the host's pre- and post-processing, which becomes a part of the core.
        earlier: the convolutions that earlier calls rounded. They are not rounded again, and new
            ones are added. None starts without any.

    Returns:
        The integer core, all shifts of which the target allows.

    Raises:
        ModelError: the shifts do not reach all scales after ROUNDS rounds of changes.
    """
    earlier = {} if earlier is None else earlier
    legal = dict(frac_bits)
    # Each round starts from the scales that the one before has moved.
    for _ in range(ROUNDS):
        ops = [_rounded(op, legal, shifts, earlier) for op in graph]
        core = IntCore(tuple(ops), dict(legal), host_part)
        faults = shift_faults(core, shifts)
        if faults:
            continue
        # The host adds the rounding error of the last biases, if it adds offsets.
        last = graph[-1]
        rounded = core.ops[-1]
        if isinstance(last, Conv) and isinstance(rounded, IntConv):
            decoding = host_part.decoding.with_bias_errors(last.bias - rounded.float_bias)
            core = replace(core, host_part=replace(host_part, decoding=decoding))
        return core
    raise ModelError(
        f"The network cannot be quantised, because the DPU's shifts do not reach all its values "
        f"({faults[0]}). Look for weights that are far too large or too small."
    )


def _rounded(
    op: Op, frac_bits: dict[str, int], shifts: Shifts, earlier: RoundedConvs
) -> IntConv | Op:
    """Return an operation in integers, after moving scales in `frac_bits` until the shifts reach
    from its inputs to its output.
    """
    if isinstance(op, Conv):
        key = op.name, frac_bits[op.input], frac_bits[op.output]
        # A candidate of a search differs from the one before in few convolutions.
        if key not in earlier or earlier[key].op is not op:
            earlier[key] = _quantize_conv(op, frac_bits[op.input], frac_bits[op.output], shifts)
        frac_bits[op.output] = earlier[key].output_frac_bits
        return earlier[key].rounded
    if isinstance(op, Add):
        # The coarsest input stays, because a finer scale would make it clip. Finer inputs come
        # nearer.
        coarse = min(frac_bits[name] for name in op.inputs)
        for name in op.inputs:
            frac_bits[name] = coarse + clamp(frac_bits[name] - coarse, shifts.shift_read)
        frac_bits[op.output] = coarse - clamp(coarse - frac_bits[op.output], shifts.shift_write)
    elif isinstance(op, Mul):
        # A product has the fractional bits of both factors; only the result's scale can move.
        both = sum(frac_bits[name] for name in op.inputs)
        frac_bits[op.output] = both - clamp(both - frac_bits[op.output], shifts.shift_cut)
    elif ties_scales(op):
        # Inputs and output have one scale: the coarsest of them, because a finer one clips, or
        # that of the planes, which the host writes.
        names = (*op.inputs, op.output)
        shared = frac_bits[PLANES] if PLANES in names else min(frac_bits[n] for n in names)
        frac_bits.update(dict.fromkeys(names, shared))
    return op


def _quantize_conv(op: Conv, input_bits: int, output_bits: int, shifts: Shifts) -> RoundedConv:
    """Round a convolution, whose input and output have these numbers of fractional bits; the
    output's may change.
    """
    # With finer weights the shift would exceed its range, and the result's scale would have to
    # become finer too, so that it clips.
    _, largest = shifts.shift_cut
    weight_frac_bits = min(best_frac_bits(op.weight), largest + output_bits - input_bits)
    # Here the end of int8 is the activation's own clip, so the result must keep its scale: the
    # weights are made fine enough for a shift of 0.
    if op.ceiling is not None:
        weight_frac_bits = max(weight_frac_bits, output_bits - input_bits)
    accumulator_bits = weight_frac_bits + input_bits
    output_bits = accumulator_bits - clamp(accumulator_bits - output_bits, shifts.shift_cut)
    bias, bias_frac_bits = quantize_bias(op.bias, accumulator_bits, shifts)
    # ReLU6 equals ReLU if int8 ends at six or below, as it does once `equalize` has scaled.
    ends_first = op.ceiling is not None or INT8_MAX * 2.0**-output_bits <= SIX
    is_relu = op.activation is Activation.relu6 and ends_first
    rounded = IntConv(
        name=op.name,
        input=op.input,
        output=op.output,
        weight=quantize(op.weight, weight_frac_bits),
        weight_frac_bits=weight_frac_bits,
        bias=bias,
        bias_frac_bits=bias_frac_bits,
        activation=Activation.relu if is_relu else op.activation,
        window=op.window,
        groups=op.groups,
        transposed=op.transposed,
    )
    return RoundedConv(op, rounded, output_bits)


def quantize_bias(
    bias: np.ndarray, accumulator_bits: int, shifts: Shifts
) -> tuple[np.ndarray, int]:
    """Quantise a convolution's bias to int8, at a scale that a shift can align with the
    accumulator.

    Args:
        bias: (O,) the float bias.
        accumulator_bits: the number of fractional bits of the accumulator.
        shifts: the smallest and largest shifts that the target allows.

    Returns:
        The integers (O,) int8, and their number of fractional bits.
    """
    # Any scale holds zeros; the accumulator's own needs no shift.
    best = best_frac_bits(bias) if bias.any() else accumulator_bits
    frac_bits = accumulator_bits - clamp(accumulator_bits - best, shifts.shift_bias)
    return quantize(bias, frac_bits), frac_bits


def shift_faults(core: IntCore, shifts: Shifts = SHIFTS) -> list[str]:
    """List the shifts of a core that the DPU does not allow.

    Args:
        core: the integer core.
        shifts: the smallest and largest shifts that the target allows.

    Returns:
        A sentence for each such shift, with the operation's name; empty for a core that the DPU
        computes.
    """
    faults = []
    for op in core.ops:
        for rule, bits in op_shifts(op, core.frac_bits).items():
            low, high = (0, 0) if ties_scales(op) else getattr(shifts, rule)
            if not low <= bits <= high:
                faults.append(f"{op.name}: {rule} is {bits}, allowed {low} to {high}")
    return faults


def op_shifts(op: IntConv | Op, frac_bits: Mapping[str, int]) -> dict[str, int]:
    """Return the shifts in bits that an operation needs, because its tensors have different scales.

    Args:
        op: an operation of a core.
        frac_bits: the number of fractional bits of each tensor by its name.

    Returns:
        The shifts by their names, which are those of `Shifts`.
    """
    inputs = [frac_bits[name] for name in op.inputs]
    output = frac_bits[op.output]
    if isinstance(op, Add):
        return {"shift_read": max(inputs) - min(inputs), "shift_write": min(inputs) - output}
    if isinstance(op, Mul):
        return {"shift_cut": sum(inputs) - output}
    if ties_scales(op):
        return {"shift_read": max(*inputs, output) - min(*inputs, output)}
    if not isinstance(op, IntConv):
        return {}
    accumulator = op.accumulator_bits(frac_bits)
    return {"shift_cut": accumulator - output, "shift_bias": accumulator - op.bias_frac_bits}
