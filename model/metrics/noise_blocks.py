"""Measure the energy of blocks of an image by spatial frequency: low frequencies are structure, the
highest are noise.

The blur of an instrument leaves almost no texture in the corners of the spectrum, beyond 0.55
cycles per pixel, whereas noise is white.
"""

import math
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

SIDE_PX = 16
PART_BLOCKS = 4
SLOW = 0.2
FINE = 0.55
"""The end of the waves that are structure, and the beginning of those that are noise, in cycles per
pixel.
"""
SPECTRUM = (0.3, 0.4, 0.5, 0.55, 0.6, 0.65, 0.7071)
"""Ends of the bands in which noise is reported, in cycles per pixel; the last is the corner of the
spectrum.
"""
MIDDLE = SPECTRUM.index(0.5)
"""The number of the band of middle frequencies, from 0.5 to 0.55."""
ROUNDING = 1 / 12
"""Variance that rounding to whole digital numbers adds, DN^2."""


class Blocks(NamedTuple):
    """N blocks of 16 x 16 pixels of images: their brightness, and their energy by spatial frequency
    after subtracting a plane from each.

    An energy is a mean square in DN^2. For white noise each is the variance of the noise.
    Frequencies are in cycles per pixel.

    Attributes:
        mean: (N,) the mean of each block in DN.
        structure: (N,) energy of the waves up to 0.2 cycles per pixel.
        fine: (N,) energy of the waves beyond 0.55.
        spectrum: (N, 6) energy of the waves between the frequencies of SPECTRUM.
        part: (N,) number of the part of 4 x 4 blocks that a block lies in; images have different
            parts.
    """

    mean: np.ndarray
    structure: np.ndarray
    fine: np.ndarray
    spectrum: np.ndarray
    part: np.ndarray

    def only(self, mask: np.ndarray) -> "Blocks":
        """Return the blocks where `mask` (N,) is True."""
        return Blocks(*(column[mask] for column in self))

    def noise(self, fit: np.ndarray) -> np.ndarray:
        """Return the variance (N,) of the noise of each block by a fitted line, at least the
        variance of rounding.

        Args:
            fit: the numbers of the line, alpha and beta first.
        """
        return np.asarray(np.maximum(fit[0] * self.mean + fit[1], ROUNDING))


def join(images: Sequence[Blocks]) -> Blocks:
    """Join the blocks of several images; parts of different images get different numbers."""
    starts = np.cumsum([0] + [int(b.part.max(initial=-1)) + 1 for b in images])
    renumbered = [b._replace(part=b.part + start) for b, start in zip(images, starts, strict=False)]
    return Blocks(*(np.concatenate(column) for column in zip(*renumbered, strict=True)))


def cut_blocks(image: np.ndarray, clipped_at: float) -> Blocks:
    """Cut an image into blocks side by side and measure them.

    Args:
        image: digital numbers (H, W).
        clipped_at: the smallest digital number that counts as clipped. Blocks with a clipped pixel,
            or with one of 0, are left out.
    """
    pixels, part = _side_by_side(image)
    valid = ((pixels > 0) & (pixels < clipped_at)).all((1, 2))
    pixels = pixels[valid]
    return _measured(pixels.mean((1, 2)), pixels, part[valid])


def cut_pair(first: np.ndarray, second: np.ndarray, clipped_at: float) -> Blocks:
    """Cut blocks of noise from two images of one still scene.

    A block is the difference of the images over the root of 2 (photon transfer). The scene cancels,
    and so do the fixed deviations of each detector. `mean` is that of both images.

    Args:
        first: digital numbers (H, W) of one image.
        second: digital numbers (H, W) of the other image.
        clipped_at: blocks with a value from here on, or of 0, are excluded.
    """
    ones, part = _side_by_side(first)
    others, _ = _side_by_side(second)
    low = np.minimum(ones, others).min((1, 2))
    high = np.maximum(ones, others).max((1, 2))
    valid = (low > 0) & (high < clipped_at)
    ones = ones[valid]
    others = others[valid]
    return _measured((ones + others).mean((1, 2)) / 2, (ones - others) / math.sqrt(2), part[valid])


def _side_by_side(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the blocks (N, S, S) of an image, and the part that each lies in."""
    rows = image.shape[0] // SIDE_PX
    columns = image.shape[1] // SIDE_PX
    pixels = np.asarray(image[: rows * SIDE_PX, : columns * SIDE_PX], np.float64)
    pixels = (
        pixels.reshape(rows, SIDE_PX, columns, SIDE_PX).swapaxes(1, 2).reshape(-1, SIDE_PX, SIDE_PX)
    )
    across = columns // PART_BLOCKS + 1
    part = np.arange(rows)[:, None] // PART_BLOCKS * across + np.arange(columns) // PART_BLOCKS
    return pixels, part.ravel()


def _measured(mean: np.ndarray, pixels: np.ndarray, part: np.ndarray) -> Blocks:
    """Return blocks (N, S, S) with these means and parts by the energies of their bands."""
    # Imported here, like SciPy below, because only measurements of sensors need it.
    from scipy.fft import dctn

    # A plane is subtracted from each block.
    ramp = np.arange(SIDE_PX) - (SIDE_PX - 1) / 2
    residuals = pixels - pixels.mean((1, 2), keepdims=True)
    down, across = (
        (residuals.sum(axis) * ramp).sum(1) / (SIDE_PX * (ramp**2).sum()) for axis in (2, 1)
    )
    residuals -= down[:, None, None] * ramp[:, None] + across[:, None, None] * ramp
    coefficients = dctn(residuals, axes=(1, 2), norm="ortho", overwrite_x=True)
    energies = np.square(coefficients, out=coefficients).reshape(-1, SIDE_PX**2)
    # Not by matrix products: the threads of BLAS wait for each other longer than these small sums
    # take.
    bands = np.einsum("nk,kb->bn", energies, _band_means())
    slow, fine, *spectrum = bands
    return Blocks(mean, slow, fine, np.stack(spectrum, axis=1), part)


@cache
def _band_means() -> np.ndarray:
    """Return the weights (S * S, 8) that average the energies of slow and fine waves, and of
    SPECTRUM.
    """
    place = np.arange(SIDE_PX)
    frequency = np.hypot(place[:, None], place).ravel() / (2 * SIDE_PX)
    bands = ((1.5 / (2 * SIDE_PX), SLOW), (FINE, 1.0), *pairwise(SPECTRUM))
    weights = np.stack([(frequency > low) & (frequency <= high) for low, high in bands], axis=1)
    return np.asarray(weights / weights.sum(0))
