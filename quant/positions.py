"""Power-of-two scales: a tensor at position p holds whole multiples of 2^-p in [-128, 127] (UG1414 3.5, vai_q).

Positions are chosen by least squared error, not by the largest value: a few clipped outliers cost less than a
coarser step for everything else.
"""

from dataclasses import dataclass

import numpy as np

from profiles.target import TargetProfile

INT8_MIN, INT8_MAX = -128, 127
CANDIDATES = 6
"""Positions tried: the one that clips nothing, and the finer ones after it."""


def quantise(values: np.ndarray, position: int) -> np.ndarray:
    """Whole numbers in [-128, 127], rounded half away from zero as the DPU does for weights and bias."""
    scaled = np.asarray(values, dtype=np.float64) * 2.0**position
    rounded = np.sign(scaled) * np.floor(np.abs(scaled) + 0.5)
    return np.asarray(np.clip(rounded, INT8_MIN, INT8_MAX).astype(np.int8))


def coarsest_position(max_abs: float) -> int:
    """The finest position that clips nothing (0 for a tensor of zeros)."""
    return int(np.floor(np.log2(INT8_MAX / max_abs))) if max_abs > 0 else 0


def squared_errors(values: np.ndarray, first: int) -> np.ndarray:
    """Sum of squared rounding and clipping errors at positions first .. first + CANDIDATES - 1, float64."""
    errors = np.empty(CANDIDATES)
    for k in range(CANDIDATES):
        scale = np.float32(2.0 ** (first + k))
        scaled = values * scale
        difference = np.clip(np.rint(scaled), INT8_MIN, INT8_MAX) - scaled
        errors[k] = float(np.vdot(difference, difference)) / float(scale) ** 2
    return errors


def best_position(values: np.ndarray) -> int:
    """The least-squares position of one array."""
    first = coarsest_position(float(np.abs(values).max(initial=0.0)))
    return first + int(np.argmin(squared_errors(np.asarray(values, dtype=np.float32), first)))


@dataclass(frozen=True)
class Shifts:
    """The shift windows of the DPU's arithmetic (UG1414 3.5 and the quantiser's source, Vitis-AI 3.0)."""

    cut: tuple[int, int] = (0, 16)
    bias: tuple[int, int] = (0, 16)  # below 0 the int8 bias would be finer than the accumulator's unit
    read: tuple[int, int] = (0, 15)
    write: tuple[int, int] = (-15, 15)


SHIFTS = Shifts()


def target_shifts(target: TargetProfile) -> Shifts:
    """The windows that a target's profile states.

    Raises:
        ProfileError: it states none: it has no DPU.
    """

    def window(key: str) -> tuple[int, int]:
        constant = target.constant("numbers", key)
        return int(constant.low), int(constant.high)

    bias = 0, int(target.value("numbers", "shift_bias_max"))
    return Shifts(window("shift_cut"), bias, window("shift_read"), window("shift_write"))


def clamp(value: int, window: tuple[int, int]) -> int:
    """The nearest value within the window."""
    return min(max(value, window[0]), window[1])
