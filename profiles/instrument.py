"""Define one instrument, with a single value for every parameter, and its physical model."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from beers_deploy.profiles.effects import Dsnu, Effect, EffectTable, Prnu, Striping
from beers_deploy.profiles.response import PointSpread, Response

MAX_DN = 4095
"""The largest digital number of 12 bits, which is full scale unless a sensor states otherwise."""
MTF_NYQUIST_MAX = 2 / math.pi
"""The MTF at Nyquist of a perfect lens over a square detector: sinc(0.5).

A higher value is no blur: its gamma would be negative.
"""
OFFSET = "offset"
ROUNDING = 1e-14
"""The relative float64 rounding error of a variance that should be 0, as a share of the larger of
the two variances.
"""

E = TypeVar("E", Effect, EffectTable)


@dataclass(frozen=True)
class Instrument:
    """One instrument, with a single value for every parameter.

    One is drawn for every training patch, so it is a plain dataclass without validation. The
    profile that it is drawn from has been validated.

    The noise variance is alpha * L + beta, with L in W/m2/sr/um (paper, section 3.3,
    signal-dependent noise).

    Attributes:
        mtf_nyquist: contrast at 0.5 cycles per pixel; across the track if the two axes differ.
        alpha: signal-dependent variance per radiance, in W/m2/sr/um.
        beta: variance in the dark, in (W/m2/sr/um)^2.
        gain_dn_per_radiance: digital numbers per W/m2/sr/um.
        bits: number of bits of a digital number.
        effects: effects in addition to blur, noise and digitising, by the name of their table in a
            sensor's file, such as "smear".
        mtf_nyquist_along: contrast along the track; None if it equals the contrast across it. The
            detector line of a pushbroom lies across the track, so image rows are lines in time.
            "Across" is therefore the horizontal axis (along a row, fx) and "along" the vertical one
            (down a column, fy).
        radiance_1: radiance of bright objects in its scenes, in W/m2/sr/um: the brighter point at
            which its SNR is stated.
        response: the complete blur, as a table or a point-spread function. Its contrasts at Nyquist
            are then repeated in `mtf_nyquist` and `mtf_nyquist_along`. None if the formula's blur
            applies, which these two contrasts determine.
    """

    mtf_nyquist: float
    alpha: float
    beta: float
    gain_dn_per_radiance: float
    bits: int
    effects: Mapping[str, Effect] = field(default_factory=dict)
    mtf_nyquist_along: float | None = None
    radiance_1: float = 100.0
    response: Response | None = None

    @property
    def blur(self) -> tuple[float, float] | Response:
        """The parameters that determine the MTF at every frequency: the response if there is one,
        otherwise the two contrasts at Nyquist.
        """
        return self.mtf_axes if self.response is None else self.response

    @property
    def symmetry(self) -> tuple[bool, bool]:
        """Two flags: whether an image, mirrored or rotated by 90 degrees, could have been acquired
        by the same sensor.

        The first flag is for mirroring, the second for rotation. They tell which of the two may
        augment training patches.
        """
        if isinstance(self.response, PointSpread):
            # A point-spread function may have no symmetry at all.
            return False, False
        across, along = (
            (self.response.across, self.response.along) if self.response else self.mtf_axes
        )
        return True, across == along

    @property
    def mtf_axes(self) -> tuple[float, float]:
        """Contrast at 0.5 cycles per pixel (across the track, along it), that is horizontally and
        vertically.
        """
        across = self.mtf_nyquist
        return across, across if self.mtf_nyquist_along is None else self.mtf_nyquist_along

    @property
    def max_dn(self) -> int:
        """The largest digital number, 4095 for 12 bits."""
        return int(2**self.bits) - 1

    @property
    def offset_dn(self) -> float:
        """The digital number of a pixel without light; 0 without an offset."""
        return float(getattr(self.effects.get(OFFSET), "offset_dn", 0))

    def dark_value(self, full_scale: float) -> float:
        """Return the pixel value without light, if the largest digital number is `full_scale`."""
        return self.offset_dn * full_scale / self.max_dn

    @property
    def antialias_px(self) -> float:
        """Standard deviation of the anti-alias filter in pixels of this sensor; 0 without one."""
        return float(getattr(self.effects.get("antialias"), "sigma_px", 0))

    @property
    def smear_px(self) -> float:
        """Length of the motion along the track during an exposure, in pixels of this sensor; 0
        without smear.
        """
        return float(getattr(self.effects.get("smear"), "length_px", 0))

    def in_units_of(self, other: "Instrument") -> "Instrument":
        """Return an instrument with the blur and noise of this one, and with the gain, bits and
        offset of `other`.

        Pixels of the two can then be compared, because their digital numbers mean the same
        radiance.
        """
        effects = with_offset_of(other.effects, self.effects)
        return replace(
            self, gain_dn_per_radiance=other.gain_dn_per_radiance, bits=other.bits, effects=effects
        )

    def noise_sigma(self, radiance: float) -> float:
        """Return the standard deviation of the noise of a pixel of the given radiance, both in
        W/m2/sr/um.
        """
        # A sharp blur rings below zero, where the variance would be negative and have no root.
        return math.sqrt(max(self.alpha * radiance + self.beta, 0.0))


def with_offset_of(others: Mapping[str, E], own: Mapping[str, E]) -> dict[str, E]:
    """Return the effects of one instrument with the offset of another one in place of their own.

    Args:
        others: effects of the instrument whose offset is taken, by name; without an offset among
            them the result has none.
        own: effects from which everything but the offset is taken, by name.
    """
    effects = {name: effect for name, effect in own.items() if name != OFFSET}
    if OFFSET in others:
        effects[OFFSET] = others[OFFSET]
    return effects


def mtf_limit(antialias_sigma_px: float) -> float:
    """Return the highest possible MTF at Nyquist: 2 / pi (a perfect lens over a square detector)
    times the gain of the anti-alias filter.

    The gain of a Gaussian filter is exp(-2 pi^2 sigma^2 f^2) at f = 0.5 cycles per pixel.

    Args:
        antialias_sigma_px: standard deviation of the filter in pixels of the sensor; 0 is no
            filter.
    """
    return MTF_NYQUIST_MAX * math.exp(-2 * (math.pi * antialias_sigma_px * 0.5) ** 2)


def noise_from_snr(
    radiance_0: float, snr_0: float, radiance_1: float, snr_1: float
) -> tuple[float, float]:
    """Solve sigma_i^2 = (L_i / SNR_i)^2 = alpha L_i + beta for (alpha, beta) (paper, section 3.3).

    Args:
        radiance_0: the darker radiance L_0, in W/m2/sr/um.
        snr_0: the SNR at `radiance_0`, as a linear ratio.
        radiance_1: the brighter radiance L_1, in the same unit.
        snr_1: the SNR at `radiance_1`, as a linear ratio.

    Returns:
        Alpha in W/m2/sr/um and beta in its square. Either is negative if no instrument can have the
        two SNRs: see `snr_0_bounds`. On a bound it is exactly 0, because rounding errors are
        removed.
    """
    variance_0 = (radiance_0 / snr_0) ** 2
    variance_1 = (radiance_1 / snr_1) ** 2
    # Where the exact difference is 0, rounding may leave either sign, and the pair would count as
    # impossible.
    rounding = ROUNDING * max(variance_0, variance_1)
    slope = _rounded_off(variance_1 - variance_0, rounding)
    alpha = slope / (radiance_1 - radiance_0)
    return alpha, _rounded_off(variance_0 - alpha * radiance_0, rounding)


def _rounded_off(difference: float, rounding: float) -> float:
    return 0.0 if abs(difference) <= rounding else difference


def snr_0_bounds(radiance_0: float, radiance_1: float, snr_1: float) -> tuple[float, float]:
    """Return the lowest and the highest SNR that an instrument can have at `radiance_0`, given its
    SNR at a brighter point.

    The variance of its noise is alpha L + beta, with L the radiance. At the lower bound alpha is 0,
    at the upper bound beta is 0; between them both are positive.

    Args:
        radiance_0: the darker radiance, in W/m2/sr/um.
        radiance_1: the brighter radiance, in the same unit.
        snr_1: the SNR at `radiance_1`, as a linear ratio.
    """
    # Alpha >= 0 requires sigma_0 <= sigma_1, and beta >= 0 requires sigma_0^2 / L_0 >= sigma_1^2 /
    # L_1; sigma is L / SNR.
    ratio = radiance_0 / radiance_1
    return snr_1 * ratio, snr_1 * math.sqrt(ratio)


class PixelNoise(NamedTuple):
    """The noise of a pixel. Its variance is dark + growth x + square x^2, with x the pixel value
    less that of the dark.

    Attributes:
        dark: the variance in the dark, in squared pixel values.
        growth: its growth with the light, in pixel values.
        square: its growth with the squared light.
        offset: the pixel value of the dark.
    """

    dark: float
    growth: float
    square: float
    offset: float

    def variance(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return the variance at pixel values of any shape, in their floating-point type."""
        light = np.maximum(pixels - self.offset, 0)
        return np.asarray(self.dark + self.growth * light + self.square * light**2)


def pixel_noise(sensor: Instrument, full_scale: float, patterns: float = 1) -> PixelNoise:
    """Return the noise of a sensor's pixels.

    The differences of detectors that a profile states count as noise, because no single one of them
    is known. 1/12 DN^2, the variance of rounding to integers, is a part of that in the dark.

    Args:
        sensor: the instrument.
        full_scale: the pixel value that is the sensor's largest digital number.
        patterns: the factor with which differences between columns count: where pixels are summed,
            the number of rows of a sum, because the rows of a column differ alike.
    """
    unit = full_scale / sensor.max_dn
    gain = sensor.gain_dn_per_radiance
    dark = sensor.beta * gain**2 + 1 / 12
    square = 0.0
    for effect in sensor.effects.values():
        if isinstance(effect, Dsnu):
            dark += patterns * effect.rms_dn**2
        elif isinstance(effect, Striping):
            dark += (effect.odd_even_dn / 2) ** 2
        elif isinstance(effect, Prnu):
            square = patterns * effect.rms**2
    growth = sensor.alpha * gain * unit
    return PixelNoise(dark * unit**2, growth, square, sensor.dark_value(full_scale))
