"""Bound the integers of an INT8 network over all images, by interval arithmetic on its weights."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from beers_deploy.quant.core import IntConv, IntCore, op_shifts
from beers_deploy.quant.frac_bits import INT8_MAX, INT8_MIN
from beers_deploy.quant.graph import (
    PLANES,
    Add,
    AveragePool,
    Mul,
    Op,
    Pointwise,
    Resize,
    Shuffle,
)
from beers_deploy.quant.integer.arithmetic import (
    activated,
    activation_table,
    bilinear_weights,
    mean_factor,
    saturated,
)
from beers_deploy.quant.integer.reference import layer_sums, rounded


class ChannelRange(NamedTuple):
    """The smallest and the largest integer of each channel, (C,) each."""

    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class LayerBound:
    """Bounds of one operation of an integer core that hold for every image.

    Attributes:
        name: the name of the operation.
        bits: log2 of the largest absolute value of its accumulator: the bits needed without the
            sign.
        low: the smallest result in units of the output's scale, before clipping to int8.
        high: the largest result, likewise.
    """

    name: str
    bits: float
    low: int
    high: int

    @property
    def saturates(self) -> bool:
        """True if an image might bring a result to an end of int8, -128 or 127, where values are
        clipped.
        """
        return self.low <= INT8_MIN or self.high >= INT8_MAX


def layer_bounds(core: IntCore) -> list[LayerBound]:
    """Compute bounds of the accumulator and of the results of every operation of a core.

    The bounds hold for every image, because they follow from the weights and from the ranges of the
    inputs alone (interval arithmetic). They may be wider than what any image reaches.

    Args:
        core: the integer core.

    Returns:
        One `LayerBound` per operation, in the order of the operations.
    """
    channels = core.host_part.channels
    ranges = {
        PLANES: ChannelRange(*(np.repeat(end, channels) for end in core.host_part.encoding.limits))
    }
    bounds = []
    for op in core.ops:
        (low, high), shift = _accumulated(core, op, ranges)
        bits = float(np.log2(max(int(np.abs(low).max()), int(np.abs(high).max()), 1)))
        low, high = (rounded(end, shift, half_even=False)[0] for end in (low, high))
        ranges[op.output] = ChannelRange(saturated(low), saturated(high))
        bounds.append(LayerBound(op.name, bits, int(low.min()), int(high.max())))
    return bounds


def within_int8(core: IntCore) -> set[str]:
    """Return the names of the tensors that no image makes exceed int8, so that none is clipped.

    Args:
        core: the integer core.
    """
    return {
        op.output
        for op, bound in zip(core.ops, layer_bounds(core), strict=True)
        if bound.low >= INT8_MIN and bound.high <= INT8_MAX
    }


def _accumulated(
    core: IntCore, op: IntConv | Op, ranges: Mapping[str, ChannelRange]
) -> tuple[ChannelRange, int]:
    """Return the range of an operation's accumulators, including zero padding, and the shift to
    int8.
    """
    inputs = [ranges[name] for name in op.inputs]
    if isinstance(op, IntConv):
        return _conv(core, op, inputs[0])
    if isinstance(op, Add):
        # A sum rises with each term, so its extremes are the sums of the ends.
        low = layer_sums(core, op, {name: ranges[name].low for name in op.inputs})
        high = layer_sums(core, op, {name: ranges[name].high for name in op.inputs})
        return ChannelRange(low.values, high.values), low.shift
    if isinstance(op, Mul):
        # A product is linear in each factor, so its extremes lie at the ends of both intervals.
        corners = np.array([a.astype(np.int64) * b for a, b in product(inputs[0], inputs[1])])
        shift = op_shifts(op, core.frac_bits)["shift_cut"]
        return ChannelRange(corners.min(0), corners.max(0)), shift
    if isinstance(op, AveragePool):
        assert op.kernel is not None  # noqa: S101 - resolved before anything is quantised
        factor, shift = mean_factor(op.kernel)
        area = op.kernel[0] * op.kernel[1]
        return ChannelRange(
            *(area * factor * end.astype(np.int64) for end in _padded(inputs[0]))
        ), shift
    if isinstance(op, Resize) and op.bilinear:
        # The weights of each pixel add up to 2^shift.
        _, shift = bilinear_weights(op.factor)
        return ChannelRange(*(end.astype(np.int64) << shift for end in inputs[0])), shift
    return _moved(core, op, inputs), 0


def _moved(core: IntCore, op: Op, inputs: list[ChannelRange]) -> ChannelRange:
    """Compute the range of an operation that only moves values or looks them up."""
    low, high = map(np.concatenate, zip(*inputs, strict=True))
    if isinstance(op, Pointwise):
        table = activation_table(op, core.frac_bits)
        spans = [table[a - INT8_MIN : b - INT8_MIN + 1] for a, b in zip(low, high, strict=True)]
        return ChannelRange(*(np.array([end(span) for span in spans]) for end in (np.min, np.max)))
    if isinstance(op, Shuffle):
        side = 1 if op.up else op.block
        maps = [op(np.tile(end[None, :, None, None], (1, 1, side, side)))[0] for end in (low, high)]
        return ChannelRange(maps[0].min((1, 2)), maps[1].max((1, 2)))
    return ChannelRange(low, high)


def _padded(source: ChannelRange) -> ChannelRange:
    """Return the range with the zeros that padding adds."""
    return ChannelRange(np.minimum(source.low, 0), np.maximum(source.high, 0))


def _conv(core: IntCore, op: IntConv, source: ChannelRange) -> tuple[ChannelRange, int]:
    low, high = _padded(source)
    weight = op.weight.astype(np.int64)
    accumulator_bits = op.accumulator_bits(core.frac_bits)
    bias = op.bias.astype(np.int64) << (accumulator_bits - op.bias_frac_bits)
    # A sum is largest where each positive weight reads its channel's high end and each negative
    # one the low end.
    shape = (op.groups, -1, weight.shape[1])
    up = np.maximum(weight, 0).sum((2, 3)).reshape(shape)
    down = np.minimum(weight, 0).sum((2, 3)).reshape(shape)
    low = low.reshape(op.groups, -1, 1)
    high = high.reshape(op.groups, -1, 1)
    least = (up @ low + down @ high).ravel() + bias
    most = (up @ high + down @ low).ravel() + bias
    (least, finer), (most, _) = (
        activated(end, op.activation, accumulator_bits) for end in (least, most)
    )
    return ChannelRange(least, most), accumulator_bits - core.frac_bits[op.output] + finer
