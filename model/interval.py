"""The interval of a restored pixel: a half-width that the error stays within in a stated share of
pixels.

    half-width = q sigma (s / sigma)^(d + k m) exp(b m + c n)

s is the standard deviation of the restored image in a window of 3 x 3 pixels, and sigma the noise
of the sensor's profile at the window's mean. The error of a restoration grows with both: noise
that the network takes for detail, and detail that it takes for noise or that the blur hides. m and
n are logarithms of the sensor's MTF up to Nyquist and of its noise over full scale, from the middle
of the trained range: what a sensor blurs more, it hides more of, and what a network adds of its own
weighs more where noise is low. Windows of 5 x 5 and 7 x 7 pixels ranked errors less well (0.863 and
0.843 instead of 0.886, measured).

1. d, b, k and c are the least-squares fit of ln(|error| / sigma) on some places.
2. q is the quantile of |error| / half-width at q = 1 on other places, where the network was not
   trained either: split conformal prediction (Lei et al., JASA 2018). Pixels of one acquisition
   resemble one another, so acquisitions are what is exchanged, and each has the same weight
   (hierarchical conformal prediction; Lee, Barber and Willett, arXiv 2306.06342).

So a pixel of one more acquisition, drawn as those of the calibration were, lies in its interval
with at least the stated probability. Nothing is stated of all pixels of an image jointly, nor of an
image that another sensor acquired than the named one.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beers_deploy.model.family import noise_over_full_scale
from beers_deploy.model.levels import LEVELS, Level
from beers_deploy.model.self_check import noise_variances
from beers_deploy.model.simulator.mtf import mtf, sensor_mtf
from beers_deploy.profiles.errors import ModelError, OptionError, printable, reason_of
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import NYQUIST
from beers_deploy.profiles.toml import parse_json

Array = NDArray[np.float64]

CONTEXT_PX = 1
"""Rows and columns around a pixel that its half-width depends on."""

MIDDLE_MTF = 0.07
MIDDLE_NOISE = 0.0022
"""Where m and n are 0: MTF at Nyquist, and the noise at 1/4 of full scale over full scale. Both are
those of a sensor in the middle of the trained range, so that exponents say what they mean alone.
"""

LEAST_DETAIL = 0.05
"""The least s / sigma: a window of equal integers has no deviation, but its error is not 0."""

LEAST_ERROR = 0.02
"""The least |error| / sigma in the fit, where the logarithm of 0 would not be finite."""

BORDER_PX = 16
"""Pixels at the border of an image that the calibration leaves out: errors are larger there."""

SAMPLE_PX = 1 << 14
"""Pixels of one acquisition at most: more of them say little, because neighbours are alike."""

LEAST_MTF = 0.001
"""A response may have no contrast at a frequency, which has no logarithm."""

CURVE_FREQUENCIES = np.linspace(0, NYQUIST, 17)[None]
"""The frequencies in cycles per pixel, (1, K), at which a sensor's MTF is read."""

MOST_EXPONENT = 5.0
MOST_QUANTILE = 1e3
"""Larger numbers in a file are none that were fitted: those lie below 1 and 20."""


@dataclass(frozen=True)
class Exponents:
    """The exponents by which the half-width of a pixel grows with detail, blur and noise.

    Attributes:
        detail: d, the exponent of the local detail s / sigma (the deviation of nearby restored
            pixels over that of the noise).
        blur: b, the factor of the logarithm m of the MTF.
        detail_by_blur: k, the change of d with the logarithm m of the MTF.
        noise: c, the factor of the logarithm of the noise over full scale.
    """

    detail: float
    blur: float
    detail_by_blur: float
    noise: float

    def of_sensor(self, sensor: Instrument) -> tuple[float, float]:
        """Return the exponent of s / sigma and the constant factor of a sensor's half-widths.

        The half-width of a pixel is quantile * factor * sigma * (s / sigma)^exponent.
        """
        m, n = _logarithms(sensor)
        return self.detail + self.detail_by_blur * m, math.exp(self.blur * m + self.noise * n)


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
        exponent, factor = self.exponents.of_sensor(sensor)
        return HalfWidth(
            variances=noise_variances(sensor, full_scale),
            offset=sensor.offset_dn * full_scale / sensor.max_dn,
            exponent=exponent,
            factor=self.quantiles[level] * factor,
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
        variances: the variances of the noise, see `model.self_check.noise_variances`.
        offset: the pixel value of the dark.
        exponent: the exponent of s / sigma.
        factor: the half-width in sigma where s is sigma.
        most: the largest half-width: no error exceeds full scale.
    """

    variances: tuple[float, float, float]
    offset: float
    exponent: float
    factor: float
    most: float

    def of(self, restored: NDArray[Any], known: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Compute the half-width of every restored pixel, in pixel values.

        Args:
            restored: (h, w) pixel values as they are stored.
            known: which of them are not missing, (h, w). Missing ones and what lies beyond the
                array are in no window.

        Returns:
            (h, w) half-widths, NaN where a pixel is missing.
        """
        noise, detail = noise_and_detail(restored, known, self.variances, self.offset)
        half = np.minimum(self.factor * noise * detail**self.exponent, self.most)
        return np.where(known, half, np.nan).astype(np.float32)


def noise_and_detail(
    restored: NDArray[Any],
    known: NDArray[np.bool_],
    variances: tuple[float, float, float],
    offset: float,
) -> tuple[Array, Array]:
    """Compute the noise and the local detail of every pixel, (h, w) each.

    sigma is the noise, in pixel values, that the sensor has at the mean of the 3 x 3 known pixels
    around a pixel. The detail is s / sigma, with s the standard deviation of these pixels.

    Sums of integers are exact in float64, so that a window gives the same numbers in any tile.

    Args:
        restored: (h, w) pixel values as they are stored.
        known: (h, w), False for missing pixels.
        variances: the variances of the noise, see `HalfWidth`.
        offset: the pixel value of the dark.
    """
    pixels = np.where(known, restored, 0).astype(np.float64)
    count = np.maximum(_window_sums(known.astype(np.float64)), 1)
    mean = _window_sums(pixels) / count
    variance = np.maximum(_window_sums(pixels**2) / count - mean**2, 0)
    dark, growth, square = variances
    light = np.maximum(mean - offset, 0)
    noise = dark + growth * light + square * light**2
    detail = np.sqrt(np.maximum(variance / noise, LEAST_DETAIL**2))
    return np.sqrt(noise), detail


def _window_sums(values: Array) -> Array:
    """Return the sums over windows of 3 x 3 pixels, (h, w); beyond the array all is 0."""
    padded = np.pad(values, CONTEXT_PX)
    columns = padded[:-2] + padded[1:-1] + padded[2:]
    return np.asarray(columns[:, :-2] + columns[:, 1:-1] + columns[:, 2:])


@dataclass(frozen=True)
class Sample:
    """Pixels of one restored acquisition whose truth is known.

    Attributes:
        sensor: the sensor that acquired them.
        noise: sigma of each, (n,).
        detail: s / sigma of each, (n,).
        error: the absolute error of each in the same units, (n,).
    """

    sensor: Instrument
    noise: Array
    detail: Array
    error: Array

    @classmethod
    def of(
        cls,
        raw: NDArray[np.float32],
        restored: NDArray[np.float32],
        truth: NDArray[np.float32],
        sensor: Instrument,
    ) -> "Sample":
        """Take the pixels of images (h, w) of digital numbers, without border and saturation.

        Args:
            raw: as the sensor acquired it.
            restored: from it.
            truth: what the restoration aims at.
            sensor: the instrument.
        """
        variances = noise_variances(sensor, sensor.max_dn)
        known = np.ones(restored.shape, bool)
        noise, detail = noise_and_detail(restored, known, variances, sensor.offset_dn)
        counts = np.zeros(raw.shape, bool)
        counts[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
        counts &= raw < sensor.max_dn
        places = np.flatnonzero(counts)
        places = places[:: -(-places.size // SAMPLE_PX) or 1]
        error = np.abs(restored.astype(np.float64) - truth)
        return cls(sensor, noise.flat[places], detail.flat[places], error.flat[places])

    def scores(self, exponents: Exponents) -> Array:
        """Return the nonconformity score of each pixel, (n,): its absolute error over its
        half-width.

        The half-width is the one that the exponents give for a quantile of 1. So a quantile of the
        scores is the factor that scales half-widths to a level.
        """
        exponent, factor = exponents.of_sensor(self.sensor)
        return np.asarray(self.error / (factor * self.noise * self.detail**exponent))


def calibrated(fitted: Sequence[Sample], held_out: Sequence[Sample]) -> PixelInterval:
    """Calibrate the interval of a network by conformal prediction.

    Args:
        fitted: acquisitions that the exponents are fitted on.
        held_out: acquisitions of other places, from which the quantiles are computed.

    Returns:
        The exponents, and a quantile for each level that `held_out` is large enough for.

    Raises:
        OptionError: `held_out` has too few acquisitions for any level.
    """
    exponents = fit_exponents([sample for sample in fitted if sample.error.size])
    scores = [sample.scores(exponents) for sample in held_out if sample.error.size]
    quantiles = {level: conformal_quantile(scores, level) for level in LEVELS}
    known = {int(level): q for level, q in quantiles.items() if math.isfinite(q)}
    if not known:
        raise OptionError("`calibrate` needs pairs with pixels that are not saturated.")
    return PixelInterval(exponents, known, len(scores))


def fit_exponents(samples: Sequence[Sample]) -> Exponents:
    """Fit ln(|error| / sigma) by least squares, each acquisition with the same weight.

    A term that all samples agree in, such as the blur of one sensor, gets the exponent 0.
    """
    terms = list[Array]()
    values = list[Array]()
    weights = list[Array]()
    for sample in samples:
        m, n = _logarithms(sample.sensor)
        detail = np.log(sample.detail)
        one = np.ones_like(detail)
        terms.append(np.stack([detail, m * one, m * detail, n * one], axis=1))
        values.append(np.log(np.maximum(sample.error / sample.noise, LEAST_ERROR)))
        weights.append(one / one.size)
    weight = np.concatenate(weights)
    centred = partial(_centred, weight=weight)
    root = np.sqrt(weight)[:, None]
    columns = root * centred(np.concatenate(terms))
    # Terms that one sensor leaves (almost) constant or proportional have no solution of their own:
    # the cutoff gives them the least exponents.
    solution, *_ = np.linalg.lstsq(
        columns, root[:, 0] * centred(np.concatenate(values)), rcond=1e-6
    )
    return Exponents(*map(float, solution))


def conformal_quantile(scores: Sequence[Array], level: float) -> float:
    """Return the conformal quantile of scores in groups, each group with the same weight.

    K groups leave the weight 1 / (K + 1) for a group to come, whose scores may be infinite. Of
    groups of one score this is the smallest of n scores that ceil((n + 1) level) of them do not
    exceed.

    Args:
        scores: the scores of each group, (n,).
        level: in percent.

    Returns:
        The quantile; infinite if there are too few groups for the level.
    """
    values = np.concatenate(scores)
    weights = np.concatenate([np.full(group.size, 1 / group.size) for group in scores])
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    # Rounding of the sum must not cost a score.
    needed = (len(scores) + 1) * level / 100 * (1 - 1e-12)
    place = int(np.searchsorted(reached, needed))
    return float(values[order][place]) if place < values.size else math.inf


def _centred(values: Array, weight: Array) -> Array:
    return np.asarray(values - np.average(values, axis=0, weights=weight))


def _logarithms(sensor: Instrument) -> tuple[float, float]:
    """Return m and n of a sensor: twice the mean of ln(MTF / MTF of the middle sensor) over the
    frequencies up to Nyquist and both axes, and ln(noise / MIDDLE_NOISE).

    For a curve exp(-gamma f) sinc f, m is ln(MTF / MIDDLE_MTF) at Nyquist.
    """
    zero = np.zeros((1, 1))
    along = sensor_mtf(zero, CURVE_FREQUENCIES.T, sensor).ravel()
    across = sensor_mtf(CURVE_FREQUENCIES, zero, sensor).ravel()
    contrast = np.maximum(np.abs([across, along]), LEAST_MTF)
    middle = mtf(CURVE_FREQUENCIES, zero, MIDDLE_MTF)
    noise = noise_over_full_scale(sensor)
    return 2 * float(np.log(contrast / middle).mean()), math.log(noise / MIDDLE_NOISE)
