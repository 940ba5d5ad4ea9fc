"""What the integer core can compute over all images: intervals of whole numbers through its own weights.

No accumulator leaves its interval, so one whose interval fits int32 cannot overflow; a result whose interval stays
inside int8 cannot saturate. Clipping makes each layer start from int8 again, so that bounds do not grow with depth.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from quant.core import IntConv, IntCore
from quant.graph import CORRECTION, Add
from quant.planes import COARSE_MAX, PLANES, QUARTER, STEP
from quant.positions import INT8_MAX, INT8_MIN

PLANE_LOW = np.array([0, -STEP // 2, -STEP // 2 // QUARTER])
PLANE_HIGH = np.array([COARSE_MAX, STEP - 1, STEP // QUARTER])

Range = tuple[np.ndarray, np.ndarray]
"""Smallest and largest whole number of each channel."""


@dataclass(frozen=True)
class LayerBound:
    """What one operation can do, over all images.

    Attributes:
        name: of the operation.
        bits: that its accumulator needs at most, without the sign.
        low: of the result before it is clipped to int8.
        high: likewise.
    """

    name: str
    bits: float
    low: int
    high: int

    @property
    def saturates(self) -> bool:
        """Whether any image might bring a result to int8's ends."""
        return self.low <= INT8_MIN or self.high >= INT8_MAX


def layer_bounds(core: IntCore) -> list[LayerBound]:
    """Of every operation, in order."""
    ranges: dict[str, Range] = {PLANES: _planes(core)}
    bounds = []
    for op in core.ops:
        low, high, shift = _conv(core, op, ranges) if isinstance(op, IntConv) else _add(core, op, ranges)
        bits = float(np.log2(max(int(np.abs(low).max()), int(np.abs(high).max()), 1)))
        low, high = _shifted(low, shift), _shifted(high, shift)
        ranges[op.output] = np.clip(low, INT8_MIN, INT8_MAX), np.clip(high, INT8_MIN, INT8_MAX)
        bounds.append(LayerBound(op.name, bits, int(low.min()), int(high.max())))
    return bounds


def saturable(core: IntCore) -> Mapping[str, bool]:
    """Which operations might saturate on some image."""
    return {bound.name: bound.saturates for bound in layer_bounds(core)}


def correction_bound(core: IntCore, gain: int) -> float:
    """The largest size of the correction, of full scale, where its last channel counts `gain` times."""
    low, high = layer_bounds(core)[-1].low, layer_bounds(core)[-1].high
    size = max(min(high, INT8_MAX), -max(low, INT8_MIN))
    return size * core.scale(CORRECTION) * (gain if core.output_channels == 2 else 1)


def _planes(core: IntCore) -> Range:
    first = core.ops[0]
    count = first.weight.shape[1] if isinstance(first, IntConv) else 1
    return PLANE_LOW[:count], PLANE_HIGH[:count]


def _conv(core: IntCore, op: IntConv, ranges: dict[str, Range]) -> tuple[np.ndarray, np.ndarray, int]:
    """The accumulators' interval, zero padding included, and the shift to int8."""
    low, high = np.minimum(ranges[op.input][0], 0), np.maximum(ranges[op.input][1], 0)
    weight = op.weight.astype(np.int64)
    up, down = np.maximum(weight, 0).sum((2, 3)), np.minimum(weight, 0).sum((2, 3))
    product = op.weight_position + core.positions[op.input]
    bias = op.bias.astype(np.int64) << (product - op.bias_position)
    least, most = up @ low + down @ high + bias, up @ high + down @ low + bias
    if op.relu:
        least, most = np.maximum(least, 0), np.maximum(most, 0)
    return least, most, product - core.positions[op.output]


def _add(core: IntCore, op: Add, ranges: dict[str, Range]) -> tuple[np.ndarray, np.ndarray, int]:
    finest = max(core.positions[name] for name in op.inputs)
    low, high = (
        sum(ranges[name][end].astype(np.int64) << (finest - core.positions[name]) for name in op.inputs)
        for end in (0, 1)
    )
    return np.asarray(low), np.asarray(high), finest - core.positions[op.output]


def _shifted(sums: np.ndarray, shift: int) -> np.ndarray:
    return sums << -shift if shift <= 0 else (sums + (1 << (shift - 1))) >> shift
