"""The interval of a restored pixel: a half-width that the error stays within in a stated share of
pixels.

    half-width = q sigma (s / sigma)^(d + k m + j n + i t) exp(b m + c n + a t)

s is the standard deviation of the restored image in a window of 3 x 3 pixels, and sigma the noise
of the sensor's profile at the window's mean. The error of a restoration grows with both: noise that
the network takes for detail, and detail that it takes for noise or that the blur hides. m and n are
logarithms of the sensor's MTF up to Nyquist and of its noise sigma_m at 1/4 of full scale, from the
middle of the trained range: what a sensor blurs more, it hides more of, and what a network adds of
its own weighs more where noise is low. t = ln(sigma / sigma_m) states the light: in the dark little
detail exceeds the noise. Windows of 5 x 5 and 7 x 7 pixels ranked errors less well (0.863 and 0.843
instead of 0.886, measured).

`model.interval_calibration` fits the exponents and the factor q.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beers_deploy.model.family import noise_over_full_scale
from beers_deploy.model.levels import LEVELS, Level
from beers_deploy.model.simulator.mtf import mtf, sensor_mtf
from beers_deploy.profiles.errors import ModelError, OptionError, printable, reason_of
from beers_deploy.profiles.instrument import Instrument, PixelNoise, pixel_noise
from beers_deploy.profiles.response import NYQUIST, Array
from beers_deploy.profiles.user_files.json_text import parse_json

CONTEXT_PX = 1
"""Rows and columns around a pixel that its half-width depends on."""

MIDDLE_MTF = 0.07
MIDDLE_NOISE = 0.0022
"""The values at which m and n are 0: MTF at Nyquist, and the noise at 1/4 of full scale over full
scale. Both are those of a sensor in the middle of the trained range.
"""

LEAST_DETAIL = 0.05
"""The least s / sigma: a window of equal integers has no deviation, but its error is not 0."""

LEAST_MTF = 0.001
"""A response may have no contrast at a frequency, which has no logarithm."""

CURVE_FREQUENCIES = np.linspace(0, NYQUIST, 17)[None]
"""The frequencies in cycles per pixel, (1, K), at which a sensor's MTF is read."""

MOST_EXPONENT = 5.0
MOST_QUANTILE = 1e3
"""Larger numbers in a file are none that were fitted: those lie below 1 and 20."""


@dataclass(frozen=True)
class Exponents:
    """The exponents by which the half-width of a pixel grows with detail, blur, noise and light.

    Attributes:
        detail: d, the exponent of the local detail s / sigma (the deviation of nearby restored
            pixels over that of the noise).
        detail_by_blur: k, the change of d with the logarithm m of the MTF.
        detail_by_noise: j, the change of d with the logarithm n of the noise over full scale.
        detail_by_light: i, the change of d with the logarithm t of the local noise over that at 1/4
            of full scale.
        blur: b, the factor of m.
        noise: c, the factor of n.
        light: a, the factor of t.
    """

    detail: float
    detail_by_blur: float
    detail_by_noise: float
    detail_by_light: float
    blur: float
    noise: float
    light: float

    def half_widths(self, conditions: "Conditions", noise: Array, detail: Array) -> Array:
        """Return the half-widths of pixels for q = 1.

        Args:
            conditions: those that the sensor sets.
            noise: sigma of each pixel.
            detail: s / sigma of each, of the same shape.
        """
        terms = conditions.terms(noise, detail)
        logarithm = sum(
            exponent * term for exponent, term in zip(astuple(self), terms, strict=True)
        )
        return np.asarray(noise * np.exp(logarithm))


@dataclass(frozen=True)
class Conditions:
    """The properties of a sensor on which the half-widths of all its pixels depend.

    Attributes:
        blur: m, twice the mean of ln(MTF / MTF of the middle sensor) over the frequencies up to
            Nyquist and both axes. For a curve exp(-gamma f) sinc f it is ln(MTF / MIDDLE_MTF) at
            Nyquist.
        noise: n, ln(noise / MIDDLE_NOISE).
        middle_noise: sigma_m, in pixel values.
    """

    blur: float
    noise: float
    middle_noise: float

    @classmethod
    def of(cls, sensor: Instrument, full_scale: float) -> "Conditions":
        """Compute them for a sensor.

        Args:
            sensor: the sensor.
            full_scale: the pixel value that is its largest digital number.
        """
        zero = np.zeros((1, 1))
        along = sensor_mtf(zero, CURVE_FREQUENCIES.T, sensor).ravel()
        across = sensor_mtf(CURVE_FREQUENCIES, zero, sensor).ravel()
        contrast = np.maximum(np.abs([across, along]), LEAST_MTF)
        middle = mtf(CURVE_FREQUENCIES, zero, MIDDLE_MTF)
        noise = noise_over_full_scale(sensor)
        return cls(
            blur=2 * float(np.log(contrast / middle).mean()),
            noise=math.log(noise / MIDDLE_NOISE),
            middle_noise=noise * full_scale,
        )

    def terms(self, noise: Array, detail: Array) -> list[Array]:
        """Return the factor of each exponent, in the order of their fields.

        Args:
            noise: sigma of each pixel.
            detail: s / sigma of each, of the same shape.

        Returns:
            An array of that shape for each exponent, or a number if it is the same for all pixels.
        """
        m = np.array(self.blur)
        n = np.array(self.noise)
        d = np.log(detail)
        t = np.log(noise / self.middle_noise)
        return [d, m * d, n * d, t * d, m, n, t]


@dataclass(frozen=True)
class PixelInterval:
    """The calibrated interval of a network.

    Attributes:
        exponents: how the half-width grows with local detail, blur and noise.
        quantiles: the factor q for each level in percent, for levels with enough acquisitions.
        acquisitions: the number of images that the quantiles were computed from.
    """

    exponents: Exponents
    quantiles: Mapping[int, float]
    acquisitions: int

    def for_sensor(self, sensor: Instrument, full_scale: float, level: Level) -> "HalfWidth":
        """Prepare the half-widths for images of one sensor at one level.

        Args:
            sensor: the sensor that acquired the raw images.
            full_scale: the pixel value that is the sensor's largest digital number.
            level: the share of pixels within the interval, in percent.

        Raises:
            OptionError: a level without a quantile.
        """
        if level not in self.quantiles:
            raise OptionError(
                f"`interval` must be one of {', '.join(map(str, self.quantiles))} for this "
                f"network, got {level}: it was calibrated on {self.acquisitions} images, too few "
                "for that level. Choose one of these, or calibrate on more images."
            )
        return HalfWidth(
            noise=pixel_noise(sensor, full_scale),
            conditions=Conditions.of(sensor, full_scale),
            exponents=self.exponents,
            quantile=self.quantiles[level],
            most=full_scale,
        )

    def to_json(self) -> str:
        """Return the interval as one line, for the metadata of a file."""
        return json.dumps(asdict(self), separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str, name: str) -> "PixelInterval":
        """Read an interval from the metadata of a file, which is not trusted.

        Args:
            text: the line that `to_json` returned.
            name: the name of the file, for the message.

        Raises:
            ModelError: the text is not such a line, or a number in it is out of range.
        """
        try:
            record: Any = parse_json(text)
            interval = cls(
                exponents=Exponents(**{k: float(v) for k, v in record["exponents"].items()}),
                quantiles={int(k): float(v) for k, v in record["quantiles"].items()},
                acquisitions=int(record["acquisitions"]),
            )
            # A NaN or an infinite number fails each comparison too.
            if not all(abs(value) <= MOST_EXPONENT for value in astuple(interval.exponents)):
                raise ValueError(f"an exponent is not within {MOST_EXPONENT:g}")
            if not all(0 < value <= MOST_QUANTILE for value in interval.quantiles.values()):
                raise ValueError(f"a quantile is not between 0 and {MOST_QUANTILE:g}")
            if not interval.quantiles or not interval.quantiles.keys() <= set(LEVELS):
                raise ValueError("it has other levels than this version")
        except (AttributeError, LookupError, OverflowError, TypeError, ValueError) as error:
            raise ModelError(
                f"The interval in the metadata of {printable(name)} is damaged "
                f"({reason_of(error)}). Calibrate the network again with 'beers-deploy evaluate "
                "--calibrate'."
            ) from error
        return interval


@dataclass(frozen=True)
class HalfWidth:
    """The half-width of pixels of one sensor at one level.

    Attributes:
        noise: the noise of a pixel of the raw image.
        conditions: those that the sensor sets.
        exponents: how the half-width grows with them, with noise and with detail.
        quantile: the factor of the level.
        most: the largest half-width: no error exceeds full scale.
    """

    noise: PixelNoise
    conditions: Conditions
    exponents: Exponents
    quantile: float
    most: float

    def of(self, restored: NDArray[Any], known: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Compute the half-width of every restored pixel, in pixel values.

        Args:
            restored: (h, w) pixel values as they are stored.
            known: True for each that is not missing, (h, w). Missing pixels, and those beyond the
                array, are in no window.

        Returns:
            (h, w) half-widths, NaN where a pixel is missing.
        """
        noise, detail = noise_and_detail(restored, known, self.noise)
        half = self.quantile * self.exponents.half_widths(self.conditions, noise, detail)
        return np.where(known, np.minimum(half, self.most), np.nan).astype(np.float32)


def noise_and_detail(
    restored: NDArray[Any], known: NDArray[np.bool_], noise: PixelNoise
) -> tuple[Array, Array]:
    """Compute the noise and the local detail of every pixel, (h, w) each.

    sigma is the noise, in pixel values, that the sensor has at the mean of the 3 x 3 known pixels
    around a pixel. The detail is s / sigma, with s the standard deviation of these pixels.

    Sums of integers are exact in float64, so that a window gives the same numbers in any tile.

    Args:
        restored: (h, w) pixel values as they are stored.
        known: (h, w), False for missing pixels.
        noise: the noise of a pixel of the raw image.
    """
    pixels = np.where(known, restored, 0).astype(np.float64)
    count = np.maximum(_window_sums(known.astype(np.float64)), 1)
    mean = _window_sums(pixels) / count
    variance = np.maximum(_window_sums(pixels**2) / count - mean**2, 0)
    expected = noise.variance(mean)
    detail = np.sqrt(np.maximum(variance / expected, LEAST_DETAIL**2))
    return np.sqrt(expected), detail


def _window_sums(values: Array) -> Array:
    """Return the sums over windows of 3 x 3 pixels, (h, w); beyond the array all is 0."""
    padded = np.pad(values, CONTEXT_PX)
    columns = padded[:-2] + padded[1:-1] + padded[2:]
    return columns[:, :-2] + columns[:, 1:-1] + columns[:, 2:]
