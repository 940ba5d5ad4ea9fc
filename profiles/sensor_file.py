"""Sensor profiles as TOML files: found by name, read, and refused where no instrument can be so."""

import json
import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from beers_deploy.profiles.constant import Constant, Number, check_keys, read_constant
from beers_deploy.profiles.effects import TABLES as EFFECT_TABLES
from beers_deploy.profiles.effects import Table, read_effect
from beers_deploy.profiles.errors import ProfileError, printable
from beers_deploy.profiles.response import (
    MtfTable,
    axes_of,
    read_response,
    response_from_json,
    unpacked,
)
from beers_deploy.profiles.sensor import (
    MTF_NYQUIST_MAX,
    OFFSET,
    RESPONSE,
    TABLE_OF,
    TABLES,
    Sensor,
    constant_keys,
    describe_units,
    mtf_limit,
    snr_0_bounds,
    table_keys,
)
from beers_deploy.profiles.toml import profile_path, read_toml, shipped_names

logger = logging.getLogger(__name__)

REFERENCE = "pleiades-reference"
"""The shipped profile of the image that restoration aims at, unless another is named."""


def reference_for(degraded: Sensor) -> Sensor:
    """The default reference in the digital numbers of `degraded`: what a restoration of its images
    is held to.
    """
    return load_sensor(REFERENCE).in_units_of(degraded)


def sensor_names() -> list[str]:
    """The names of the shipped sensor profiles."""
    return shipped_names("sensors")


BLIND = "blind"
BLIND_PROFILE = "pleiades-variable"
"""The name of a sensor that is not known, and the profile in whose ranges it then counts to be."""


def load_sensor(name: str) -> Sensor:
    """Read a shipped sensor profile by name, or the user's own by the path of its .toml file;
    `blind` is one too.
    """
    shipped = BLIND_PROFILE if name == BLIND else name
    sensor = read_sensor(*read_toml("sensors", shipped), profile_path("sensors", shipped).parent)
    return replace(sensor, name=BLIND) if name == BLIND else sensor


def with_numbers(sensor: Sensor, numbers: Mapping[str, Number]) -> Sensor:
    """A sensor with other numbers; see `Sensor.replace`."""
    where = f"sensor {sensor.name}"
    tables = tables_of(sensor)
    for key, value in numbers.items():
        if key not in TABLE_OF:
            raise ProfileError(
                f"A sensor has no number {key!r}. Correct the name, which must be one of "
                f"{', '.join(TABLE_OF)}."
            )
        tables[TABLE_OF[key]][key] = list(value) if isinstance(value, tuple) else value
    # Noise is stated in one of two ways: numbers of the one replace those of the other.
    for stated, superseded in (
        ({"alpha", "beta"}, {"snr_0", "snr_1"}),
        ({"snr_0", "snr_1"}, {"alpha", "beta"}),
    ):
        if stated & set(numbers):
            tables["noise"] = {
                key: value for key, value in tables["noise"].items() if key not in superseded
            }
    changed = replace(
        read_sensor(where, {"description": sensor.description, **tables}), name=sensor.name
    )
    # A response settles the contrasts at Nyquist, so that it goes if they are replaced.
    keeps_blur = sensor.response is not None and not {"mtf_nyquist", "mtf_nyquist_along"} & set(
        numbers
    )
    return replace(changed, response=sensor.response) if keeps_blur else changed


def tables_of(sensor: Sensor) -> dict[str, dict[str, object]]:
    """The tables of a sensor's file as plain values; of a response its
    contrasts at Nyquist alone.
    """
    tables: dict[str, dict[str, object]] = {}
    for key, table in TABLE_OF.items():
        constant: Constant | None = getattr(sensor, key)
        tables.setdefault(table, {})
        if constant is not None:
            tables[table][key] = _plain(constant)
    for name, effect in sensor.effects.items():
        tables[name] = {key: _plain(constant) for key, constant in effect.items()}
    return tables


def _plain(constant: Constant) -> dict[str, object]:
    value = list(constant.value) if isinstance(constant.value, tuple) else constant.value
    return {"value": value, "status": constant.status, "source": constant.source}


def save_sensor(sensor: Sensor, path: Path) -> Path:
    """Write a sensor as the TOML file that `load_sensor` reads, and a point-spread function beside
    it as .npy.
    """
    tables = tables_of(sensor)
    response = sensor.response
    about = {"status": sensor.mtf_nyquist.status, "source": sensor.mtf_nyquist.source}
    if isinstance(response, MtfTable):
        axes = {
            axis: {"value": list(getattr(response, axis)), **about} for axis in ("across", "along")
        }
        tables["mtf"] = {"frequency": list(response.frequency), **axes}
    elif response is not None:
        samples = path.with_name(f"{path.stem}-psf.npy")
        np.save(samples, unpacked(response).astype(np.float32))
        psf = {"value": samples.name, **about}
        tables["mtf"] = {"psf": psf, "psf_samples_per_px": response.samples_per_px}
    path.write_text(sensor_toml(sensor.description, tables), encoding="utf-8")
    return path


def sensor_toml(description: str, tables: Mapping[str, Mapping[str, object]]) -> str:
    """The text of a sensor's file, of its tables as plain values."""
    lines = [f"description = {_toml(description)}"]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    """A value in TOML's notation: of JSON's it differs in tables alone."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(entry)}" for key, entry in value.items()) + " }"
    return json.dumps(value, ensure_ascii=False)


def sensor_from_json(label: str, raw: Mapping[str, Any]) -> Sensor:
    """A profile from the plain values of its fields, as `dataclasses.asdict`
    and JSON leave them.
    """
    check_keys(
        label, raw, required={"name", "description"}, optional={*TABLE_OF, "effects", "response"}
    )
    tables = {
        table: {key: raw[key] for key in constant_keys(table) if raw.get(key) is not None}
        for table in TABLES
    }
    effects = raw.get("effects", {})
    if not isinstance(effects, Mapping):
        raise ProfileError(
            f"{label} effects must be a table, got {printable(repr(effects))}. Generate the file "
            "again."
        )
    sensor = read_sensor(label, {"description": raw["description"], **tables, **effects})
    if raw.get("response") is not None:
        response = response_from_json(f"{label} response", raw["response"])
        mtf = sensor.mtf_nyquist
        sensor = replace(sensor, response=response, **axes_of(response, mtf.status, mtf.source))
        _check_budget(label, sensor)
    return replace(sensor, name=str(raw["name"]))


def read_sensor(label: str, raw: Mapping[str, Any], folder: Path = Path()) -> Sensor:
    """A profile from the tables of its file.

    Args:
        label: names the file in errors.
        raw: its tables.
        folder: where it lies, from which the path of a point-spread function counts.
    """
    check_keys(label, raw, required={"description", *TABLES}, optional=set(EFFECT_TABLES))
    contents = {table: _read_table(label, table, raw[table]) for table in TABLES}
    constants: dict[str, Constant] = {}
    for table, content in contents.items():
        for key, value in content.items():
            if key not in RESPONSE:
                constants[key] = read_constant(f"{label} [{table}] {key}", value)
    effects = {
        name: read_effect(f"{label} [{name}]", name, raw[name])
        for name in EFFECT_TABLES
        if name in raw
    }
    _check_single(label, constants, effects)
    _check_each(label, constants)
    # Two radiances that only name where noise is spoken of, unless SNRs are stated there.
    constants = {**_default_radiances(constants), **constants}
    _check_noise(label, constants)
    blur: dict[str, Any] = {}
    if "mtf_nyquist" not in constants:
        response, status, source = read_response(f"{label} [mtf]", contents["mtf"], folder)
        blur = {"response": response, **axes_of(response, status, source)}
    name = label.removesuffix(".toml")
    description = str(raw["description"])
    profile = Sensor(name=name, description=description, effects=effects, **{**constants, **blur})
    _check_budget(label, profile)
    _check_snr(profile)
    return profile


def _read_table(label: str, table: str, content: object) -> Mapping[str, object]:
    """The content of a table that is filled in one of its ways, and in no other."""
    if not isinstance(content, Mapping):
        raise ProfileError(
            f"{label} {table} must be a table, got {printable(repr(content))}. Write it as "
            f"[{table}]."
        )
    where = f"{label} [{table}]"
    ways = TABLES[table]
    check_keys(where, content, required=set(), optional=set(table_keys(table)))
    # The two radiances belong to both ways of stating noise, and say of neither that it is meant.
    telling = set(content) - {"radiance_0", "radiance_1"}
    begun = [way for way in ways if telling & {*way[0], *way[1]}]
    if len(begun) > 1:
        choices = ", or ".join(" and ".join(required) for required, _ in ways)
        raise ProfileError(
            f"{where} must have one of {choices}, but it has keys of several: "
            f"{', '.join(content)}. Keep one of them."
        )
    required, optional = begun[0] if begun else ways[0]
    check_keys(where, content, required=set(required), optional=set(optional))
    return content


SINGLE = ("radiance_0", "radiance_1", "bits", "gain_dn_per_radiance")
"""Constants that define what the others mean: no range to draw from."""


def _check_single(
    label: str, constants: Mapping[str, Constant], effects: Mapping[str, Table]
) -> None:
    single = {key: constants[key] for key in SINGLE if key in constants}
    single |= {f"[{OFFSET}] {key}": constant for key, constant in effects.get(OFFSET, {}).items()}
    for key, constant in single.items():
        if constant.low != constant.high:
            raise ProfileError(
                f"{label} {key} must be one number, but it is the range {constant}. Write a "
                "profile for each number."
            )


Check = tuple[Callable[[float], bool], str, str]
CONTRAST: Check = (
    lambda v: 0 < v <= MTF_NYQUIST_MAX,
    f"a contrast above 0 and at most {MTF_NYQUIST_MAX:.4f} (2/pi, the square detector alone)",
    "Give a ratio, 0.07 for 7 %.",
)
SNR: Check = (lambda v: v > 0, "a linear ratio above 0", "Convert dB first.")
CHECKS: dict[str, Check] = {
    "gsd_m": (lambda v: v > 0, "above 0 m", "Give the ground sampling distance."),
    "oversampling": (
        lambda v: v >= 1 and v == int(v),
        "an integer of at least 1",
        "Give the number of scene pixels per sensor pixel.",
    ),
    "mtf_nyquist": CONTRAST,
    "mtf_nyquist_along": CONTRAST,
    "snr_0": SNR,
    "snr_1": SNR,
    "radiance_0": (lambda v: v > 0, "above 0 W/m2/sr/um", "Give the darker of two radiances."),
    "radiance_1": (lambda v: v > 0, "above 0 W/m2/sr/um", "Give the brighter of two radiances."),
    "alpha": (
        lambda v: v >= 0,
        "0 or more, in W/m2/sr/um",
        "The variance of the noise is alpha L + beta.",
    ),
    "beta": (
        lambda v: v >= 0,
        "0 or more, in (W/m2/sr/um)^2",
        "The variance of the noise is alpha L + beta.",
    ),
    "bits": (lambda v: v in range(1, 17), "an integer from 1 to 16", "Give the bits per pixel."),
    "gain_dn_per_radiance": (
        lambda v: v > 0,
        "above 0 DN per W/m2/sr/um",
        "Give full-scale DN divided by full-scale radiance.",
    ),
}
"""The test that both ends of each constant must pass, the same in words that follow "must be", and
a sentence of advice.
"""
LEAST = 1e-12
MOST = 1e12
"""Of any constant that is not 0: beyond lies no instrument, and powers of it no float."""


def _check_each(label: str, constants: Mapping[str, Constant]) -> None:
    for key, constant in constants.items():
        valid, allowed, advice = CHECKS[key]
        where = f"{label} [{TABLE_OF[key]}] {key}"
        if any(
            value and not LEAST <= abs(value) <= MOST for value in (constant.low, constant.high)
        ):
            raise ProfileError(
                f"{where} must have an absolute value of {LEAST:g} to {MOST:g}, but it is "
                f"{constant}. {advice}"
            )
        if not (valid(constant.low) and valid(constant.high)):
            raise ProfileError(f"{where} must be {allowed}, but it is {constant}. {advice}")


def _check_noise(label: str, constants: Mapping[str, Constant]) -> None:
    """Two radiances in order, and noise that alpha and beta, not both 0, can have."""
    dark, bright = (constants[key].low for key in ("radiance_0", "radiance_1"))
    if not dark < bright:
        raise ProfileError(
            f"{label} [noise] radiance_0 must be below radiance_1, {bright:g} W/m2/sr/um, but it "
            f"is {dark:g}. Name the darker of the two points radiance_0."
        )
    if "alpha" in constants and constants["alpha"].high == constants["beta"].high == 0:
        raise ProfileError(
            f"{label} [noise] alpha and beta must not both be 0. Give the variance in the dark as "
            "beta."
        )


def _default_radiances(constants: Mapping[str, Constant]) -> dict[str, Constant]:
    """A quarter of full scale, and a quarter of the brighter radiance."""
    full_scale = (2 ** constants["bits"].low - 1) / constants["gain_dn_per_radiance"].low
    bright = constants.get(
        "radiance_1", Constant(full_scale / 4, "inferred", "a quarter of full scale")
    )
    return {
        "radiance_0": Constant(bright.low / 4, "inferred", "a quarter of radiance_1"),
        "radiance_1": bright,
    }


def _check_budget(label: str, profile: Sensor) -> None:
    """The anti-alias filter alone must leave the MTF that the profile states."""
    if "antialias" not in profile.effects:
        return
    if profile.response is not None:
        raise ProfileError(
            f"{label} must have no table [antialias], because the {profile.response} already "
            "includes the filter. Remove the table."
        )
    sigma = profile.effects["antialias"]["sigma_px"]
    limit = mtf_limit(sigma.high)
    for key in ("mtf_nyquist", "mtf_nyquist_along"):
        mtf: Constant | None = getattr(profile, key)
        if mtf is not None and mtf.high > limit:
            raise ProfileError(
                f"{label} [mtf] {key} must be at most {limit:.4f}, which an anti-alias filter of "
                f"{sigma.high:g} px leaves, but it is {mtf}. Lower one of the two."
            )


def _check_snr(profile: Sensor) -> None:
    """Raise ProfileError unless some pair in the ranges is physical."""
    if profile.snr_0 is None or profile.snr_1 is None:
        return
    radiances = profile.radiance_0.low, profile.radiance_1.low
    # Both bounds grow with snr_1, so that its two ends decide.
    lowest = snr_0_bounds(*radiances, profile.snr_1.low)[0]
    highest = snr_0_bounds(*radiances, profile.snr_1.high)[1]
    if profile.snr_0.high < lowest or profile.snr_0.low > highest:
        raise profile.impossible_snr()


def reference_beside(degraded: Sensor, named: "Sensor | str | os.PathLike[str] | None") -> Sensor:
    """Return the reference profile that a user names, or the default one, in the digital numbers of
    `degraded`; log if one that is named states other numbers.
    """
    profile = Sensor.load(named or REFERENCE)
    reference = profile.in_units_of(degraded)
    if named is not None and reference is not profile:
        units = f"{describe_units(degraded)}, as {degraded.name} has them"
        own = describe_units(profile)
        logger.info("the reference %s (%s) is converted to %s", profile.name, own, units)
    return reference
