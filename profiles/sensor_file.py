"""Sensor profiles as TOML files: found by name, read, and refused where no instrument can be so."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from profiles.constant import Constant, check_keys, read_constant
from profiles.effects import TABLES as EFFECT_TABLES
from profiles.effects import read_effect
from profiles.errors import ProfileError
from profiles.sensor import (
    MTF_NYQUIST_MAX,
    OFFSET,
    OPTIONAL,
    TABLES,
    SensorProfile,
    describe_units,
    mtf_limit,
    snr_0_bounds,
)
from profiles.toml import read_toml, shipped_names

REFERENCE = "pleiades-reference"
"""The shipped profile of the image that restoration aims at, unless another is named."""


def reference_for(degraded: SensorProfile, name: str = REFERENCE) -> SensorProfile:
    """The profile called `name` in the digital numbers of `degraded`: what a restoration of its images is held to.

    Raises:
        ProfileError: no such profile, or a faulty one.
    """
    return load_sensor(name).in_units_of(degraded)


def sensor_names() -> list[str]:
    """The names of the shipped sensor profiles."""
    return shipped_names("sensors")


def load_sensor(name: str) -> SensorProfile:
    """Read a shipped sensor profile by name, or the user's own by the path of its .toml file.

    Raises:
        ProfileError: unknown name, wrong or missing key, or numbers that no instrument can have.
    """
    return read_sensor(*read_toml("sensors", name))


def sensor_from_json(label: str, raw: Mapping[str, Any]) -> SensorProfile:
    """A profile from the plain values of its fields, as `dataclasses.asdict` and JSON leave them.

    Raises:
        ProfileError: keys or numbers that no profile has.
    """
    known = {key for table, keys in TABLES.items() for key in (*keys, *OPTIONAL.get(table, ()))}
    check_keys(label, raw, required={"name", "description"}, optional={*known, "effects"})
    tables: dict[str, Any] = {
        table: {key: raw[key] for key in (*keys, *OPTIONAL.get(table, ())) if raw.get(key) is not None}
        for table, keys in TABLES.items()
    }
    effects = raw.get("effects", {})
    if not isinstance(effects, Mapping):
        raise ProfileError(label, expected="a table of effects", got=repr(effects), remedy="make it anew")
    return replace(
        read_sensor(label, {"description": raw["description"], **tables, **effects}), name=str(raw["name"])
    )


def read_sensor(label: str, raw: Mapping[str, Any]) -> SensorProfile:
    """A profile from the tables of its file; `label` names the file in errors.

    Raises:
        ProfileError: wrong or missing key, or numbers that no instrument can have.
    """
    check_keys(label, raw, required={"description", *TABLES}, optional=set(EFFECT_TABLES))
    constants: dict[str, Constant] = {}
    for table, keys in TABLES.items():
        content = raw[table]
        if not isinstance(content, Mapping):
            raise ProfileError(label, expected=f"a table [{table}]", got=repr(content), remedy="write it as one")
        optional = OPTIONAL.get(table, ())
        check_keys(f"{label} [{table}]", content, required=set(keys), optional=set(optional))
        given = [*keys, *(key for key in optional if key in content)]
        constants |= {key: read_constant(f"{label} [{table}] {key}", content[key]) for key in given}
    effects = {name: read_effect(f"{label} [{name}]", name, raw[name]) for name in EFFECT_TABLES if name in raw}
    profile = SensorProfile(
        name=label.removesuffix(".toml"), description=str(raw["description"]), effects=effects, **constants
    )
    _check_physics(label, profile)
    return profile


SINGLE = ("radiance_0", "radiance_1", "bits", "gain_dn_per_radiance")
"""Constants that define what the others mean: no range to draw from."""


def _check_single(label: str, profile: SensorProfile) -> None:
    single: dict[str, Constant] = {key: getattr(profile, key) for key in SINGLE}
    single |= {f"[{OFFSET}] {key}": constant for key, constant in profile.effects.get(OFFSET, {}).items()}
    for key, constant in single.items():
        if constant.low != constant.high:
            remedy = "write a profile for each"
            raise ProfileError(f"{label} {key}", expected="one number", got=f"a range, {constant}", remedy=remedy)


def _check_physics(label: str, profile: SensorProfile) -> None:
    _check_single(label, profile)
    mtf_max = MTF_NYQUIST_MAX
    contrast: tuple[Callable[[float], bool], str, str] = (
        lambda v: 0 < v <= mtf_max,
        f"a contrast above 0 and up to {mtf_max:.4f} (2/pi, the square detector alone)",
        "give a ratio, 0.07 for 7 %",
    )
    checks: list[tuple[str, Constant, Callable[[float], bool], str, str]] = [
        (
            "[grid] gsd_m",
            profile.gsd_m,
            lambda v: v > 0,
            "metres above 0",
            "give the ground sampling distance",
        ),
        (
            "[grid] oversampling",
            profile.oversampling,
            lambda v: v >= 1 and v == int(v),
            "whole numbers from 1 on",
            "give the number of scene pixels per sensor pixel",
        ),
        ("[mtf] mtf_nyquist", profile.mtf_nyquist, *contrast),
        ("[noise] snr_0", profile.snr_0, lambda v: v > 0, "linear ratios above 0", "convert dB first"),
        ("[noise] snr_1", profile.snr_1, lambda v: v > 0, "linear ratios above 0", "convert dB first"),
        (
            "[noise] radiance_0",
            profile.radiance_0,
            lambda v: 0 < v < profile.radiance_1.low,
            "W/m2/sr/um above 0 and below radiance_1",
            "name the darker of the two points radiance_0",
        ),
        (
            "[digitiser] bits",
            profile.bits,
            lambda v: v in range(1, 17),
            "a whole number from 1 to 16",
            "give the bits per pixel",
        ),
        (
            "[digitiser] gain_dn_per_radiance",
            profile.gain_dn_per_radiance,
            lambda v: v > 0,
            "DN per W/m2/sr/um above 0",
            "give full-scale DN divided by full-scale radiance",
        ),
    ]
    if profile.mtf_nyquist_along is not None:
        checks.append(("[mtf] mtf_nyquist_along", profile.mtf_nyquist_along, *contrast))
    for key, constant, valid, expected, remedy in checks:
        if not (valid(constant.low) and valid(constant.high)):
            raise ProfileError(f"{label} {key}", expected=expected, got=str(constant), remedy=remedy)
    _check_budget(label, profile)
    _check_snr(profile)


def _check_budget(label: str, profile: SensorProfile) -> None:
    """The anti-alias filter alone must leave the MTF that the profile states."""
    if "antialias" not in profile.effects:
        return
    sigma = profile.effects["antialias"]["sigma_px"]
    limit = mtf_limit(sigma.high)
    for key in ("mtf_nyquist", "mtf_nyquist_along"):
        mtf: Constant | None = getattr(profile, key)
        if mtf is not None and mtf.high > limit:
            raise ProfileError(
                f"{label} [mtf] {key}",
                expected=f"at most {limit:.4f}, what an anti-alias filter of {sigma.high:g} px leaves",
                got=str(mtf),
                remedy="lower one of the two",
            )


def _check_snr(profile: SensorProfile) -> None:
    """Some pair in the ranges must be physical: the bounds grow with snr_1, so its two ends decide."""
    ends = [
        snr_0_bounds(profile.radiance_0.low, profile.radiance_1.low, s)
        for s in (profile.snr_1.low, profile.snr_1.high)
    ]
    if profile.snr_0.high < ends[0][0] or profile.snr_0.low > ends[1][1]:
        raise profile.impossible_snr()


def reference_beside(degraded: SensorProfile, name: str | None, say: Callable[[str], None]) -> SensorProfile:
    """The reference profile that a user named, or the default one, in the digital numbers of `degraded`.

    One that was named, and states other ones, is converted in sight: `say` is told.

    Raises:
        ProfileError: no such profile, or a faulty one.
    """
    stated = load_sensor(name or REFERENCE)
    reference = stated.in_units_of(degraded)
    if name is not None and reference is not stated:
        units = f"{describe_units(degraded)}, as {degraded.name} has them"
        say(f"note: the reference {stated.name} ({describe_units(stated)}) is taken at {units}")
    return reference
