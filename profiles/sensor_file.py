"""Define a sensor's TOML file: the keys of its tables, the `Sensor` fields that they state, and its
text.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from beers_deploy.profiles.constant import Constant, Limits, Stated
from beers_deploy.profiles.effects import TABLES as EFFECT_TABLES
from beers_deploy.profiles.effects import effect_tables
from beers_deploy.profiles.errors import ProfileError, printable
from beers_deploy.profiles.instrument import MTF_NYQUIST_MAX
from beers_deploy.profiles.point_spread_file import PointSpreadFile
from beers_deploy.profiles.response import MtfTable, Response
from beers_deploy.profiles.validation import check_keys, validated

LEAST = 1e-12
MOST = 1e12
"""The largest absolute value of a constant: no instrument exceeds it, and powers of larger ones
overflow.
"""

Contrast = Annotated[
    Constant,
    Limits(
        LEAST,
        MTF_NYQUIST_MAX,
        hint="2/pi is the square detector alone; give a ratio, 0.07 for 7 %.",
    ),
]
Ratio = Annotated[Constant, Limits(LEAST, MOST, hint="Give a linear ratio; convert dB first.")]
Radiance = Annotated[Constant, Limits(LEAST, MOST, single=True, hint="Give it in W/m2/sr/um.")]
Variance = Annotated[Constant, Limits(0, MOST, hint="The variance of the noise is alpha L + beta.")]

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
"""Every table of a profile and the alternative ways to fill it: the required keys and the optional
keys of each.
"""

RESPONSE = ("frequency", "across", "along", "psf", "psf_samples_per_px")
"""Keys that make up the response; each other key of `TABLES` is a constant, and a field of
`Sensor`.
"""


def table_keys(table: str) -> tuple[str, ...]:
    """Return every key that a table of a sensor's file may have, each once: of all the alternative
    ways to fill it.
    """
    keys: dict[str, None] = {}
    for required, optional in TABLES[table]:
        keys |= dict.fromkeys(required + optional)
    return tuple(keys)


def constant_keys(table: str) -> tuple[str, ...]:
    """Return the keys of a table of a sensor's file that state numbers, each of which is a field of
    `Sensor`.
    """
    return tuple(key for key in table_keys(table) if key not in RESPONSE)


TABLE_OF: dict[str, str] = {}
for _table in TABLES:
    TABLE_OF |= dict.fromkeys(constant_keys(_table), _table)
"""The table of each constant."""

GROUPS = {key: f"{table}.{key}" for key, table in TABLE_OF.items()} | {"effects": ""}
"""The dotted key of each field of `Sensor` in its file."""


def sensor_fields(label: str, raw: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the fields of a `Sensor`, by name, that the tables of its file state. They are not
    validated yet.

    Args:
        label: the name of the file, for error messages.
        raw: the parsed content of the file, by the names of its tables.
        folder: the folder of the file, to which the path of a point-spread function is relative.

    Raises:
        ProfileError: a table or key is unknown, missing or contradicts another, or the blur is
            invalid.
    """
    check_keys(label, raw, {"description", *TABLES}, EFFECT_TABLES)
    fields: dict[str, Any] = {
        "name": label.removesuffix(".toml"),
        "description": raw["description"],
        "effects": effect_tables(label, raw),
    }
    for table in TABLES:
        fields |= _content(f"{label} {table}", table, raw[table])
    if "mtf_nyquist" in fields:
        return fields
    # [mtf] states a response, from which the contrasts at Nyquist follow.
    blur = {key: fields.pop(key) for key in RESPONSE if key in fields}
    groups = {key: f"mtf.{key}" for key in RESPONSE}
    parts = validated(dict[str, Stated], blur, label, groups)
    values = {key: part.value for key, part in parts.items()}
    if "psf" in parts:
        across = along = parts["psf"]
        response: Response = validated(PointSpreadFile, values, label, groups).read(label, folder)
    else:
        across = parts["across"]
        along = parts.get("along", across)
        response = validated(MtfTable, {"along": values["across"], **values}, label, groups)
    return {**fields, "response": response, **axes_of(response, across, along)}


def _content(where: str, table: str, raw: object) -> Mapping[str, Any]:
    """Return the content of a table that is filled in one of its ways, and in no other."""
    if not isinstance(raw, Mapping):
        raise ProfileError(
            f"{where} must be a table, got {printable(repr(raw))}. Write it as [{table}]."
        )
    ways = TABLES[table]
    check_keys(where, raw, (), table_keys(table))
    # The two radiances belong to both ways of stating noise, so they do not show which is meant.
    telling = set(raw) - {"radiance_0", "radiance_1"}
    begun = [way for way in ways if telling & {*way[0], *way[1]}]
    if len(begun) > 1:
        choices = ", or ".join(" and ".join(required) for required, _ in ways)
        raise ProfileError(
            f"{where} must have one of {choices}, but it has keys of several: {', '.join(raw)}. "
            "Keep one of them."
        )
    check_keys(where, raw, *(begun or ways)[0])
    return raw


def axes_of(response: Response, *parts: Stated) -> dict[str, Constant | None]:
    """Return the two fields of a `Sensor` that state the contrast at Nyquist, computed from a
    complete blur.

    The contrast along the track is None if it equals that across it, and has the same source.

    Args:
        response: the table or the point-spread function.
        parts: the parts across and along the track, for their status and source.
    """
    across, along = (
        Constant(value, part.status, part.source)
        for value, part in zip(response.at_nyquist, parts, strict=True)
    )
    return {"mtf_nyquist": across, "mtf_nyquist_along": along if along != across else None}


def sensor_toml(description: str, tables: Mapping[str, Mapping[str, object]]) -> str:
    """Return the text of a sensor's TOML file.

    Args:
        description: one sentence for the user.
        tables: the content of the file: by the name of a table and by key, values that are plain or
            `Stated`.
    """
    lines = [f"description = {_toml(description)}"]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    """Return a value in TOML's notation, which differs from JSON's in tables only."""
    entries = vars(value) if isinstance(value, Stated) else value
    if isinstance(entries, dict):
        return "{ " + ", ".join(f"{key} = {_toml(entry)}" for key, entry in entries.items()) + " }"
    # JSON escapes all control characters that TOML forbids, but for DEL.
    return json.dumps(entries, ensure_ascii=False).replace("\x7f", "\\u007f")
