"""Sensor profiles: the grid, the MTF, the noise and the digitiser of one instrument.

A profile may state ranges (a family of sensors); `Sensor.draw` picks one physical `Instrument` from
it.
"""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beers_deploy.profiles.constant import Constant, Number
from beers_deploy.profiles.effects import Effect, Table, draw_effect, middle_effect
from beers_deploy.profiles.errors import ProfileError
from beers_deploy.profiles.response import PointSpread, Response

MAX_DN = 4095
"""The largest digital number of 12 bits: full scale, unless a sensor says otherwise."""
MTF_NYQUIST_MAX = 2 / math.pi
"""A perfect lens over a square detector: sinc(0.5).

Nothing above it is a blur: its gamma would be negative.
"""

MAX_DRAWS = 10_000

E = TypeVar("E", Effect, Table)


OFFSET = "offset"

ROUNDING = 1e-14
"""What float64 may leave of a variance that ought to be 0, of the larger of the two variances."""


@dataclass(frozen=True)
class Instrument:
    """One instrument, every number settled.

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
        effects = _with_offset_of(other.effects, self.effects)
        return replace(
            self, gain_dn_per_radiance=other.gain_dn_per_radiance, bits=other.bits, effects=effects
        )

    def noise_sigma(self, radiance: float) -> float:
        """Standard deviation of the noise at `radiance`, both in W/m2/sr/um."""
        # A sharp blur rings below zero, where the variance would be negative and have no root.
        return math.sqrt(max(self.alpha * radiance + self.beta, 0.0))


@dataclass(frozen=True, repr=False)
class Sensor:
    """What one TOML file under `profiles/sensors/` states, each constant with its source.

    Its noise is stated by two SNRs, at `radiance_0` and `radiance_1`, or by `alpha` and `beta`. Its
    blur is that of a table or a point-spread function where `response` is one.

    Examples:
        >>> sensor = bd.Sensor.load("pleiades-degraded").replace(mtf_nyquist=0.05)
        >>> sensor.mtf_nyquist.low
        0.05
    """

    name: str
    description: str
    gsd_m: Constant
    oversampling: Constant
    mtf_nyquist: Constant
    radiance_0: Constant
    radiance_1: Constant
    bits: Constant
    gain_dn_per_radiance: Constant
    snr_0: Constant | None = None
    snr_1: Constant | None = None
    alpha: Constant | None = None
    beta: Constant | None = None
    effects: Mapping[str, Table] = field(default_factory=dict)
    mtf_nyquist_along: Constant | None = None
    response: Response | None = None

    @classmethod
    def load(cls, sensor: "Sensor | str | os.PathLike[str]") -> "Sensor":
        """A shipped sensor by its name, the user's own by the path of its .toml file, or the sensor
        given.

        Raises:
            ProfileError: unknown name, wrong or missing key, or numbers that no instrument can
                have.
        """
        # Imported here, because it reads what this file defines.
        from beers_deploy.profiles.sensor_file import load_sensor

        return sensor if isinstance(sensor, Sensor) else load_sensor(os.fspath(sensor))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the profile as a TOML file that `load` reads; a point-spread function lies beside
        it as .npy.
        """
        from beers_deploy.profiles.sensor_file import save_sensor

        return save_sensor(self, Path(path))

    def replace(self, **numbers: Number) -> "Sensor":
        """This sensor with other numbers, each a value or a range (low, high).

        Args:
            numbers: by the names of the file's keys, such as mtf_nyquist=0.1 or snr_1=(90, 110).

        Raises:
            ProfileError: no such number, or one that no instrument can have.
        """
        from beers_deploy.profiles.sensor_file import with_numbers

        return with_numbers(self, numbers)

    @property
    def reference(self) -> "Sensor":
        """The shipped sensor that a restoration of this one's images aims at, in this one's digital
        numbers.
        """
        from beers_deploy.profiles.sensor_file import reference_for

        return reference_for(self)

    def to_radiance(self, pixels: Any) -> Any:
        """Digital numbers as radiance in W/m2/sr/um: an array of any kind, of the same kind and
        shape.
        """
        gain, _, offset_dn = self.units
        return (pixels - offset_dn) / gain

    def to_dn(self, radiance: Any) -> Any:
        """Radiance in W/m2/sr/um as digital numbers, neither rounded nor clipped; an array of any
        kind.
        """
        gain, _, offset_dn = self.units
        return radiance * gain + offset_dn

    def noise(self, radiance: ArrayLike) -> NDArray[np.float64]:
        """Standard deviation of the noise at some radiances, both in W/m2/sr/um, in the middle of
        each range.
        """
        alpha, beta = self._middle_noise()
        return np.sqrt(np.maximum(alpha * np.asarray(radiance, np.float64) + beta, 0.0))

    def __repr__(self) -> str:
        across = self.mtf_nyquist
        bits = self.bits
        noise = (
            f"SNR {self.snr_1} at {self.radiance_1} W/m2/sr/um"
            if self.snr_1
            else "noise by alpha and beta"
        )
        more = f", {', '.join(self.effects)}" if self.effects else ""
        return f"Sensor({self.name!r}: {bits} bits, MTF {across} at Nyquist, {noise}{more})"

    @property
    def units(self) -> tuple[float, float, float]:
        """What a digital number means: DN per W/m2/sr/um, bits, and the DN of the dark."""
        offset = self.effects[OFFSET]["offset_dn"].low if OFFSET in self.effects else 0.0
        return self.gain_dn_per_radiance.low, self.bits.low, offset

    def in_units_of(self, other: "Sensor") -> "Sensor":
        """This profile with the gain, bits and offset of `other`; itself where they are the same.

        Two acquisitions of one scene compare, pixel by pixel, only where a digital number means the
        same in both.
        """
        if self.units == other.units:
            return self
        effects = _with_offset_of(other.effects, self.effects)
        return replace(
            self, gain_dn_per_radiance=other.gain_dn_per_radiance, bits=other.bits, effects=effects
        )

    def draw(self, generator: np.random.Generator) -> Instrument:
        """Pick one sensor from the ranges: MTF uniform, SNR pair uniform over the physically valid
        pairs.
        """
        return self.draw_counted(generator)[0]

    def draw_counted(self, generator: np.random.Generator) -> tuple[Instrument, int]:
        """As `draw`, with the number of SNR pairs that were rejected as impossible."""
        mtf_nyquist = _uniform(generator, self.mtf_nyquist)
        (alpha, beta), rejected = self._draw_noise(generator)
        effects = {
            name: draw_effect(name, table, generator) for name, table in self.effects.items()
        }
        # Drawn last: a profile without it draws what it always drew.
        along = self.mtf_nyquist_along
        mtf_along = None if along is None else _uniform(generator, along)
        return self._sensor(mtf_nyquist, alpha, beta, effects, mtf_along), rejected

    def _draw_noise(self, generator: np.random.Generator) -> tuple[tuple[float, float], int]:
        """Alpha and beta, and the number of SNR pairs that were rejected."""
        if self.alpha is not None and self.beta is not None:
            return (_uniform(generator, self.alpha), _uniform(generator, self.beta)), 0
        pair = self.snr_pair
        for rejected in range(MAX_DRAWS):
            snr_0, snr_1 = (_uniform(generator, snr) for snr in pair)
            alpha, beta = noise_from_snr(self.radiance_0.low, snr_0, self.radiance_1.low, snr_1)
            if alpha >= 0 and beta >= 0:
                return (alpha, beta), rejected
        raise self.impossible_snr()

    def nominal(self) -> Instrument:
        """The middle of every range (the SNR at radiance_0 moved to the nearest physical value)."""
        alpha, beta = self._middle_noise()
        effects = {name: middle_effect(name, table) for name, table in self.effects.items()}
        mtf_along = None if self.mtf_nyquist_along is None else self.mtf_nyquist_along.middle
        return self._sensor(self.mtf_nyquist.middle, alpha, beta, effects, mtf_along)

    def _middle_noise(self) -> tuple[float, float]:
        if self.alpha is not None and self.beta is not None:
            return self.alpha.middle, self.beta.middle
        snr_0, snr_1 = (snr.middle for snr in self.snr_pair)
        low, high = snr_0_bounds(self.radiance_0.low, self.radiance_1.low, snr_1)
        alpha, beta = noise_from_snr(
            self.radiance_0.low, min(max(snr_0, low), high), self.radiance_1.low, snr_1
        )
        return max(alpha, 0.0), max(beta, 0.0)

    @property
    def snr_pair(self) -> tuple[Constant, Constant]:
        """The SNRs at `radiance_0` and `radiance_1`.

        Raises:
            ValueError: the noise is stated by alpha and beta.
        """
        if self.snr_0 is None or self.snr_1 is None:
            raise ValueError(f"sensor profile {self.name} states no SNR")
        return self.snr_0, self.snr_1

    def _sensor(
        self,
        mtf: float,
        alpha: float,
        beta: float,
        effects: Mapping[str, Effect],
        mtf_along: float | None,
    ) -> Instrument:
        gain = self.gain_dn_per_radiance.low
        bits = int(self.bits.low)
        radiance_1 = self.radiance_1.low
        return Instrument(
            mtf, alpha, beta, gain, bits, effects, mtf_along, radiance_1, self.response
        )

    def impossible_snr(self) -> ProfileError:
        """The error of SNRs that no alpha and beta can have, with the range that the first one must
        lie in.
        """
        snr_0, snr_1 = self.snr_pair
        low, high = snr_0_bounds(self.radiance_0.low, self.radiance_1.low, snr_1.high)
        return ProfileError(
            f"The sensor profile {self.name} has noise.snr_0 = {snr_0}, but with noise.snr_1 = "
            f"{snr_1.high:g} at {self.radiance_1} W/m2/sr/um, the SNR at {self.radiance_0} must be "
            f"{low:g} to {high:g} (variance alpha L + beta with alpha, beta >= 0). Correct one of "
            "the two; both are linear ratios, not dB."
        )


SensorLike = Sensor | str | os.PathLike[str]
"""A profile, the name of a shipped one, or a .toml file."""


def _with_offset_of(others: Mapping[str, E], own: Mapping[str, E]) -> dict[str, E]:
    """The own effects, but the offset of others."""
    return {name: effect for name, effect in own.items() if name != OFFSET} | {
        name: effect for name, effect in others.items() if name == OFFSET
    }


def require_same_units(degraded: Sensor, reference: Sensor) -> None:
    """Refuse a reference that another digitiser made: its images differ from the degraded ones by a
    factor.
    """
    if degraded.units != reference.units:
        raise ProfileError(
            f"The sensor profile {reference.name}, the reference of {degraded.name}, must have "
            f"{describe_units(degraded)}, but it has {describe_units(reference)}. Convert the "
            "reference to the degraded sensor's units."
        )


def describe_units(profile: Sensor) -> str:
    """What a digital number of the profile means, in words."""
    gain, bits, offset_dn = profile.units
    return f"{gain:g} DN per W/m2/sr/um, {bits:g} bits" + (
        f", {offset_dn:g} DN of offset" if offset_dn else ""
    )


def mtf_limit(antialias_sigma_px: float = 0.0) -> float:
    """The highest MTF at Nyquist, that of a perfect lens: 2 / pi for a square detector, times the
    filter's gain.

    A Gaussian filter of sigma target pixels keeps exp(-2 pi^2 sigma^2 f^2) at f = 0.5 cycles per
    pixel.
    """
    return MTF_NYQUIST_MAX * math.exp(-2 * (math.pi * antialias_sigma_px * 0.5) ** 2)


def _uniform(generator: np.random.Generator, constant: Constant) -> float:
    return float(generator.uniform(constant.low, constant.high))


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


TABLES: dict[str, tuple[tuple[tuple[str, ...], tuple[str, ...]], ...]] = {
    "grid": ((("gsd_m", "oversampling"), ()),),
    "mtf": (
        (("mtf_nyquist",), ("mtf_nyquist_along",)),
        (("frequency", "across"), ("along",)),
        (("psf", "psf_samples_per_px"), ()),
    ),
    "noise": (
        (("radiance_0", "snr_0", "radiance_1", "snr_1"), ()),
        (("alpha", "beta"), ("radiance_0", "radiance_1")),
    ),
    "digitiser": ((("bits", "gain_dn_per_radiance"), ()),),
}
"""Every table that a profile has, and the ways to fill it: the keys that each needs, and those that
it may have.
"""

RESPONSE = ("frequency", "across", "along", "psf", "psf_samples_per_px")
"""Keys that make up the response; each other key of `TABLES` is a constant, and a field of
`Sensor`.
"""


def table_keys(table: str) -> tuple[str, ...]:
    """Every key that a table may have, each once, in the order of its ways."""
    keys: dict[str, None] = {}
    for required, optional in TABLES[table]:
        keys |= dict.fromkeys(required + optional)
    return tuple(keys)


def constant_keys(table: str) -> tuple[str, ...]:
    """Those of them that are constants."""
    return tuple(key for key in table_keys(table) if key not in RESPONSE)


TABLE_OF: dict[str, str] = {}
for _table in TABLES:
    TABLE_OF |= dict.fromkeys(constant_keys(_table), _table)
"""The table of each constant."""


def same_instrument(one: Sensor, other: Sensor) -> bool:
    """Whether two profiles state the same numbers, whatever they are called and wherever the
    numbers come from.
    """
    return numbers_of(one) == numbers_of(other)


def numbers_of(profile: Sensor) -> dict[str, object]:
    """The low and high end of each constant by name: what of a profile decides what its images are
    like.
    """
    constants: dict[str, Constant | None] = {key: getattr(profile, key) for key in TABLE_OF}
    for effect, table in profile.effects.items():
        constants |= {f"{effect}.{key}": constant for key, constant in table.items()}
    numbers: dict[str, object] = {
        key: constant and (constant.low, constant.high) for key, constant in constants.items()
    }
    # The representation holds all samples, where the text of a response holds a digest.
    return {**numbers, "response": repr(profile.response)}
