"""Measure how each line of detectors in one band differs from its neighbours, and find constant
lines.

A faulty detector affects one column (pushbroom), one row or one pixel, and not its neighbours. A
line is measured in several blocks along it: detector faults repeat in all blocks, and scenes do
not. `detector_stripes` evaluates the measurements.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

ROUNDS = 4
"""The number of iterations of the location estimate; it moves by at most three times its clipping
range in each.
"""
FEW = 8
"""A line with fewer valid pixels than this cannot be measured."""
LEVEL_LINES = 9
"""Lines over whose median a line's level is taken, so that its own fault does not matter."""
REACH = 3
"""A single line must be the largest within this number of lines on either side. Lines this close to
a border are not evaluated.
"""


class LineBlocks(NamedTuple):
    """Lines of detectors (columns or rows), each measured in several blocks along it.

    Every array is (blocks, lines), NaN where nothing could be measured.

    Attributes:
        second: each line less the mean of its two neighbours, in pixel values.
        error: the standard error of `second`, from the scatter within the block.
        level: the median pixel value of the lines around.
        constant: bool, True where all pixels of a line in the block have one value, and those of
            the neighbours do not.
    """

    second: np.ndarray
    error: np.ndarray
    level: np.ndarray
    constant: np.ndarray

    def of(self, lines: slice) -> "LineBlocks":
        """Return the measurements of a range of lines, with all their blocks."""
        return LineBlocks(*(array[:, lines] for array in self))


def join_blocks(blocks: Sequence[LineBlocks], axis: int = 0) -> LineBlocks:
    """Concatenate measurements of blocks.

    Args:
        blocks: measurements, as `measure_lines` returns them.
        axis: 0 for blocks of the same lines, one behind the other; 1 for other lines of equally
            many blocks.

    Returns:
        The measurements (blocks, lines) of all of them.
    """
    return LineBlocks(*(np.concatenate(arrays, axis) for arrays in zip(*blocks, strict=True)))


def measure_lines(pixels: np.ndarray, valid: np.ndarray) -> LineBlocks:
    """Measure how each column of one block of an image differs from its two neighbours.

    Args:
        pixels: (h, w) float32, NaN where they are missing.
        valid: (h, w) bool, True for measured pixels: neither missing nor at an end of full scale.

    Returns:
        Measurements of one block, arrays (1, w) each. `second` and `error` are NaN in the outermost
        columns, and in all columns of a block narrower than 7 pixels.
    """
    rows, columns = pixels.shape
    constant = constant_columns(pixels)
    nothing = np.full((1, columns), np.nan)
    if columns < 2 * REACH + 1:
        return LineBlocks(nothing, nothing, nothing, constant[None])
    second = pixels[:, 1:-1] - (pixels[:, :-2] + pixels[:, 2:]) / 2
    mask = valid[:, 1:-1] & valid[:, :-2] & valid[:, 2:]
    located, error = (
        np.pad(array, 1, constant_values=np.nan)[None] for array in _location(second, mask)
    )
    count = valid.sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        level = np.where(4 * count >= rows, pixels.sum(0, dtype=np.float64, where=valid) / count, 0)
        around = median_filter(level, LEVEL_LINES, mode="nearest")
        return LineBlocks(
            located, error, np.where(around > 0, around, np.nan)[None], constant[None]
        )


def _location(values: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the robust location of the columns of (h, w) values by Huber's estimator, and its
    standard error.

    A median would be one of the few values that integers leave; a mean follows the edges of the
    scene.
    """
    count = mask.sum(0, dtype=np.float32)
    values = values if mask.all() else np.where(mask, values, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        reach = 2 * np.abs(values).sum(0) / count
        centre = np.zeros(values.shape[1], np.float32)
        for _ in range(ROUNDS):
            residuals = values - centre
            inside = np.maximum(
                (mask & (np.abs(residuals) <= reach)).sum(0, dtype=np.float32), count / 3
            )
            clipped = np.clip(residuals, -reach, reach) * mask
            centre = centre + clipped.sum(0) / inside
            reach = 2 * np.abs(clipped).sum(0) / count
        error = np.sqrt(np.square(clipped).sum(0)) / inside
    few = count < max(len(values) / 4, FEW)
    return np.where(few, np.nan, centre), np.where(few, np.nan, error)


def constant_columns(pixels: np.ndarray) -> np.ndarray:
    """Return True for each column of (h, w) pixels that is constant while its neighbours vary.

    Two constant columns next to each other count as well. NaN marks a missing pixel, which is
    ignored.
    """
    constant = np.fmax.reduce(pixels, axis=0) == np.fmin.reduce(pixels, axis=0)
    counts = np.isfinite(pixels).sum(0)
    candidates = constant & (counts >= FEW)
    varying = ~constant & (counts > 0)
    left = np.roll(varying, 1)
    right = np.roll(varying, -1)
    # np.roll wraps around: a border has no neighbour.
    left[0] = right[-1] = False
    pair = candidates & np.roll(candidates, -1) & left & np.roll(right, -1)
    pair[-1] = False
    return np.asarray((candidates & left & right) | pair | np.roll(pair, 1))
