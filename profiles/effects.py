"""Define the effects that a sensor or a scene may add to blur, noise and digitising: one class per
TOML table.

A profile adds an effect by having its table. A class has its parameters with their limits, applies
the effect to an image, and states the largest change and the cost of it. At their neutral values
the parameters leave the image unchanged.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Protocol, get_type_hints

import numpy as np
from pydantic import AfterValidator, PlainValidator, create_model

from beers_deploy.profiles.constant import Constant, Limits
from beers_deploy.profiles.validation import CONFIG, check_keys

PATTERN_LIMIT = 4.0
"""Random numbers are clipped to this many standard deviations, so that bounds can be proven. The
factory rejects detectors further out.
"""

Generator = Callable[[], np.random.Generator]
"""A function that returns the random generator of one effect."""


class Digitiser(Protocol):
    """The two properties of an instrument that its effects need to convert radiance to pixel
    values.
    """

    @property
    def gain_dn_per_radiance(self) -> float:
        """Digital numbers per W/m2/sr/um."""

    @property
    def max_dn(self) -> int:
        """The largest digital number that a pixel can have."""


@dataclass(frozen=True)
class Effect:
    """An imperfection of an instrument or of the atmosphere, with its parameters.

    A subclass is one effect, and each of its fields is a parameter: a number within the limits that
    its annotation states. Effects are made for every drawn sensor, so they are plain dataclasses:
    the limits are checked once, on the tables that they are drawn from.
    """

    cost: ClassVar[str] = "none: part of the MTF"
    """The computing time that the effect takes, in words, for the plan that `simulate` prints."""

    @classmethod
    def limits(cls) -> dict[str, Limits]:
        """Return the limits of each parameter, by its name."""
        hints = get_type_hints(cls, include_extras=True).items()
        return {name: hint.__metadata__[0] for name, hint in hints if hasattr(hint, "__metadata__")}


@dataclass(frozen=True)
class PixelEffect(Effect, ABC):
    """An effect on the sampled image, in radiance (W/m2/sr/um) or in digital numbers (DN).

    `acts_on` is the unit of the images that `apply` accepts and returns.
    """

    acts_on: ClassVar[Literal["radiance", "DN"]]
    cost: ClassVar[str] = "1 pass"
    unseen: ClassVar[str] = ""
    """The reason why a scene cannot show the effect if its bound is zero. If empty, its parameters
    are neutral then.
    """

    @property
    def growth(self) -> float:
        """The largest factor by which the effect enlarges a difference between two input images."""
        return 1.0

    @abstractmethod
    def apply(self, image: np.ndarray, sensor: Digitiser, generator: Generator) -> np.ndarray:
        """Return the image with the effect applied, in the same unit and shape.

        Args:
            image: (..., H, W) in the unit `acts_on`. Columns are detectors.
            sensor: the gain and the full scale of the instrument.
            generator: a function that returns the random generator of this effect. Only effects
                that draw random numbers call it.
        """

    @abstractmethod
    def bound_dn(self, sensor: Digitiser, low: float, high: float) -> float:
        """Return the largest change, in DN, that the effect can make to any pixel of a scene.

        Args:
            sensor: the gain and the full scale of the instrument.
            low: the smallest radiance of the signal, in W/m2/sr/um.
            high: the largest radiance of the signal, in W/m2/sr/um.
        """


@dataclass(frozen=True)
class AntiAlias(Effect):
    """A Gaussian low-pass filter against aliasing, of standard deviation sigma_px pixels of the
    sensor; 0 is no filter.

    The filter is part of the blur that the sensor's MTF at Nyquist states, and does not add to it.
    """

    sigma_px: Annotated[float, Limits(0.0, 5.0)]


@dataclass(frozen=True)
class Smear(Effect):
    """Blur by uniform motion along the track during one exposure, over length_px pixels of the
    sensor; 0 is none.
    """

    length_px: Annotated[float, Limits(0.0, 20.0)]


@dataclass(frozen=True)
class Haze(PixelEffect):
    """Light that the atmosphere absorbs and adds, table `veil` of a file: L' = transmittance * L +
    path_radiance.

    It is the same before and after the blur, whose gain at frequency 0 is 1.

    Attributes:
        transmittance: share of the light that passes the atmosphere; 1 is clear.
        path_radiance: radiance that the atmosphere adds, in W/m2/sr/um; 0 is none.
    """

    transmittance: Annotated[float, Limits(0.0, 1.0)]
    path_radiance: Annotated[float, Limits(0.0, 1e4)]
    acts_on = "radiance"

    def apply(self, image: np.ndarray, sensor: Digitiser, generator: Generator) -> np.ndarray:
        return image * self.transmittance + self.path_radiance

    def bound_dn(self, sensor: Digitiser, low: float, high: float) -> float:
        changes = (abs((self.transmittance - 1) * v + self.path_radiance) for v in (low, high))
        return sensor.gain_dn_per_radiance * max(changes)  # Affine in L: the ends decide.


@dataclass(frozen=True)
class FullWell(PixelEffect):
    """Saturation of the detectors, and blooming: a share of the light beyond saturation runs along
    the column.

    L' = min(L + share * (k * max(L - well, 0)), well). k spreads the excess up and down the column,
    falling by e every `blooming_px` pixels, and sums to 1 at most (what leaves the image is lost).
    Below the well nothing changes; share 0 is a plain clip.

    Attributes:
        radiance: the well, which is the radiance in W/m2/sr/um at which a detector is full.
        blooming_share: the share of the excess that runs along the column.
        blooming_px: the distance in pixels over which the excess falls by a factor e.
    """

    radiance: Annotated[float, Limits(1e-6, 1e6)]
    blooming_share: Annotated[float, Limits(0.0, 0.5)]
    blooming_px: Annotated[float, Limits(0.0, 64.0)]
    acts_on = "radiance"
    cost = "1 pass, 1 convolution if it blooms"
    unseen = "the brightest signal stays below the well"

    @property
    def growth(self) -> float:
        # The kernel sums to 1 at most, so that blooming adds at most this share of a change.
        return 1 + self.blooming_share

    def apply(self, image: np.ndarray, sensor: Digitiser, generator: Generator) -> np.ndarray:
        excess = np.maximum(image - self.radiance, 0)
        if self.blooming_share > 0 and self.blooming_px > 0 and (excess > 0).any():
            image = image + self.blooming_share * _spread(excess, self.blooming_px)
        return np.asarray(np.minimum(image, self.radiance))

    def bound_dn(self, sensor: Digitiser, low: float, high: float) -> float:
        # Neither the clipped nor the spread radiance exceeds the excess.
        return sensor.gain_dn_per_radiance * max(high - self.radiance, 0.0)


@dataclass(frozen=True)
class Prnu(PixelEffect):
    """Photo-response non-uniformity: each detector multiplies the light by a factor of its own, one
    detector per column.

    `rms` is the standard deviation of these factors, as a share of their mean; 0 is none.
    """

    rms: Annotated[float, Limits(0.0, 0.2)]
    acts_on = "radiance"
    cost = "1 draw a column"

    @property
    def growth(self) -> float:
        # Each draw is clipped at PATTERN_LIMIT, so that no detector's factor is larger.
        return 1 + PATTERN_LIMIT * self.rms

    def apply(self, image: np.ndarray, sensor: Digitiser, generator: Generator) -> np.ndarray:
        return image * (1 + self.rms * _columns(image, generator()))

    def bound_dn(self, sensor: Digitiser, low: float, high: float) -> float:
        return sensor.gain_dn_per_radiance * PATTERN_LIMIT * self.rms * max(abs(low), abs(high))


@dataclass(frozen=True)
class Dsnu(PixelEffect):
    """Dark-signal non-uniformity: each detector adds an offset of its own, one detector per column.

    `rms_dn` is the standard deviation of these offsets in DN; 0 is none.
    """

    rms_dn: Annotated[float, Limits(0.0, 1e4)]
    acts_on = "DN"
    cost = "1 draw a column"

    def apply(self, image: np.ndarray, sensor: Digitiser, generator: Generator) -> np.ndarray:
        return image + self.rms_dn * _columns(image, generator())

    def bound_dn(self, sensor: Digitiser, low: float, high: float) -> float:
        return PATTERN_LIMIT * self.rms_dn


@dataclass(frozen=True)
class Striping(PixelEffect):
    """Difference in DN between even and odd columns, read out by two amplifiers; 0 is none.

    Half of it is added to even columns and taken from odd ones.
    """

    odd_even_dn: Annotated[float, Limits(0.0, 1e4)]
    acts_on = "DN"

    def apply(self, image: np.ndarray, sensor: Digitiser, generator: Generator) -> np.ndarray:
        return image + self.odd_even_dn * (
            0.5 - (np.arange(image.shape[-1]) % 2).astype(image.dtype)
        )

    def bound_dn(self, sensor: Digitiser, low: float, high: float) -> float:
        return self.odd_even_dn / 2


@dataclass(frozen=True)
class Offset(PixelEffect):
    """A constant that is added to all pixels: offset_dn is the digital number of a pixel without
    light; 0 is none.
    """

    offset_dn: Annotated[float, Limits(0.0, 65535.0, single=True)]
    acts_on = "DN"

    def apply(self, image: np.ndarray, sensor: Digitiser, generator: Generator) -> np.ndarray:
        return image + self.offset_dn

    def bound_dn(self, sensor: Digitiser, low: float, high: float) -> float:
        return self.offset_dn


@dataclass(frozen=True)
class Defects(PixelEffect):
    """Faulty pixels: dead ones (always 0) and hot ones (always full scale), each per million
    pixels; 0 is none.
    """

    dead_per_million: Annotated[float, Limits(0.0, 1e6)]
    hot_per_million: Annotated[float, Limits(0.0, 1e6)]
    acts_on = "DN"
    cost = "1 draw a pixel"

    def apply(self, image: np.ndarray, sensor: Digitiser, generator: Generator) -> np.ndarray:
        draw = generator().random(image.shape, dtype=np.float32)
        dead = self.dead_per_million / 1e6
        hot = self.hot_per_million / 1e6
        image = np.where(draw < dead, np.float32(0), image)
        # One draw decides both, so a pixel is never dead and hot.
        return np.where(draw >= 1 - hot, np.float32(sensor.max_dn), image) if hot > 0 else image

    def bound_dn(self, sensor: Digitiser, low: float, high: float) -> float:
        if self.dead_per_million + self.hot_per_million == 0:
            return 0.0
        # A pixel becomes 0 or full scale, whatever it was before: beyond the converter's range too.
        ends = [sensor.gain_dn_per_radiance * v for v in (low, high)]
        return max(max(abs(dn), abs(sensor.max_dn - dn)) for dn in ends)


TABLES: dict[str, type[Effect]] = {
    "antialias": AntiAlias,
    "veil": Haze,
    "smear": Smear,
    "full_well": FullWell,
    "prnu": Prnu,
    "dsnu": Dsnu,
    "striping": Striping,
    "offset": Offset,
    "defects": Defects,
}
"""Effects by the name of their table; those on the image are in the order in which they apply."""


def pixel_effects(effects: Mapping[str, Effect], acts_on: str) -> dict[str, PixelEffect]:
    """Return the effects that act on one unit, by name and in the order in which they apply.

    Args:
        effects: all effects of an instrument, by the names in `TABLES`.
        acts_on: "radiance" or "DN".
    """
    effects_in_order = ((name, effects.get(name)) for name in TABLES)
    return {
        name: effect
        for name, effect in effects_in_order
        if isinstance(effect, PixelEffect) and effect.acts_on == acts_on
    }


def _columns(image: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Draw one clipped standard normal number per column, (W,) float32."""
    draw = generator.standard_normal(image.shape[-1], dtype=np.float32)
    return np.asarray(np.clip(draw, -PATTERN_LIMIT, PATTERN_LIMIT))


def _spread(excess: np.ndarray, length_px: float) -> np.ndarray:
    """Convolve each column of (..., H, W) with the two-sided exponential without its centre,
    normalised.
    """
    radius = min(int(6 * length_px) + 1, excess.shape[-2] - 1)
    distance = np.abs(np.arange(-radius, radius + 1, dtype=np.float64))
    # A length near 0 reaches no neighbour.
    with np.errstate(over="ignore"):
        kernel = np.exp(-distance / length_px) * (distance > 0)
    # The image has one row, or the length is so short that not even a neighbour is reached.
    if kernel.sum() == 0:
        return np.zeros_like(excess)
    # Loading SciPy takes a sixth of a second, and few sensors need it.
    from scipy.ndimage import convolve1d

    return np.asarray(convolve1d(excess, kernel / kernel.sum(), axis=-2, mode="constant"))


def effect_tables(label: str, raw: Mapping[str, object]) -> dict[str, object]:
    """Return the tables of effects in the content of a file, by the names in `TABLES`, with their
    keys checked.

    Args:
        label: the name of the file, for error messages.
        raw: the whole content of the file, by the names of its tables.

    Raises:
        ProfileError: a table has an unknown key, or lacks one.
    """
    tables = {name: raw[name] for name in TABLES if name in raw}
    for name, table in tables.items():
        # A type can refuse an unknown key, but it cannot say which keys there are.
        if isinstance(table, Mapping):
            check_keys(f"{label} {name}", table, TABLES[name].limits())
    return tables


EffectTable = Mapping[str, Constant]
"""The parameters of an effect as a file states them, each a number or a range."""


_OPTIONAL: dict[str, Any] = {}
for _name, _effect in TABLES.items():
    # The type of an effect's table: every parameter and no other, within its limits.
    _parameters: Any = {
        key: (Annotated[Constant, limits], ...) for key, limits in _effect.limits().items()
    }
    _model = create_model(_effect.__name__, __config__=CONFIG, **_parameters)
    _OPTIONAL[_name] = (Annotated[_model, AfterValidator(dict)], None)
AnyEffects = create_model("Effects", __config__=CONFIG, **_OPTIONAL)


def _read_effects(raw: object) -> dict[str, EffectTable]:
    return {name: table for name, table in AnyEffects.model_validate(raw) if table is not None}


Effects = Annotated[Mapping[str, EffectTable], PlainValidator(_read_effects)]
"""The tables of some effects by name, in the order of `TABLES`."""


def settled(
    tables: Mapping[str, EffectTable], number: Callable[[Constant], float]
) -> dict[str, Effect]:
    """Return effects by name, made from tables whose parameters may be ranges.

    Args:
        tables: the parameters of each effect, by the names in `TABLES`.
        number: chooses one number of a range, such as its middle or a random draw.
    """
    return {
        name: TABLES[name](**{key: number(constant) for key, constant in table.items()})
        for name, table in tables.items()
    }
