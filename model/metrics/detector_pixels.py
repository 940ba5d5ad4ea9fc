"""Find single pixels that no blurred image can have: dead ones, hot ones, hits of particles.

The optics spread a point over its neighbours. If the MTF at Nyquist is 30 % (a Gaussian), the four
pixels next to the brightest one of a point source hold on average 0.22 of its excess, wherever it
lies in that pixel. With a lower MTF they hold more. A faulty pixel does not affect its neighbours.
"""

from functools import reduce
from itertools import product

import numpy as np

PATCH_PX = 4
"""Pixels around one that are compared with it."""
LEAST = 9.0
"""The least deviation of a wrong pixel, in standard deviations of the texture and
noise around it.
"""
ISOLATED = 0.75
SURE = 1.5
"""The number of standard errors that are subtracted from the isolation of a pixel before it is
compared with its limit. The isolation is 1 for a detector fault.

For a point of light it is 0.70, 0.46, 0.27 and 0.02 if the MTF at Nyquist is 30, 20, 15 and 10 % (a
Gaussian centred on a pixel).
"""
DEAD = 0.3
BRIGHT = 0.6
DARK = 10.0
"""A pixel is dead if it is below the first share of its ground and all neighbours are above the
second, because no shadow is that narrow. Ground below this number of standard deviations is too
dark to decide.
"""
CANDIDATE = 2.0
"""Multiple of the mean step between neighbours by which a candidate lies outside of all its
neighbours.
"""
CUT = 0.3
CUT_NOISE = 0.03
CUT_STEPS = 3.0
"""Share of equal pixels from which the ground counts as clipped; and the noise that is then
assumed, over the ground and in steps.
"""
QUIET = 0.001
"""Noise over the ground that is assumed at least."""
MIN_VALID = 60
"""The minimum number of valid pixels among the 81 around a pixel."""


def wrong_pixels(pixels: np.ndarray, step: float = 0.0) -> np.ndarray:
    """Find single pixels that a fault or a particle, and not light, has made brighter or darker
    than their neighbours.

    Pixels within `PATCH_PX` of a border are not evaluated.

    Args:
        pixels: (h, w) float32, NaN where they are unknown.
        step: the difference between successive values that pixels can have, such as 1 DN; 0 if it
            is not known.

    Returns:
        The rows and columns (n, 2) of the wrong pixels, in the order of rows.
    """
    size = 2 * PATCH_PX + 1
    if min(pixels.shape) < size:
        return np.empty((0, 2), np.int64)
    # Pixels that lie clearly above, or below, all of their eight neighbours.
    height, width = pixels.shape
    centres = pixels[PATCH_PX : height - PATCH_PX, PATCH_PX : width - PATCH_PX]
    neighbours = [
        pixels[
            PATCH_PX + down : height - PATCH_PX + down,
            PATCH_PX + across : width - PATCH_PX + across,
        ]
        for down, across in product((-1, 0, 1), repeat=2)
        if down or across
    ]
    above = reduce(np.maximum, neighbours)
    below = reduce(np.minimum, neighbours)
    steps = np.abs(np.diff(centres, axis=1))
    least = CANDIDATE * float(np.nanmean(steps)) if np.isfinite(steps).any() else 0.0
    out = np.maximum(centres - above, below - centres)
    places = np.argwhere((out > 0) & (out >= least)) + PATCH_PX
    windows = np.lib.stride_tricks.sliding_window_view(pixels, (size, size))
    patches = windows[places[:, 0] - PATCH_PX, places[:, 1] - PATCH_PX].astype(np.float64)
    sufficient = np.isfinite(patches).sum((1, 2)) > MIN_VALID
    places = places[sufficient]
    patches = patches[sufficient]
    return np.asarray(places[_wrong(patches, step)]) if len(places) else places


def _wrong(patches: np.ndarray, step: float) -> np.ndarray:
    """Return True for patches (n, 9, 9) whose centre cannot be light; NaN is unknown.

    The second difference along both axes, x - (its 4 sides) / 2 + (its 4 diagonals) / 4, removes
    planes and edges. A single pixel of excess e leaves e there, -e/2 next to it and 0 two pixels
    away. A point of light leaves less next to it and more two pixels away.
    """
    along = patches[:, 1:-1] - (patches[:, :-2] + patches[:, 2:]) / 2
    both = along[:, :, 1:-1] - (along[:, :, :-2] + along[:, :, 2:]) / 2
    centre = both[:, 3, 3]
    near = both[:, [2, 4, 3, 3], [3, 3, 2, 4]].mean(1)
    far = both[:, [1, 5, 3, 3], [3, 3, 1, 5]].mean(1)
    ring = np.ones((7, 7), bool)
    ring[2:5, 2:5] = False
    scatter = np.sqrt(np.nanmean(np.square(both[:, ring]), axis=1))
    ground = np.nanmedian(patches[:, 2:7, 2:7].reshape(len(patches), 25), axis=1)
    # Rounding hides the noise of a quiet image, and an end of the range cuts it off. Neither may be
    # taken for no noise.
    is_cut_off = (patches == ground[:, None, None]).mean((1, 2)) > CUT
    floor = np.where(
        is_cut_off,
        CUT_NOISE * np.abs(ground) + CUT_STEPS * step,
        np.maximum(step, QUIET * np.abs(ground)),
    )
    scatter = np.maximum(scatter, floor)
    middle = patches[:, 3:6, 3:6].reshape(len(patches), 9)
    around = np.delete(middle, 4, axis=1)
    # A star that full scale cuts off is lower than its sides suggest, and still above them. That is
    # no fault.
    outward = np.where(middle[:, 4] > np.nanmax(around, axis=1), centre, -centre)
    with np.errstate(invalid="ignore", divide="ignore"):
        isolation = 2 * (far - near) / centre
        isolation_error = 1.5 * scatter / np.abs(centre)
        isolated = (outward > LEAST * scatter) & (isolation - SURE * isolation_error > ISOLATED)
    dead = (
        (middle[:, 4] < DEAD * ground)
        & (around.min(1) > BRIGHT * ground)
        & (ground > DARK * scatter)
    )
    return np.asarray(np.isfinite(isolation) & (isolated | dead))
