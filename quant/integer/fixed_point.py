"""The DPU's fixed-point constants: what it has for a mean, a bilinear weight, 6 and a table of an activation."""

from collections.abc import Mapping

import numpy as np

from quant.core import INT8_MAX, INT8_MIN
from quant.graph import Pointwise

MEANS = {(3, 3): (7, 6), (5, 5): (10, 8), (6, 6): (7, 8), (3, 6): (7, 7), (6, 3): (7, 7), (7, 7): (21, 10)}
MEANS[14, 14] = (21, 12)
"""Kernels whose factors the DPU's quantiser states (Vitis-AI 3.0, nndct_shared)."""


def mean_factor(kernel: tuple[int, int]) -> tuple[int, int]:
    """(m, s), m in int8, so that the DPU makes a window's mean of its sum by m / 2^s."""
    if kernel in MEANS:
        return MEANS[kernel]
    count = kernel[0] * kernel[1]
    shifts = range(int(np.ceil(np.log2(INT8_MAX * count))))
    return min(
        ((round(2**s / count), s) for s in shifts), key=lambda found: abs(found[0] / 2 ** found[1] - 1 / count)
    )


def bilinear_weights(factor: int) -> tuple[np.ndarray, int]:
    """Whole weights (factor^2, 3, 3) of each phase of a bilinear enlargement by 2 or 4, and the shift behind them."""
    places = (np.arange(factor) + 0.5) / factor - 0.5  # half-pixel centres, in input pixels
    taps = np.stack([np.maximum(-places, 0), 1 - np.abs(places), np.maximum(places, 0)], 1) * 2 * factor
    whole = np.einsum("yi,xj->yxij", taps, taps).reshape(factor**2, 3, 3)
    return whole.astype(np.int8), 2 * int(np.log2(2 * factor))


def six_in_units(frac_bits: int) -> int:
    """6 in whole multiples of 2^-n, or int8's end."""
    return min(int(np.floor(6 * 2.0**frac_bits + 0.5)), INT8_MAX)


def activation_table(op: Pointwise, frac_bits: Mapping[str, int]) -> np.ndarray:
    """What an activation makes of every int8 value from -128 on: (256,) int16, rounded half up, clipped."""
    values = op.activation(np.arange(INT8_MIN, INT8_MAX + 1) * 2.0 ** -frac_bits[op.input])
    units = np.floor(values * 2.0 ** frac_bits[op.output] + 0.5)
    return np.asarray(np.clip(units, INT8_MIN, INT8_MAX), np.int16)
