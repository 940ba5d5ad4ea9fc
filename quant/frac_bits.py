"""Round real values to int8, and choose the power-of-two scale of a tensor by its squared error.

A tensor with n fractional bits holds integer multiples of its scale 2^-n, in [-128, 127] times that
(UG1414 3.5, vai_q). A finer scale has more fractional bits.
"""

import numpy as np

INT8_MIN = -128
INT8_MAX = 127
CANDIDATES = 6
"""The number of scales that are tried: the one that clips nothing, and the next finer ones."""


def quantize(values: np.ndarray, frac_bits: int) -> np.ndarray:
    """Round real values to int8: q = round(values * 2^frac_bits), half away from zero, clipped to
    [-128, 127].

    AMD's quantiser rounds weights and biases so. Activations are rounded by `rounded_to` instead.

    Args:
        values: real values of any shape.
        frac_bits: the number n of fractional bits of the scale 2^-n.

    Returns:
        The integers, int8, in the shape of `values`.
    """
    scaled = np.asarray(values, dtype=np.float64) * 2.0**frac_bits
    # AMD's quantiser rounds these away from zero, unlike activations, which round half up.
    units = np.sign(scaled) * np.floor(np.abs(scaled) + 0.5)
    return np.asarray(np.clip(units, INT8_MIN, INT8_MAX).astype(np.int8))


def unclipped_frac_bits(max_abs: float) -> int:
    """Return the number n of fractional bits of the finest scale 2^-n at which int8 clips nothing.

    Args:
        max_abs: the largest absolute value of the tensor.

    Returns:
        The largest n with max_abs * 2^n <= 127; 0 for a tensor of zeros.
    """
    return int(np.floor(np.log2(INT8_MAX / max_abs))) if max_abs > 0 else 0


CACHED = 2**16
"""The number of values whose intermediate results fit a core's cache, which is
three times faster.
"""


def squared_errors(values: np.ndarray, first: int) -> np.ndarray:
    """Compute the sum of squared errors of int8, rounding and clipping together, for six scales.

    Args:
        values: real values of any shape.
        first: the number of fractional bits of the coarsest scale that is tried.

    Returns:
        (CANDIDATES,) float64, in the square of the values' unit: the sums for scales of `first` to
        `first` + CANDIDATES - 1 fractional bits.
    """
    errors = np.zeros(CANDIDATES)
    for part in np.array_split(values, max(values.size // CACHED, 1)):
        for k in range(CANDIDATES):
            scale = np.float32(2.0 ** (first + k))
            scaled = part * scale
            # The rounding of ties does not matter here: either way the error is half a unit.
            difference = np.clip(np.rint(scaled), INT8_MIN, INT8_MAX) - scaled
            errors[k] += float(np.vdot(difference, difference)) / float(scale) ** 2
    return errors


def best_frac_bits(values: np.ndarray) -> int:
    """Return the number of fractional bits of the power-of-two scale with the least squared error
    in int8.

    It tries the finest scale that clips nothing, and the next finer ones (CANDIDATES scales).

    Args:
        values: real values of any shape.
    """
    first = unclipped_frac_bits(float(np.abs(values).max(initial=0.0)))
    return first + int(np.argmin(squared_errors(np.asarray(values, dtype=np.float32), first)))
