"""Windows of an image, each split into its mean, its slow structure and its noise."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

SLOW, FINE = 0.2, 0.35
"""Cycles per pixel. A blur leaves little texture above SLOW (MTF 7 %: 0.39 of it) and less above FINE (0.18)."""


@dataclass(frozen=True)
class Windows:
    """N windows of n * n pixels.

    Attributes:
        mean: (N,) in the image's unit.
        structure: (N,) mean square of the slow waves, per degree of freedom: the variance where there is only noise.
        variance: (N,) unbiased variance of what plane and waves leave.
        middle: (N,) that of it between SLOW and FINE: as much for white noise, more for texture.
        degrees: degrees of freedom of structure, variance and middle.
    """

    mean: np.ndarray
    structure: np.ndarray
    variance: np.ndarray
    middle: np.ndarray
    degrees: tuple[int, int, int]

    def only(self, chosen: np.ndarray) -> "Windows":
        """Some of the windows."""
        structure, variance, middle = (x[chosen] for x in (self.structure, self.variance, self.middle))
        return Windows(self.mean[chosen], structure, variance, middle, self.degrees)

    def scaled(self, factor: float) -> "Windows":
        """In another unit."""
        structure, variance, middle = (x * factor**2 for x in (self.structure, self.variance, self.middle))
        return Windows(self.mean * factor, structure, variance, middle, self.degrees)


def cut_windows(image: np.ndarray, side_px: int, clipped_at: float) -> Windows:
    """Cut (H, W) into squares side by side, without those that hold a clipped or a non-finite pixel.

    Args:
        image: any linear unit.
        side_px: side of a window.
        clipped_at: values from here on are clipped, and so are those from 0 down.
    """
    rows, columns = (size // side_px for size in image.shape)
    whole = np.asarray(image[: rows * side_px, : columns * side_px], np.float64)
    pixels = whole.reshape(rows, side_px, columns, side_px).swapaxes(1, 2).reshape(-1, side_px**2)
    with np.errstate(invalid="ignore"):
        sound = ((pixels > 0) & (pixels < clipped_at)).all(1)
    return _split(pixels[sound], side_px)


def _split(pixels: np.ndarray, side_px: int) -> Windows:
    plane, slow, middle = bases = _bases(side_px)
    mean = pixels.mean(1)
    centred = pixels - mean[:, None]
    in_plane, in_slow, in_middle = (((centred @ basis) ** 2).sum(1) for basis in bases)
    slow_count, middle_count = slow.shape[1], middle.shape[1]
    rest_count = side_px**2 - plane.shape[1] - slow_count
    rest = np.maximum((centred**2).sum(1) - in_plane - in_slow, 0)
    degrees = (slow_count, rest_count, middle_count)
    return Windows(mean, in_slow / slow_count, rest / rest_count, in_middle / middle_count, degrees)


@lru_cache
def _bases(side_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Orthonormal columns (n * n, K) of a plane, of the cosines up to SLOW less their plane, and on to FINE."""
    place = np.arange(side_px) + 0.5
    ramp, one = place - side_px / 2, np.ones(side_px)
    plane = [np.outer(one, one), np.outer(ramp, one), np.outer(one, ramp)]
    cosines = [np.cos(math.pi * k * place / side_px) for k in range(side_px)]
    numbers = sorted((math.hypot(k, m) / (2 * side_px), k, m) for k in range(side_px) for m in range(side_px))
    # k + m > 1: the first two waves are all but the plane.
    waves = [np.outer(cosines[k], cosines[m]) for f, k, m in numbers if f <= FINE and k + m > 1]
    joined, _ = np.linalg.qr(np.stack([wave.ravel() for wave in plane + waves], axis=1))
    fine = 3 + sum(f <= SLOW and k + m > 1 for f, k, m in numbers)
    return joined[:, :3], joined[:, 3:fine], joined[:, fine:]
