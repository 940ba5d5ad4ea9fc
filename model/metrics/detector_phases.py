"""Find a fixed pattern of 2 x 2 pixels: alternate rows, alternate columns, or a checkerboard.

Two or four read-out channels, or pixels that share their electronics, differ in gain or offset. The
pattern has the period of two pixels, where optics leave little contrast and no scene keeps its
phase. It may change slowly over the image, and even its sign: so it is measured in sections.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import convolve1d, maximum_filter

SMOOTH = np.array([1, 4, 6, 4, 1], np.float32) / 16
"""A filter that removes a pattern of period 2 and preserves smooth structure."""
EDGE_PX = 2
"""The number of pixels along a border that the filter cannot evaluate."""
CLIP = 2.0
"""Multiple of the mean absolute deviation at which texture is clipped."""
TEXTURE = 2.0
"""Factor on the standard error: neighbouring deviations of texture are no independent numbers."""
SIGNIFICANT = 4.0
"""Standard errors from which a section counts."""
MANY = 0.2
"""Share of the sections that must show the pattern significantly."""
PATTERNS = ("alternate columns", "alternate rows", "checkerboard")
COLOUR = 0.05
"""Difference over the level from which the pattern is rather a mosaic of colour filters."""


@dataclass(frozen=True)
class Pattern:
    """The strength of one fixed pattern with a period of two pixels in an image.

    Attributes:
        name: one of `PATTERNS`.
        difference: difference between the two kinds of pixels, as a share of their mean value: the
            root mean square over the sections of the image, without noise.
        largest: the largest difference of a section in which it is significant; 0 if there is none.
        significant: True if `difference` exceeds the smallest relevant one, and enough sections
            show the pattern significantly.
    """

    name: str
    difference: float
    largest: float
    significant: bool


def measure_phases(pixels: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measure the fixed patterns with a period of two pixels in one section of an image.

    Args:
        pixels: (h, w) float32. The first row and column have even numbers in the image.
        valid: (h, w) bool, True for measured pixels: neither missing nor at an end of full scale.

    Returns:
        The differences between the two kinds of pixels as shares of their mean value, (3,), in the
        order of `PATTERNS`; and their standard errors, (3,). NaN if the section is too small or
        dark.
    """
    nothing = np.full(3, np.nan), np.full(3, np.nan)
    if min(pixels.shape) < 8 * EDGE_PX:
        return nothing
    smooth = convolve1d(convolve1d(pixels, SMOOTH, axis=0), SMOOTH, axis=1)
    inside_border = (slice(EDGE_PX, -EDGE_PX),) * 2
    residuals = (pixels - smooth)[inside_border]
    # The filter spreads invalid pixels over its reach.
    mask = np.ones(residuals.shape, bool)
    if not valid.all():
        mask = ~maximum_filter(~valid, 2 * EDGE_PX + 1)[inside_border]
    if mask.mean() < 1 / 4:
        return nothing
    level = float(np.mean(smooth[inside_border][mask], dtype=np.float64))
    if level <= 0:
        return nothing
    reach = CLIP * float(np.mean(np.abs(residuals[mask])))
    clipped = np.where(mask, np.clip(residuals, -reach, reach), 0)
    inside = max(int((mask & (np.abs(residuals) <= reach)).sum()), 1)
    down, across = (1 - 2.0 * (np.arange(side) % 2) for side in residuals.shape)
    signs = ((np.ones_like(down), across), (down, np.ones_like(across)), (down, across))
    sums = np.array([float(rows @ clipped @ columns) for rows, columns in signs])
    error = TEXTURE * float(np.sqrt(np.square(clipped).sum(dtype=np.float64))) / inside
    # Twice the amplitude: the difference between the two kinds of pixels.
    return 2 * sums / inside / level, np.full(3, 2 * error / level)


def judge_phases(
    measured: Sequence[tuple[np.ndarray, np.ndarray]], least: float
) -> tuple[Pattern, ...]:
    """Decide from all sections of an image which fixed patterns it has.

    Args:
        measured: the measurement of each section, as `measure_phases` returns it.
        least: the smallest relevant difference, as a share of the mean value.

    Returns:
        One result for each pattern that could be measured.
    """
    if not measured:
        return ()
    differences, errors = (np.array(values) for values in zip(*measured, strict=True))
    patterns = []
    for number, name in enumerate(PATTERNS):
        mask = np.isfinite(differences[:, number])
        if not mask.any():
            continue
        difference = differences[mask, number]
        error = errors[mask, number]
        # The squares include the noise. Its variance is subtracted, without the factor for texture.
        power = float(np.mean(np.square(difference) - np.square(error / TEXTURE)))
        strong = np.abs(difference) > SIGNIFICANT * error
        rms = float(np.sqrt(max(power, 0)))
        largest = float(np.max(np.abs(difference[strong]), initial=0))
        patterns.append(Pattern(name, rms, largest, bool(rms > least and strong.mean() >= MANY)))
    return tuple(patterns)
