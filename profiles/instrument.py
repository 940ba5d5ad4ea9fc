"""One instrument, every number settled, and the physics that its numbers follow."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from beers_deploy.profiles.effects import Effect, Table
from beers_deploy.profiles.response import PointSpread, Response

MAX_DN = 4095
"""The largest digital number of 12 bits: full scale, unless a sensor says otherwise."""
MTF_NYQUIST_MAX = 2 / math.pi
"""A perfect lens over a square detector: sinc(0.5).

Nothing above it is a blur: its gamma would be negative.
"""
OFFSET = "offset"
ROUNDING = 1e-14
"""What float64 may leave of a variance that ought to be 0, of the larger of the two variances."""

E = TypeVar("E", Effect, Table)


@dataclass(frozen=True)
class Instrument:
    """One instrument, every number settled.

    One is drawn for every training patch, so it is a plain dataclass: the profile that it is drawn
    from has been checked.

    The noise variance is alpha * L + beta, L in W/m2/sr/um (paper, section 3.3, signal-dependent
    noise).

    Attributes:
        mtf_nyquist: contrast kept at 0.5 cycles per pixel; across the track where the two axes
            differ.
        alpha: signal-dependent variance per radiance, in W/m2/sr/um.
        beta: variance in the dark, in (W/m2/sr/um)^2.
        gain_dn_per_radiance: digital numbers per W/m2/sr/um.
        bits: of a digital number.
        effects: beside blur, noise and digitising, by name.
        mtf_nyquist_along: contrast kept along the track; None where it is that across. A
            pushbroom's line of detectors lies across the track: image rows are lines in time, so
            "across" is the horizontal axis (along a row, fx) and "along" the vertical one (down a
            column, fy).
        radiance_1: of what is bright in its scenes, in W/m2/sr/um: the brighter point at which its
            SNR is stated.
        response: the blur in full, by a table or a point-spread function; its contrasts at Nyquist
            then stand in `mtf_nyquist` and `mtf_nyquist_along`. None for the formula's blur, which
            these two settle.
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

    def __post_init__(self) -> None:
        if self.response is not None and not np.allclose(self.mtf_axes, self.response.at_nyquist):
            raise ValueError(
                f"the MTF at Nyquist is {self.mtf_axes}, but the response has "
                f"{self.response.at_nyquist} there"
            )

    @property
    def blur(self) -> tuple[float, float] | Response:
        """What settles the MTF at every frequency: the response where there is one, else the two
        contrasts.
        """
        return self.mtf_axes if self.response is None else self.response

    @property
    def symmetry(self) -> tuple[bool, bool]:
        """Whether its images still are images of this sensor when (mirrored,
        turned by a quarter).
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
        """Contrast kept at 0.5 cycles per pixel, (across the track, along it): horizontally and
        vertically.
        """
        return (
            self.mtf_nyquist,
            self.mtf_nyquist if self.mtf_nyquist_along is None else self.mtf_nyquist_along,
        )

    @property
    def max_dn(self) -> int:
        """The largest digital number, 4095 for 12 bits."""
        return int(2**self.bits) - 1

    @property
    def offset_dn(self) -> float:
        """The digital number of the dark; 0 without an offset."""
        return float(getattr(self.effects.get(OFFSET), "offset_dn", 0))

    @property
    def antialias_px(self) -> float:
        """Standard deviation of the anti-alias filter in target pixels; 0 without one."""
        return float(getattr(self.effects.get("antialias"), "sigma_px", 0))

    @property
    def smear_px(self) -> float:
        """Length of the motion along the track in target pixels; 0 without smear."""
        return float(getattr(self.effects.get("smear"), "length_px", 0))

    def in_units_of(self, other: "Instrument") -> "Instrument":
        """This sensor's blur and noise in the digital numbers of `other`: its gain, bits and
        offset.
        """
        effects = with_offset_of(other.effects, self.effects)
        return replace(
            self, gain_dn_per_radiance=other.gain_dn_per_radiance, bits=other.bits, effects=effects
        )

    def noise_sigma(self, radiance: float) -> float:
        """Standard deviation of the noise at `radiance`, both in W/m2/sr/um."""
        # A sharp blur rings below zero, where the variance would be negative and have no root.
        return math.sqrt(max(self.alpha * radiance + self.beta, 0.0))


def with_offset_of(others: Mapping[str, E], own: Mapping[str, E]) -> dict[str, E]:
    """Return the own effects, but the offset of others."""
    return {name: effect for name, effect in own.items() if name != OFFSET} | {
        name: effect for name, effect in others.items() if name == OFFSET
    }


def mtf_limit(antialias_sigma_px: float = 0.0) -> float:
    """The highest MTF at Nyquist, that of a perfect lens: 2 / pi for a square detector, times the
    filter's gain.

    A Gaussian filter of sigma target pixels keeps exp(-2 pi^2 sigma^2 f^2) at f = 0.5 cycles per
    pixel.
    """
    return MTF_NYQUIST_MAX * math.exp(-2 * (math.pi * antialias_sigma_px * 0.5) ** 2)


def noise_from_snr(
    radiance_0: float, snr_0: float, radiance_1: float, snr_1: float
) -> tuple[float, float]:
    """Solve sigma_i^2 = (L_i / SNR_i)^2 = alpha L_i + beta for (alpha, beta) (paper, section 3.3).

    Either may come out negative: see `snr_0_bounds`. On a bound it is 0, whatever rounding left of
    it.
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
    """The SNRs at `radiance_0` that leave alpha >= 0 (lower bound) and beta >= 0 (upper bound)."""
    # Alpha >= 0 asks for sigma_0 <= sigma_1, and beta >= 0 for sigma_0^2 / L_0 >= sigma_1^2 / L_1;
    # sigma is L / SNR.
    ratio = radiance_0 / radiance_1
    return snr_1 * ratio, snr_1 * math.sqrt(ratio)
