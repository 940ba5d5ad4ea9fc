"""Fill missing pixels from known ones nearby, before they enter a network."""

import numpy as np


def fill_from_nearest(pixels: np.ndarray, missing: np.ndarray, reach_px: int) -> np.ndarray:
    """Return (h, w) pixels where each `missing` one is a copy of a known one at most `reach_px`
    rows and columns away.

    A missing pixel gets the nearest known pixel of the row, then the nearest filled one of the
    column, or 0 if there is none in reach. A filled pixel therefore depends on nothing farther
    away, and a window gives exactly the same result as the whole image.
    """
    filled, missing = _along_rows(pixels, missing, reach_px)
    filled, missing = _along_rows(filled.T, missing.T, reach_px)
    return np.asarray(np.where(missing, 0, filled).T)


def _along_rows(
    pixels: np.ndarray, missing: np.ndarray, reach_px: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the filled pixels, and a mask of those without a known pixel in reach. Of two at the
    same distance the left one is used.
    """
    width = pixels.shape[1]
    # Without a known pixel on one side, its place is out of reach from every pixel.
    far = width + reach_px + 1
    here = np.arange(width)
    left = np.maximum.accumulate(np.where(missing, -far, here), axis=1)
    right = np.minimum.accumulate(np.where(missing, 2 * far, here)[:, ::-1], axis=1)[:, ::-1]
    nearest = np.where(here - left <= right - here, left, right)
    out_of_reach = np.abs(nearest - here) > reach_px
    return np.take_along_axis(pixels, np.where(out_of_reach, here, nearest), axis=1), out_of_reach
