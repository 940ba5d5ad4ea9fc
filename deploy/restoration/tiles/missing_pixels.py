"""Fill missing pixels from known ones nearby, so that a network has numbers to read there."""

import numpy as np


def fill_from_nearest(pixels: np.ndarray, missing: np.ndarray, reach_px: int) -> np.ndarray:
    """Fill missing pixels of one band with copies of known pixels nearby.

    A missing pixel gets the value of the nearest known pixel of its row, else that of the nearest
    pixel of its column which is known or was filled along its row, else 0. A filled pixel therefore
    depends on nothing farther away than `reach_px`, and a window gives exactly the same result as
    the whole image.

    Args:
        pixels: (h, w) values.
        missing: mask of the missing pixels, bool (h, w).
        reach_px: the largest distance, in rows and in columns, of the pixel that is copied.
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
    # If there is no known pixel on one side, its place is out of reach of every pixel.
    far = width + reach_px + 1
    here = np.arange(width)
    left = np.maximum.accumulate(np.where(missing, -far, here), axis=1)
    right = np.minimum.accumulate(np.where(missing, 2 * far, here)[:, ::-1], axis=1)[:, ::-1]
    nearest = np.where(here - left <= right - here, left, right)
    out_of_reach = np.abs(nearest - here) > reach_px
    return np.take_along_axis(pixels, np.where(out_of_reach, here, nearest), axis=1), out_of_reach
