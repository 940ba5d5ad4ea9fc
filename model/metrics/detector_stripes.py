"""Find lines with a different gain and dead lines among the measured lines of single detectors.

A scene cannot look like them, because the optics spread a line over several pixels. Every test here
compares a line with its neighbours, requires less than the share that blurred light would have
spread to them, and weights the difference by the noise and texture around.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import uniform_filter1d

from beers_deploy.model.metrics.detector_lines import REACH, LineBlocks
from beers_deploy.model.metrics.statistics import robust_deviation

PARITY_LINES = 63
"""Lines over which alternate lines are averaged; their pattern is `Phases`, and no gain of single
lines.
"""
SIGNIFICANT = 6.0
"""Significance limit in standard errors. Noise of 40 000 lines reaches it once in 10 000 images."""
CLEAR = 12.0
"""Standard errors within one block from which a part of a line is judged alone."""
SURE = 1.0
"""Standard errors by which a part of a line is alone."""
ASKEW = 0.3
"""The largest deviation of the lines around from the pattern of a single line, relative to the
deviation of that line.
"""
PART = 0.02
"""Least gain of a part of a line."""
AGREE = 0.75
"""Share of the blocks in which a line must be off to the same side."""
ISOLATED = 0.75
LEAST_ISOLATED = 0.55
"""Least isolation of a line that is measured well, and of any line; it is 1 for a detector.

For a thin bright line it is 0.70, 0.46, 0.27 and 0.02 if the MTF at Nyquist is 30, 20, 15 and 10 %
(a Gaussian centred on a pixel).
"""
SPREAD_SIGNIFICANT = 4.0
"""Standard errors of the covariance from which the spread of all lines is significant."""
ERRORS = 2.0
"""The number of standard errors in an interval of 95 %."""
LINES = 16
"""The least number of lines from which their spread is determined."""
WHITE = -0.35
"""Correlation of neighbouring second differences: -2/3 for independent detectors; it was above -0.1
for scenes.
"""
MAD_ERROR = 2.33
"""Relative standard error of a variance by the median absolute deviation of N numbers, times
sqrt(N).
"""
SECOND = 1.5
"""Variance of second differences x - (left + right) / 2 of independent numbers of variance 1."""


@dataclass(frozen=True)
class Line:
    """A single line of detectors (a column or row) that differs from its neighbours.

    Attributes:
        index: the number of the line.
        gain: the deviation of the line from its neighbours, as a share of the pixel value around
            it.
    """

    index: int
    gain: float


@dataclass(frozen=True)
class Stripes:
    """The faults of the lines of one direction, columns or rows, of an image.

    Attributes:
        spread: standard deviation of the gains of all lines, without noise, as a share of the pixel
            value; None if it cannot be determined.
        variance_error: the standard error of the square of `spread`, which is what is measured.
        significant: True if the spread is significant and relevant, and the lines deviate
            independently.
        off: single deviating lines, the largest deviation first.
        dead: numbers of the lines that are constant while their neighbours are not.
    """

    spread: float | None = None
    variance_error: float = 0.0
    significant: bool = False
    off: tuple[Line, ...] = ()
    dead: tuple[int, ...] = ()

    @property
    def spread_interval(self) -> tuple[float, float]:
        """The ends of the 95 % interval of `spread`; the lower one is 0 if the lines may be alike.

        Errors of the variance are symmetric. Those of its root are not where it is near 0.
        """
        variance = (self.spread or 0.0) ** 2
        reach = ERRORS * self.variance_error
        return math.sqrt(max(variance - reach, 0.0)), math.sqrt(variance + reach)

    def renumbered(self, numbers: Sequence[int]) -> "Stripes":
        """Return the same faults with the line of index i called `numbers[i]`."""
        off = tuple(replace(line, index=numbers[line.index]) for line in self.off)
        return replace(self, off=off, dead=tuple(sorted({numbers[index] for index in self.dead})))


def judge_lines(blocks: LineBlocks, least: float) -> Stripes:
    """Decide which lines of detectors are faulty, and how much all lines differ.

    Args:
        blocks: the measurements of all lines of one direction.
        least: the smallest relevant deviation, as a share of the pixel value.
    """
    measurable = np.isfinite(blocks.second) & np.isfinite(blocks.level)
    # A dead line is constant in all blocks where anything is known of it.
    unknown = ~(measurable | blocks.constant)
    dead = np.flatnonzero((blocks.constant | unknown).all(0) & blocks.constant.any(0))
    usable = measurable.any(1)
    if not usable.any():
        return Stripes(dead=tuple(dead.tolist()))
    level = blocks.level[usable]
    gains = blocks.second[usable] / level
    errors = blocks.error[usable] / level
    # Blocks without scatter have the error 0, by which weights would be divided.
    errors = np.maximum(errors, 1e-6)
    # Without the part that alternate lines nearby have in common.
    sign = 1 - 2.0 * (np.arange(gains.shape[1]) % 2)
    bound = 3 * np.nanmedian(np.abs(gains), axis=1, keepdims=True)
    alternating = np.clip(np.nan_to_num(gains) * sign, -bound, bound)
    size = min(PARITY_LINES, gains.shape[1])
    gains = gains - uniform_filter1d(alternating, size, axis=1, mode="nearest") * sign
    mean, error = _combined(gains, errors)
    spread, variance_error, significant = _spread(gains, errors)
    off = _single(mean, error, gains, errors, least)
    return Stripes(
        spread=spread,
        variance_error=variance_error,
        significant=significant and spread is not None and spread**2 - variance_error > least**2,
        off=tuple(line for line in off if line.index not in set(dead.tolist())),
        dead=tuple(dead.tolist()),
    )


def _combined(gains: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean over blocks and its standard error, widened where the blocks contradict each
    other.
    """
    weights = np.where(np.isfinite(gains), 1 / np.square(errors), 0)
    total = weights.sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.nansum(weights * gains, axis=0) / total
        free = np.maximum((weights > 0).sum(0) - 1, 1)
        scatter = np.nansum(weights * np.square(gains - mean), axis=0) / free
        # Blocks that contradict each other widen the error. Those that agree by chance do not
        # narrow it.
        return mean, np.sqrt(np.maximum(scatter, 1) / total)


def _spread(gains: np.ndarray, errors: np.ndarray) -> tuple[float | None, float, bool]:
    """Return the standard deviation of independent lines' gains, the error of its square, and
    whether it is significant.

    Two halves of the blocks share the detectors, but neither noise nor scene. Their covariance is
    robust: a quarter of the difference between the variances of sum and difference, by median
    absolute deviations.
    """
    if len(gains) < 2:
        return None, 0.0, False
    first, _ = _combined(gains[::2], errors[::2])
    other, _ = _combined(gains[1::2], errors[1::2])
    both = np.isfinite(first) & np.isfinite(other)
    if both.sum() < LINES:
        return None, 0.0, False
    covariance, error = _covariance(first[both], other[both])
    spread = float(np.sqrt(max(covariance, 0) / SECOND))
    # Constant lines have no error.
    if error == 0:
        return spread, 0.0, False
    pairs = both[:-1] & both[1:]
    crossed = ((first[:-1], other[1:]), (other[:-1], first[1:]))
    next_one = np.mean([_covariance(left[pairs], right[pairs])[0] for left, right in crossed])
    significant = covariance > SPREAD_SIGNIFICANT * error and next_one < WHITE * covariance
    return spread, error / SECOND, bool(significant)


def _covariance(first: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Return a robust covariance (Gnanadesikan and Kettenring 1972) and its standard error."""
    of_sum = robust_deviation(first + other) ** 2
    of_difference = robust_deviation(first - other) ** 2
    # Second differences of neighbouring lines are not independent, so half of their number counts.
    error = MAD_ERROR * np.hypot(of_sum, of_difference) / 4 / np.sqrt(max(len(first) / 2, 1))
    return (of_sum - of_difference) / 4, float(error)


def _single(
    mean: np.ndarray, error: np.ndarray, gains: np.ndarray, errors: np.ndarray, least: float
) -> list[Line]:
    """Return the lines that are off alone, the largest deviation first."""
    with np.errstate(invalid="ignore"):
        counts = np.isfinite(gains).sum(0)
        like = np.abs(gains - mean) < np.maximum(3 * errors, np.abs(mean) / 2)
        agree = (like & (np.sign(gains) == np.sign(mean))).sum(0) >= AGREE * np.maximum(counts, 2)
        off = (
            (np.abs(mean) > np.maximum(least, SIGNIFICANT * error))
            & agree
            & _alone(mean, error, -1.0)
        )
        clear = np.abs(gains) > np.maximum(CLEAR * errors, PART)
    # Some lines deviate in some of the blocks, such as a hot column below its hot pixel. Most
    # blocks contain no evidence of such a line, so light must be excluded in each of the others.
    alone = [_alone(*block, SURE) for block in zip(gains, errors, strict=True)]
    isolated = (clear & np.array(alone)).sum(0)
    partly = (isolated >= 2) & (4 * isolated >= 3 * clear.sum(0))
    # A line that is off in some blocks only is described by its largest deviation.
    farthest = np.argmax(np.abs(np.nan_to_num(gains)), axis=0)
    largest = np.where(off, mean, np.take_along_axis(gains, farthest[None], axis=0)[0])
    numbers = set[int]()
    lines = []
    for index in sorted(np.flatnonzero(off | partly), key=lambda index: -abs(largest[index])):
        # The neighbours of a line that is off are off by half of it, to the other side.
        if not numbers & {index - 1, index + 1}:
            numbers.add(int(index))
            lines.append(Line(int(index), float(largest[index])))
    return lines


def _alone(second: np.ndarray, error: np.ndarray, margin: float) -> np.ndarray:
    """Return True for lines that deviate alone, by a number of standard errors above `ISOLATED`.

    The second differences around a single line of gain g are (0, -g/2, g, -g/2, 0), and those of a
    blurred bright line fall off over five lines. With r and q, the sums over the next lines and the
    ones after them over -g, the isolation r - q is 1 for a detector.
    """
    padded = np.pad(second, REACH, constant_values=np.nan)
    beside = np.delete(sliding_window_view(padded, 2 * REACH + 1).T, REACH, axis=0)
    expected = np.array([0, 0, -1 / 2, -1 / 2, 0, 0])
    near = beside[2] + beside[3]
    far = beside[1] + beside[4]
    with np.errstate(invalid="ignore", divide="ignore"):
        isolation = (far - near) / second
        isolation_error = 2 * error / np.abs(second)
        slack = np.maximum(ASKEW * np.abs(second), 3 * error)
        like = np.all(np.abs(beside - expected[:, None] * second) < slack, axis=0)
        largest = np.all(np.abs(second) > np.abs(beside), axis=0)
        least = np.maximum(ISOLATED + margin * isolation_error, LEAST_ISOLATED)
        return np.asarray(like & largest & (isolation > least))
