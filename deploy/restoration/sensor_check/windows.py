"""Windows spread over an image, in which its noise and its blur are checked."""

from collections.abc import Iterator, Sequence

import numpy as np

from beers_deploy.model.raster.source import Source

WINDOW_PX = 512
ACROSS = 4
"""The side of a window, and the largest number of windows along each axis."""


def band_windows(source: Source) -> list[list[np.ndarray]]:
    """Return windows (h, w) of each band, spread evenly over an image; missing pixels are 0."""
    return [list(windows) for windows in zip(*_windows(source), strict=True)]


def integer_step(windows: Sequence[np.ndarray]) -> int | None:
    """Return the largest integer that divides all pixels, or None if they are not integers."""
    if any(window.dtype.kind == "f" for window in windows) and not all(
        (np.isfinite(window) & (window == np.rint(window))).all() for window in windows
    ):
        return None
    divisors = [np.gcd.reduce(window.astype(np.int64), axis=None) for window in windows]
    # The divisor of an image of zeros alone is 0.
    return max(int(np.gcd.reduce(divisors)), 1)


def _windows(source: Source) -> Iterator[np.ndarray]:
    """Yield windows (bands, h, w) spread evenly over an image, 0 where pixels are missing."""
    raster = source.raster
    for down in _spread(raster.height_px):
        rows = source.read(down.start, down.stop)
        values = np.ma.getdata(rows)
        if raster.may_miss:
            values = np.where(raster.missing(rows), 0, values)
        for across in _spread(raster.width_px):
            yield values[:, :, across]


def _spread(size_px: int) -> list[slice]:
    """Return windows along a side, evenly spaced from end to end without overlap."""
    count = min(ACROSS, -(-size_px // WINDOW_PX))
    side_px = min(WINDOW_PX, size_px // count)
    starts = np.linspace(0, size_px - side_px, count)
    return [slice(int(start), int(start) + side_px) for start in starts]
