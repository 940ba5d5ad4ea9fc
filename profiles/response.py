"""Define the complete blur of an instrument, detector included, if more is known than its contrast
at Nyquist.

It is either a tabulated MTF or a point-spread function. Both are plain values that can be compared,
hashed and serialized as JSON. Blurs from a file are validated. Blurs drawn for a training patch are
not, because a check takes as long as drawing 600 tables. Frequencies are in cycles per target
pixel; "across" the track is horizontal (fx, along a row), "along" it vertical.
"""

import base64
import hashlib
import zlib
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Annotated, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
    with_config,
)

from beers_deploy.profiles.errors import printable
from beers_deploy.profiles.validation import CONFIG

NYQUIST = 0.5
"""The Nyquist frequency in cycles per pixel."""
Array = NDArray[np.float64]
Frequencies = NDArray[np.floating]


READING = 0.005
"""The excess of a table over the MTF of the square detector that is allowed for rounding: half of
the last of two decimals.
"""
MOST_FREQUENCIES = 1000
LEAST_STEP = 1e-4
KEPT_SIDE = 1024
"""The maximum number of samples along one side, because a recipe stores them as text."""

R = TypeVar("R", bound="MtfTable | PointSpread")


def _require_contrast(response: R) -> R:
    """Raise ValueError if the contrast at Nyquist is not above 0, or above that of a square
    detector.
    """
    limit = float(np.sinc(NYQUIST))
    for axis, contrast in zip(("across", "along"), response.at_nyquist, strict=True):
        if not 0 < contrast <= limit:
            raise ValueError(
                f"has a contrast of {contrast:.4g} at Nyquist {axis} the track, but it must be "
                f"above 0 and at most {limit:.4f} (2/pi, the square detector alone). Describe the "
                "whole system, its detector included, in target pixels."
            )
    return response


Numbers = tuple[Annotated[float, Field(strict=True, allow_inf_nan=False)], ...]


def _fine_enough(samples_per_px: float) -> float:
    # With fewer than two, the frequencies that the sensor's sampling aliases are not known.
    if not 2 <= samples_per_px <= 64:
        raise ValueError(
            f"must be from 2 to 64, but it is {samples_per_px:g}. Sample the point-spread function "
            "as often in each target pixel."
        )
    return samples_per_px


SamplesPerPx = Annotated[
    float, Field(strict=True, allow_inf_nan=False), AfterValidator(_fine_enough)
]
Side = Annotated[int, Field(strict=True, ge=1, le=KEPT_SIDE)]


@with_config(CONFIG)
@dataclass(frozen=True)
class MtfTable:
    """The blur of an instrument as contrasts at some frequencies, measured on each axis.

    Attributes:
        frequency: ascending from 0 to at least 0.5 and below 1, in cycles per pixel of the sensor.
        across: contrast across the track at each frequency: 1 at frequency 0 and above 0
            everywhere.
        along: the same along the track.
    """

    frequency: Numbers
    across: Numbers
    along: Numbers

    @field_validator("frequency")
    @classmethod
    def _ascending(cls, frequency: tuple[float, ...]) -> tuple[float, ...]:
        rising = all(after - before >= LEAST_STEP for before, after in pairwise(frequency))
        ends = frequency[:1] == (0,) and NYQUIST <= frequency[-1] < 1
        if not rising or not ends or len(frequency) > MOST_FREQUENCIES:
            raise ValueError(
                f"must be at most {MOST_FREQUENCIES} frequencies, ascending from 0 to at least 0.5 "
                "and below 1 cycles per pixel (the detector's first zero), at least "
                f"{LEAST_STEP:g} apart, got {printable(repr(frequency))}. Give them in that order, "
                "in cycles per target pixel."
            )
        return frequency

    @field_validator("across", "along")
    @classmethod
    def _below_the_detector(
        cls, contrast: tuple[float, ...], info: ValidationInfo
    ) -> tuple[float, ...]:
        # A wrong list of frequencies has its own sentence already.
        frequency = info.data.get("frequency", ())
        if not frequency:
            return contrast
        if len(contrast) != len(frequency) or contrast[0] != 1:
            raise ValueError(
                f"must have {len(frequency)} contrasts, one for each frequency and the first of "
                f"them 1, got {printable(repr(contrast))}. Divide the table by its value at "
                "frequency 0."
            )
        for f, value in zip(frequency, contrast, strict=True):
            detector = float(np.sinc(f))
            if not 0 < value <= detector + READING:
                raise ValueError(
                    f"has a contrast of {value:g} at {f:g} cycles per pixel, but it must be above "
                    f"0 and at most {detector:.4f} there (sinc, the square detector alone). "
                    "Describe the whole system; zeros and reversed contrast need a point-spread "
                    "function, psf."
                )
        return contrast

    _contrast = model_validator(mode="after")(_require_contrast)

    @property
    def at_nyquist(self) -> tuple[float, float]:
        """Contrast at 0.5 cycles per pixel, across and along the track."""
        return _contrast_at_nyquist(self)

    def at(self, fx: Frequencies, fy: Frequencies) -> Array:
        """Return the MTF (H, W) at the frequencies fx (1, W) and fy (H, 1).

        The MTF of the square detector is divided out. The logarithm of the rest is interpolated
        linearly over the radius r, which gives each axis its gamma(r) = -log / r. The two axes are
        then combined as in the formula: exp(-sqrt((gamma_x fx)^2 + (gamma_y fy)^2)) sinc(fx)
        sinc(fy). A table of the formula therefore reproduces the formula. Beyond the last frequency
        gamma stays constant, so the contrast continues to fall.
        """
        radius = np.hypot(fx, fy)
        gamma_x, gamma_y = self.gammas(radius)
        optics = np.exp(-np.hypot(gamma_x * fx, gamma_y * fy))
        return optics * np.sinc(fx) * np.sinc(fy)

    def gammas(self, radius: Frequencies) -> list[Frequencies]:
        """Return the gamma of each axis, across and along the track, at radii of any shape."""
        frequency = np.array(self.frequency)
        # Gamma is constant beyond the last frequency, and towards 0, where the loss cannot be
        # divided by f.
        inside = np.clip(radius, frequency[1], frequency[-1])
        gammas = []
        for contrast in (self.across, self.along):
            # Rounded tables exceed the detector's own contrast by a little at low frequencies.
            loss = np.maximum(-np.log(np.array(contrast) / np.sinc(frequency)), 0.0)
            gammas.append(np.asarray(np.interp(inside, frequency, loss) / inside))
        return gammas

    def __str__(self) -> str:
        return (
            f"MTF table of {len(self.frequency)} frequencies up to {self.frequency[-1]:g} "
            "cycles per pixel"
        )


@with_config(CONFIG)
@dataclass(frozen=True)
class PointSpread:
    """The blur of an instrument as the image of a point: (height, width) samples, along the track
    and across it.

    Attributes:
        height: the number of rows.
        width: the number of columns.
        samples_per_px: the number of samples per pixel of the sensor in each direction; 2 or more.
        samples: their values as text (see `packed`), which is hashable and can be stored in JSON.
    """

    height: Side
    width: Side
    samples_per_px: SamplesPerPx
    samples: str

    @model_validator(mode="after")
    def _as_stored(self) -> Self:
        try:
            samples = unpacked(self)
            if not (np.isfinite(samples).all() and samples.sum() > 0):
                raise ValueError("they are not finite, or their sum is not above 0")
        except ValueError as error:
            raise ValueError(
                "does not hold the samples of a point-spread function as they were stored: "
                f"{printable(str(error))}. Generate the file again."
            ) from error
        return self

    _contrast = model_validator(mode="after")(_require_contrast)

    @property
    def at_nyquist(self) -> tuple[float, float]:
        """Contrast at 0.5 cycles per pixel, across and along the track, as a magnitude."""
        return _contrast_at_nyquist(self)

    def at(self, fx: Frequencies, fy: Frequencies) -> NDArray[np.complex128]:
        """Return the Fourier transform, complex (H, W), at the frequencies fx (1, W) and fy (H, 1).

        It is the discrete sum itself, exact to rounding. The samples are normalised to a sum of 1
        and centred on their centroid, so that the blur preserves radiance and does not shift the
        image. Beyond half of the sampling frequency the function is not defined, and 0 is returned.
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
            f"point-spread function of {self.width} x {self.height} samples, "
            f"{self.samples_per_px:g} to a pixel "
            f"({digest})"
        )


Response = MtfTable | PointSpread


def packed(values: NDArray[np.floating]) -> str:
    """Encode samples of any shape as text, for `PointSpread.samples`: float32, compressed, in base
    64.
    """
    content = np.ascontiguousarray(values, "<f4").tobytes()
    return base64.b64encode(zlib.compress(content, 9)).decode()


def unpacked(point: PointSpread) -> Array:
    """Decode the samples of a point-spread function, (height, width).

    Raises:
        ValueError: the text does not hold this number of samples.
    """
    count_bytes = 4 * point.height * point.width
    try:
        compressed = base64.b64decode(point.samples, validate=True)
        # The limit stops a text that would unpack to more than the samples.
        content = zlib.decompressobj().decompress(compressed, count_bytes)
    except zlib.error as error:
        raise ValueError(str(error)) from None
    return np.frombuffer(content, "<f4").astype(np.float64).reshape(point.height, point.width)


def centroid(values: Array) -> tuple[float, float]:
    """Return the row and column of the centroid of samples (H, W), in samples and relative to the
    middle.

    The sum of the samples must not be 0.
    """
    rows, columns = ((np.arange(size) - (size - 1) / 2) for size in values.shape)
    total = values.sum()
    return float(values.sum(1) @ rows / total), float(values.sum(0) @ columns / total)


@lru_cache(maxsize=8)
def _grid(point: PointSpread) -> tuple[Array, ...]:
    """Return the samples scaled to a sum of 1, and the positions of their rows and columns.

    Positions are relative to the centroid, in target pixels.
    """
    values = unpacked(point)
    places = (
        (np.arange(size) - (size - 1) / 2 - middle) / point.samples_per_px
        for size, middle in zip(values.shape, centroid(values), strict=True)
    )
    return values / values.sum(), *places


@lru_cache(maxsize=64)
def _contrast_at_nyquist(response: Response) -> tuple[float, float]:
    none = np.zeros((1, 1))
    nyquist = np.full((1, 1), NYQUIST)
    across, along = (
        float(np.abs(response.at(*f)[0, 0])) for f in ((nyquist, none), (none, nyquist))
    )
    return across, along
