"""Bound the integers of an INT8 network over all images, by interval arithmetic on its weights."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from beers_deploy.quant.core import IntConv, IntCore
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

Range = tuple[np.ndarray, np.ndarray]
"""The smallest and the largest integer of each channel."""


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
    first, last = (np.repeat(end, channels) for end in core.host_part.encoding.limits)
    ranges = {PLANES: (first, last)}
    bounds = []
    for op in core.ops:
        low, high, shift = _accumulated(core, op, ranges)
        bits = float(np.log2(max(int(np.abs(low).max()), int(np.abs(high).max()), 1)))
        low, high = (rounded(end, shift, half_even=False)[0] for end in (low, high))
        ranges[op.output] = saturated(low), saturated(high)
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


Accumulated = tuple[np.ndarray, np.ndarray, int]
"""The interval of the accumulators, including zero padding, and the shift to int8."""


def _accumulated(core: IntCore, op: IntConv | Op, ranges: Mapping[str, Range]) -> Accumulated:
    inputs = [ranges[name] for name in op.inputs]
    if isinstance(op, IntConv):
        return _conv(core, op, inputs[0])
    if isinstance(op, Add):
        # A sum rises with each term, so its extremes are the sums of the ends.
        lows, highs = ({name: ranges[name][k] for name in op.inputs} for k in (0, 1))
        low, shift, *_ = layer_sums(core, op, lows)
        return low, layer_sums(core, op, highs)[0], shift
    if isinstance(op, Mul):
        # A product is linear in each factor, so its extremes lie at the ends of both intervals.
        corners = np.array([a.astype(np.int64) * b for a, b in product(inputs[0], inputs[1])])
        shift = sum(core.frac_bits[name] for name in op.inputs) - core.frac_bits[op.output]
        return corners.min(0), corners.max(0), shift
    if isinstance(op, AveragePool):
        assert op.kernel is not None  # noqa: S101 - resolved before anything is quantised
        factor, shift = mean_factor(op.kernel)
        low, high = (
            op.kernel[0] * op.kernel[1] * factor * end.astype(np.int64)
            for end in _padded(inputs[0])
        )
        return low, high, shift
    if isinstance(op, Resize) and op.bilinear:
        # The weights of each pixel add up to 2^shift.
        _, shift = bilinear_weights(op.factor)
        low, high = (end.astype(np.int64) << shift for end in inputs[0])
        return low, high, shift
    low, high = _moved(core, op, inputs)
    return low, high, 0


def _moved(core: IntCore, op: Op, inputs: list[Range]) -> Range:
    """Compute the range of an operation that only moves values or looks them up."""
    low, high = (np.concatenate([ends[k] for ends in inputs]) for k in (0, 1))
    if isinstance(op, Pointwise):
        table = activation_table(op, core.frac_bits)
        spans = [table[a - INT8_MIN : b - INT8_MIN + 1] for a, b in zip(low, high, strict=True)]
        return np.array([span.min() for span in spans]), np.array([span.max() for span in spans])
    if isinstance(op, Shuffle):
        side = 1 if op.up else op.block
        maps = [op(np.tile(end[None, :, None, None], (1, 1, side, side)))[0] for end in (low, high)]
        return maps[0].min((1, 2)), maps[1].max((1, 2))
    return low, high


def _padded(ends: Range) -> Range:
    return np.minimum(ends[0], 0), np.maximum(ends[1], 0)


def _conv(core: IntCore, op: IntConv, source: Range) -> Accumulated:
    low, high = _padded(source)
    weight = op.weight.astype(np.int64)
    product_bits = op.weight_frac_bits + core.frac_bits[op.input]
    bias = op.bias.astype(np.int64) << (product_bits - op.bias_frac_bits)
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
        activated(end, op.activation, product_bits) for end in (least, most)
    )
    return least, most, product_bits - core.frac_bits[op.output] + finer
