"""The effects that a sensor or a scene may call for beside blur, noise and digitising: one dataclass a TOML table.

A profile calls for an effect by having its table. Every field's neutral value leaves the image as it is.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from beers_deploy.profiles.constant import Constant, check_keys, read_constant
from beers_deploy.profiles.errors import ProfileError


@dataclass(frozen=True)
class AntiAlias:
    """A Gaussian filter of standard deviation sigma_px target pixels, part of the MTF's budget; 0 is none."""

    sigma_px: float


@dataclass(frozen=True)
class Smear:
    """Motion along the track during one exposure, in target pixels; 0 is none."""

    length_px: float


@dataclass(frozen=True)
class Haze:
    """Haze, table `veil`: transmittance of the atmosphere (1 is clear), path radiance in W/m2/sr/um (0 is none)."""

    transmittance: float
    path_radiance: float


@dataclass(frozen=True)
class Prnu:
    """Relative spread of the detectors' responses, one detector a column; 0 is none."""

    rms: float


@dataclass(frozen=True)
class Dsnu:
    """Spread of the detectors' offsets in DN, one detector a column; 0 is none."""

    rms_dn: float


@dataclass(frozen=True)
class Striping:
    """Difference in DN between even and odd columns, read out by two amplifiers; 0 is none."""

    odd_even_dn: float


@dataclass(frozen=True)
class FullWell:
    """Radiance in W/m2/sr/um at which a detector is full, and the share of the excess that runs along the column."""

    radiance: float
    blooming_share: float
    blooming_px: float


@dataclass(frozen=True)
class Offset:
    """Digital number of the dark; 0 is none."""

    offset_dn: float


@dataclass(frozen=True)
class Defects:
    """Dead pixels (always 0) and hot ones (always full scale), per million; 0 is none."""

    dead_per_million: float
    hot_per_million: float


Effect = AntiAlias | Smear | Haze | Prnu | Dsnu | Striping | FullWell | Offset | Defects

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

LIMITS: dict[str, tuple[float, float]] = {
    "sigma_px": (0.0, 5.0),
    "length_px": (0.0, 20.0),
    "transmittance": (0.0, 1.0),
    "path_radiance": (0.0, 1e4),
    "rms": (0.0, 0.2),
    "rms_dn": (0.0, 1e4),
    "odd_even_dn": (0.0, 1e4),
    "radiance": (1e-6, 1e6),
    "blooming_share": (0.0, 0.5),
    "blooming_px": (0.0, 64.0),
    "offset_dn": (0.0, 65535.0),
    "dead_per_million": (0.0, 1e6),
    "hot_per_million": (0.0, 1e6),
}

Table = Mapping[str, Constant]


def read_effect(where: str, name: str, raw: object) -> Table:
    """Read one effect's table of a TOML file: every key of its dataclass and no other, each within its limits."""
    keys = [field.name for field in fields(TABLES[name])]
    if not isinstance(raw, Mapping):
        raise ProfileError(where, expected=f"a table [{name}]", got=repr(raw), remedy="write it as one")
    check_keys(where, raw, required=set(keys))
    table = {key: read_constant(f"{where} {key}", raw[key]) for key in keys}
    for key, constant in table.items():
        low, high = LIMITS[key]
        if not low <= constant.low <= constant.high <= high:
            raise ProfileError(
                f"{where} {key}", expected=f"{low:g} to {high:g}", got=str(constant), remedy="correct the value"
            )
    return table


def draw_effect(name: str, table: Table, generator: np.random.Generator) -> Effect:
    """Settle every number of an effect; nothing is drawn where no range is stated."""
    values = {key: c.low if c.low == c.high else float(generator.uniform(c.low, c.high)) for key, c in table.items()}
    return TABLES[name](**values)


def middle_effect(name: str, table: Table) -> Effect:
    """The middle of every range."""
    return TABLES[name](**{key: constant.middle for key, constant in table.items()})
