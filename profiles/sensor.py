"""Sensor profiles: the grid, the MTF, the noise and the digitiser of one instrument.

A profile may state ranges (a family of sensors); `Sensor.draw` picks one physical `Instrument` from
it.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import field
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from beers_deploy.profiles.constant import Constant, Limits, Stated
from beers_deploy.profiles.effects import Effect, Effects, settled
from beers_deploy.profiles.errors import (
    MachineError,
    ProfileError,
    as_path,
    counted,
    require_numbers,
)
from beers_deploy.profiles.instrument import (
    OFFSET,
    Instrument,
    noise_from_snr,
    snr_0_bounds,
    with_offset_of,
)
from beers_deploy.profiles.response import MtfTable, Response, unpacked
from beers_deploy.profiles.sensor_checks import (
    impossible_snr,
    require_possible_blur,
    require_possible_noise,
    require_possible_offset,
)
from beers_deploy.profiles.sensor_file import (
    GROUPS,
    LEAST,
    MOST,
    TABLE_OF,
    TABLES,
    Contrast,
    Radiance,
    Ratio,
    Variance,
    sensor_fields,
    sensor_toml,
)
from beers_deploy.profiles.shipped import BLIND, BLIND_PROFILE, REFERENCE, profile_path
from beers_deploy.profiles.toml import read_toml
from beers_deploy.profiles.validation import CONFIG, validated

MAX_DRAWS = 10_000


def _quarter(of: float, name: str) -> Constant:
    """Return the default of a radiance, where the noise is given by alpha and beta."""
    return Constant(of / 4, "inferred", f"a quarter of {name}")


@dataclass(frozen=True, repr=False, config=CONFIG)
class Sensor:
    """A sensor profile: the content of one TOML file under `profiles/sensors/`, each number with
    its source. Ranges describe a family of sensors.

    `gsd_m` is the side of a pixel on the ground in m, and that of `oversampling` scene pixels.
    `mtf_nyquist` is the contrast at 0.5 cycles per pixel; `mtf_nyquist_along` is that along the
    track, if it differs. `response` is the complete blur, if known. Two SNRs, at `radiance_0` and
    `radiance_1` in W/m2/sr/um, state the noise, or `alpha` and `beta` do: its variance is alpha L +
    beta.

    Examples:
        >>> sensor = bd.Sensor.load("pleiades-degraded").replace(mtf_nyquist=0.05)
        >>> sensor.mtf_nyquist.low
        0.05
    """

    name: str
    description: str
    gsd_m: Annotated[Constant, Limits(LEAST, MOST, hint="Give the ground sampling distance.")]
    oversampling: Annotated[
        Constant,
        Limits(1, MOST, whole=True, hint="Give the number of scene pixels per sensor pixel."),
    ]
    mtf_nyquist: Contrast
    bits: Annotated[
        Constant, Limits(1, 16, whole=True, single=True, hint="Give the bits per pixel.")
    ]
    gain_dn_per_radiance: Annotated[
        Constant,
        Limits(LEAST, MOST, single=True, hint="Give full-scale DN divided by full-scale radiance."),
    ]
    radiance_1: Radiance = Field(
        default_factory=lambda fields: _quarter(
            (2 ** fields["bits"].low - 1) / fields["gain_dn_per_radiance"].low, "full scale"
        )
    )
    radiance_0: Radiance = Field(
        default_factory=lambda fields: _quarter(fields["radiance_1"].low, "radiance_1")
    )
    snr_0: Ratio | None = None
    snr_1: Ratio | None = None
    alpha: Variance | None = None
    beta: Variance | None = None
    # A dictionary has no hash. Sensors that differ in effects alone share theirs.
    effects: Effects = field(default_factory=dict, hash=False)
    mtf_nyquist_along: Contrast | None = None
    response: Response | None = None

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        """Raise ValueError if no instrument can have these numbers."""
        radiances = self.radiance_0, self.radiance_1
        require_possible_noise(radiances, (self.snr_0, self.snr_1), (self.alpha, self.beta))
        require_possible_blur(self.contrasts, self.response, self.effects)
        _, bits, offset_dn = self.units
        require_possible_offset(int(bits), offset_dn)
        return self

    @classmethod
    def load(cls, sensor: "Sensor | str | os.PathLike[str]") -> "Sensor":
        """Load a shipped sensor by its name, or a user's sensor by the path of its .toml file.

        A `Sensor` is returned unchanged.

        Raises:
            ProfileError: unknown name, wrong or missing key, or numbers that no instrument can
                have.
        """
        if isinstance(sensor, Sensor):
            return sensor
        if not isinstance(sensor, str | os.PathLike):
            raise ProfileError(
                f"A sensor must be a Sensor, a name or the path of a .toml file, got "
                f"{type(sensor).__name__}. 'beers-deploy profiles' lists the names."
            )
        name = os.fspath(sensor)
        source = BLIND_PROFILE if name == BLIND else name
        label, raw = read_toml("sensors", source)
        fields = sensor_fields(label, raw, profile_path("sensors", source).parent)
        if name == BLIND:
            fields["name"] = BLIND
        return validated(Sensor, fields, label, GROUPS)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the profile as a TOML file that `load` reads, with a point-spread function next to
        it as .npy.

        Raises:
            MachineError: the file cannot be written.
        """
        path = as_path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._write(path)
        except OSError as error:
            raise MachineError(
                f"{path} cannot be written: {error.strerror}. Choose another path."
            ) from error
        return path

    def _write(self, path: Path) -> None:
        tables: dict[str, dict[str, object]] = {table: {} for table in TABLES}
        for key, table in TABLE_OF.items():
            if constant := getattr(self, key):
                tables[table][key] = constant
        across, along = self.contrasts
        blur = self.response
        if isinstance(blur, MtfTable):
            tables["mtf"] = {
                "frequency": blur.frequency,
                "across": _stated(blur.across, across),
                "along": _stated(blur.along, along),
            }
        elif blur:
            samples = path.with_name(f"{path.stem}-psf.npy")
            np.save(samples, unpacked(blur).astype(np.float32))
            tables["mtf"] = {
                "psf": _stated(samples.name, across),
                "psf_samples_per_px": blur.samples_per_px,
            }
        text = sensor_toml(self.description, {**tables, **self.effects})
        path.write_text(text, encoding="utf-8")

    @property
    def contrasts(self) -> tuple[Constant, Constant]:
        """The contrasts at the Nyquist frequency across the track and along it."""
        return self.mtf_nyquist, self.mtf_nyquist_along or self.mtf_nyquist

    def replace(self, **numbers: float | tuple[float, float]) -> "Sensor":
        """Return this sensor with some numbers replaced, each by a value or a range (low, high).

        Args:
            numbers: new values by the file's keys, such as mtf_nyquist=0.1 or snr_1=(90, 110).

        Raises:
            ProfileError: no such number, or one that no instrument can have.
        """
        for key in numbers:
            if key not in TABLE_OF:
                raise ProfileError(
                    f"A sensor has no number {key!r}. Correct the name, which must be one of "
                    f"{', '.join(TABLE_OF)}."
                )
        fields = dict[str, object]()
        # Noise is stated in one of two ways. The numbers of one way replace those of the other.
        if numbers.keys() & {"alpha", "beta"}:
            fields |= dict.fromkeys(("snr_0", "snr_1"))
        if numbers.keys() & {"snr_0", "snr_1"}:
            fields |= dict.fromkeys(("alpha", "beta"))
        # A response determines the contrasts at Nyquist, so it is removed if they are replaced.
        if numbers.keys() & {"mtf_nyquist", "mtf_nyquist_along"}:
            fields["response"] = None
        # If numbers of both ways are given, the check of the noise refuses them.
        return self.with_fields(**{**fields, **numbers})

    def with_fields(self, **fields: object) -> "Sensor":
        """Return this sensor with other fields, or raise ProfileError if they are invalid."""
        # A measured sensor has a table too, which does not hold for other numbers.
        own = {key: getattr(self, key) for key in Sensor.__dataclass_fields__}
        return validated(Sensor, {**own, **fields}, f"sensor {self.name}", GROUPS)

    @property
    def reference(self) -> "Sensor":
        """The shipped sensor that a restoration aims at, in the digital numbers of this sensor."""
        return Sensor.load(REFERENCE).in_units_of(self)

    def to_radiance(self, pixels: Any) -> Any:
        """Convert digital numbers to radiance in W/m2/sr/um.

        Accepts a number or an array of any kind, and returns the same kind and shape.
        """
        require_numbers("pixels", pixels)
        gain, _, offset_dn = self.units
        return (pixels - offset_dn) / gain

    def to_dn(self, radiance: Any) -> Any:
        """Convert radiance in W/m2/sr/um to digital numbers, without rounding or clipping.

        Accepts a number or an array of any kind, and returns the same kind and shape.
        """
        require_numbers("radiance", radiance)
        gain, _, offset_dn = self.units
        return radiance * gain + offset_dn

    def noise(self, radiance: ArrayLike) -> NDArray[np.float64]:
        """Return the standard deviation of the noise at radiances, each range at its middle."""
        require_numbers("radiance", radiance)
        alpha, beta = self._middle_noise()
        return np.sqrt(np.maximum(alpha * np.asarray(radiance, np.float64) + beta, 0.0))

    def __repr__(self) -> str:
        noise = "noise by alpha and beta"
        if self.snr_1:
            noise = f"SNR {self.snr_1} at {self.radiance_1} W/m2/sr/um"
        bits = counted(int(self.bits.low), "bit")
        facts = [bits, f"MTF {self.mtf_nyquist} at Nyquist", noise, *self.effects]
        return f"Sensor({self.name!r}: {', '.join(facts)})"

    @property
    def units(self) -> tuple[float, float, float]:
        """The meaning of a digital number: DN per W/m2/sr/um, the number of bits, and the DN in the
        dark.
        """
        offset = self.effects[OFFSET]["offset_dn"].low if OFFSET in self.effects else 0.0
        return self.gain_dn_per_radiance.low, self.bits.low, offset

    def in_units_of(self, other: "Sensor") -> "Sensor":
        """Return this profile with the gain, bits and offset of `other`; itself if they are equal.

        Two acquisitions of one scene can be compared pixel by pixel only if their digital numbers
        mean the same.
        """
        if self.units == other.units:
            return self
        effects = with_offset_of(other.effects, self.effects)
        return self.with_fields(
            gain_dn_per_radiance=other.gain_dn_per_radiance, bits=other.bits, effects=effects
        )

    def draw(self, generator: np.random.Generator) -> Instrument:
        """Draw one instrument: MTF uniform, SNR pair uniform over the physically valid pairs."""
        return self.draw_counted(generator)[0]

    def draw_counted(self, generator: np.random.Generator) -> tuple[Instrument, int]:
        """Draw as `draw` does, and also count the SNR pairs rejected as impossible."""

        def number(constant: Constant) -> float:
            return float(generator.uniform(constant.low, constant.high))

        def parameter(constant: Constant) -> float:
            # A number without a range draws nothing, so that later draws stay the same.
            return number(constant) if constant.low < constant.high else constant.low

        mtf = number(self.mtf_nyquist)
        noise, rejected = self._draw_noise(number)
        effects = settled(self.effects, parameter)
        # Drawn last, so that a profile without it draws the same numbers as before.
        along = number(self.mtf_nyquist_along) if self.mtf_nyquist_along else None
        return self._instrument(mtf, noise, effects, along), rejected

    def _draw_noise(self, number: Callable[[Constant], float]) -> tuple[tuple[float, float], int]:
        """Return alpha and beta, and the number of SNR pairs that were rejected."""
        if self.alpha and self.beta:
            return (number(self.alpha), number(self.beta)), 0
        for rejected in range(MAX_DRAWS):
            noise = self._noise(*map(number, self.snr_pair))
            if min(noise) >= 0:
                return noise, rejected
        fault = impossible_snr((self.radiance_0, self.radiance_1), self.snr_pair)
        raise ProfileError(f"The sensor profile {self.name} {fault}")

    def nominal(self) -> Instrument:
        """Return the instrument in the middle of every range.

        The SNR at `radiance_0` is moved to the nearest physically possible value.
        """
        effects = settled(self.effects, attrgetter("middle"))
        across, along = (contrast.middle for contrast in self.contrasts)
        mtf_along = along if self.mtf_nyquist_along else None
        return self._instrument(across, self._middle_noise(), effects, mtf_along)

    def _middle_noise(self) -> tuple[float, float]:
        """Return alpha and beta in the middle of their ranges."""
        if self.alpha and self.beta:
            return self.alpha.middle, self.beta.middle
        snr_0, snr_1 = (snr.middle for snr in self.snr_pair)
        low, high = snr_0_bounds(self.radiance_0.low, self.radiance_1.low, snr_1)
        alpha, beta = self._noise(min(max(snr_0, low), high), snr_1)
        return max(alpha, 0.0), max(beta, 0.0)

    def _noise(self, snr_0: float, snr_1: float) -> tuple[float, float]:
        return noise_from_snr(self.radiance_0.low, snr_0, self.radiance_1.low, snr_1)

    @property
    def snr_pair(self) -> tuple[Constant, Constant]:
        """The SNRs at `radiance_0` and `radiance_1`, as linear ratios.

        Raises:
            ValueError: the noise is stated by alpha and beta.
        """
        if self.snr_0 is None or self.snr_1 is None:
            raise ValueError(f"sensor profile {self.name} states no SNR")
        return self.snr_0, self.snr_1

    def _instrument(
        self,
        mtf: float,
        noise: tuple[float, float],
        effects: Mapping[str, Effect],
        mtf_along: float | None,
    ) -> Instrument:
        alpha, beta = noise
        return Instrument(
            mtf_nyquist=mtf,
            alpha=alpha,
            beta=beta,
            gain_dn_per_radiance=self.gain_dn_per_radiance.low,
            bits=int(self.bits.low),
            effects=effects,
            mtf_nyquist_along=mtf_along,
            radiance_1=self.radiance_1.low,
            response=self.response,
        )


def _stated(value: object, contrast: Constant) -> Stated:
    """Return a part of the response with the provenance of its contrast."""
    return Stated(value, contrast.status, contrast.source)


def same_instrument(one: Sensor, other: Sensor) -> bool:
    """Return True if two profiles produce the same images; names and sources may differ."""
    return numbers_of(one) == numbers_of(other)


def numbers_of(profile: Sensor) -> dict[str, object]:
    """Return the numbers of a profile in a form that can be compared.

    Returns:
        From the name of each constant to its (low, high) ends, or None if the profile lacks it; the
        key "response" has the complete blur as text.
    """
    constants: dict[str, Constant | None] = {key: getattr(profile, key) for key in TABLE_OF}
    for effect, table in profile.effects.items():
        constants |= {f"{effect}.{key}": constant for key, constant in table.items()}
    ends = {key: constant and (constant.low, constant.high) for key, constant in constants.items()}
    # The representation contains all samples. The text of a response only contains a digest.
    return {**ends, "response": repr(profile.response)}


SensorLike = Sensor | str | os.PathLike[str]
"""A profile, the name of a shipped one, or the path of a .toml file."""
