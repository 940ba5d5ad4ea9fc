"""The blur of a whole instrument, detector included, where more is known of it than its contrast at Nyquist.

Either a tabulated MTF or a point-spread function. Both are plain values: they compare, hash and travel in JSON.
Frequencies are in cycles per target pixel; "across" the track is horizontal (fx, along a row), "along" it vertical.
"""

import base64
import hashlib
import zlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

NYQUIST = 0.5
"""Cycles per pixel."""
Frequencies = NDArray[np.floating]


@dataclass(frozen=True)
class MtfTable:
    """Contrast at some frequencies, measured on each axis.

    Attributes:
        frequency: ascending from 0, to 0.5 at least and below 1, in cycles per target pixel.
        across: contrast across the track at each, 1 at frequency 0, above 0 everywhere.
        along: likewise along the track.
    """

    frequency: tuple[float, ...]
    across: tuple[float, ...]
    along: tuple[float, ...]

    @property
    def at_nyquist(self) -> tuple[float, float]:
        """Contrast at 0.5 cycles per pixel, across and along the track."""
        return _contrast_at_nyquist(self)

    def at(self, fx: Frequencies, fy: Frequencies) -> NDArray[np.float64]:
        """The MTF at fx (1, W) and fy (H, 1): (H, W).

        What the square detector leaves is divided out; -log of the rest is interpolated linearly over the radius r,
        which gives each axis its gamma(r) = -log / r. Then as the formula's two axes:
        exp(-sqrt((gamma_x fx)^2 + (gamma_y fy)^2)) sinc(fx) sinc(fy). A table of the formula gives the formula.
        Beyond the last frequency gamma stays what it was there: contrast falls on.
        """
        radius = np.hypot(fx, fy)
        gamma_x, gamma_y = (self._gamma(radius, contrast) for contrast in (self.across, self.along))
        optics = np.exp(-np.hypot(gamma_x * fx, gamma_y * fy))
        return np.asarray(optics * np.sinc(fx) * np.sinc(fy))

    def _gamma(self, radius: Frequencies, contrast: tuple[float, ...]) -> Frequencies:
        frequency = np.array(self.frequency)
        # max: rounded tables exceed the detector's own contrast by a little at low frequencies
        loss = np.maximum(-np.log(np.array(contrast) / np.sinc(frequency)), 0.0)
        # Towards 0, where there is nothing to divide by, and beyond the end gamma stays what it was.
        inside = np.clip(radius, frequency[1], frequency[-1])
        return np.asarray(np.interp(inside, frequency, loss) / inside)

    def __str__(self) -> str:
        return f"MTF table of {len(self.frequency)} frequencies up to {self.frequency[-1]:g} cycles per pixel"


@dataclass(frozen=True)
class PointSpread:
    """The image of a point, (height, width) samples, down the track and across it.

    Attributes:
        height: rows of samples.
        width: columns of samples.
        samples_per_px: how many of them, in each direction, make one target pixel; 2 or more.
        samples: their values as text (`packed`), which a set, a cache and JSON take as it is.
    """

    height: int
    width: int
    samples_per_px: float
    samples: str

    @property
    def at_nyquist(self) -> tuple[float, float]:
        """Contrast at 0.5 cycles per pixel, across and along the track, whatever its sign."""
        return _contrast_at_nyquist(self)

    def at(self, fx: Frequencies, fy: Frequencies) -> NDArray[np.complex128]:
        """Its Fourier transform at fx (1, W) and fy (H, 1), complex (H, W): the sum itself, exact to rounding.

        Samples are taken at points; their sum counts as 1 and their centroid lies at 0, so that the blur keeps
        radiance and shifts nothing. Beyond half its sampling frequency a sampled function says nothing: 0 there.
        """
        values, y_px, x_px = _grid(self)
        waves_y, waves_x = (
            np.exp(-2j * np.pi * np.outer(place, f)) * (np.abs(f) <= self.samples_per_px / 2)
            for place, f in ((y_px, np.ravel(fy)), (x_px, np.ravel(fx)))
        )
        return np.asarray(waves_y.T @ (values @ waves_x))

    def __str__(self) -> str:
        digest = hashlib.sha256(self.samples.encode()).hexdigest()[:12]
        return (
            f"point-spread function of {self.width} x {self.height} samples, {self.samples_per_px:g} to a pixel "
            f"({digest})"
        )


Response = MtfTable | PointSpread


def packed(values: NDArray[np.floating]) -> str:
    """Samples of any shape as text: float32, compressed, in base 64."""
    return base64.b64encode(zlib.compress(np.ascontiguousarray(values, "<f4").tobytes(), 9)).decode()


def unpacked(point: PointSpread) -> NDArray[np.float64]:
    """The samples, (height, width)."""
    count_bytes = 4 * point.height * point.width
    try:
        found = zlib.decompressobj().decompress(base64.b64decode(point.samples, validate=True), count_bytes)
    except zlib.error as error:
        raise ValueError(str(error)) from None
    return np.frombuffer(found, "<f4").astype(np.float64).reshape(point.height, point.width)


def centroid(values: NDArray[np.float64]) -> tuple[float, float]:
    """Row and column of the centre of gravity of samples (H, W) whose sum is not 0, counted from the middle."""
    rows, columns = ((np.arange(size) - (size - 1) / 2) for size in values.shape)
    total = values.sum()
    return float(values.sum(1) @ rows / total), float(values.sum(0) @ columns / total)


@lru_cache(maxsize=8)
def _grid(point: PointSpread) -> tuple[NDArray[np.float64], ...]:
    """Samples of sum 1, and where their rows and columns lie from the centroid, in target pixels."""
    values = unpacked(point)
    places = (
        (np.arange(size) - (size - 1) / 2 - middle) / point.samples_per_px
        for size, middle in zip(values.shape, centroid(values), strict=True)
    )
    return values / values.sum(), *places


@lru_cache(maxsize=64)
def _contrast_at_nyquist(response: Response) -> tuple[float, float]:
    none, nyquist = np.zeros((1, 1)), np.full((1, 1), NYQUIST)
    across, along = (float(np.abs(response.at(*f)[0, 0])) for f in ((nyquist, none), (none, nyquist)))
    return across, along
