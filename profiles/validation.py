"""Validate the content of a file with a pydantic type, and describe an error in one sentence."""

from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from typing import Annotated, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from beers_deploy.profiles.errors import ProfileError, printable

T = TypeVar("T")

CONFIG = ConfigDict(extra="forbid")
"""The configuration of every model: an unknown key is an error and never ignored."""


Amount = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
"""A finite number of 0 or more."""
Share = Annotated[float, Field(strict=True, ge=0, le=1)]
"""A number from 0 to 1."""

TABLE_TYPES = ("dataclass_type", "dict_type", "mapping_type", "model_type")
EXPECTED = {
    **dict.fromkeys(TABLE_TYPES, ("a table", "Write it as [{key}].")),
    "string_type": ("a text", "Write it in quotes."),
    "string_pattern_mismatch": ("a name of letters, digits, '_', '.' and '-'", "Correct it."),
    "too_short": ("a list that is not empty", "Add an entry."),
    "tuple_type": ("a list", "Write it in square brackets, with commas between."),
}
"""TOML's names for pydantic's types of errors, and what to do. For other types pydantic's own
message is shown, which lists the allowed values.
"""
EXAMPLES = {
    "description": 'description = "our camera"',
    "status": 'status = "measured"',
    "source": 'source = "data sheet, page 3"',
}
"""Lines that show how to write a missing key."""


def validated(kind: type[T], raw: object, label: str, groups: Mapping[str, str] | None = None) -> T:
    """Convert plain values to a type of this project, or raise ProfileError with one sentence.

    Args:
        kind: any type that pydantic can check.
        raw: plain values, as TOML and JSON hold them.
        label: the name of the file, for messages.
        groups: from the name of a field of the type to its dotted key in the file, where they
            differ; to "" for a field that only groups tables of the file.

    Raises:
        ProfileError: a value is missing, unknown or invalid; the message has the file, the dotted
            key, the error in its value and what to do.
    """
    try:
        return TypeAdapter(kind).validate_python(raw)
    except ValidationError as error:
        raise ProfileError(_sentence(label, error, groups or {})) from None


def _sentence(label: str, error: ValidationError, groups: Mapping[str, str]) -> str:
    """Return the sentence about the likeliest of the faults."""

    def dotted(path: Sequence[str | int]) -> str:
        names = [str(name) for name in path if name != "value"]
        names[:1] = [groups.get(name, name) for name in names[:1]]
        return ".".join(filter(None, names))

    def place(path: Sequence[str | int]) -> str:
        return f"{label} {dotted(path)}".rstrip()

    faults = error.errors(include_url=False)
    missing = {fault["loc"] for fault in faults if fault["type"] == "missing"}
    for fault in faults:
        # A misspelt key also makes the right key missing. The misspelling is the likelier fault, so
        # it is reported first. Pydantic has one name of this fault for models, another for
        # dataclasses.
        if fault["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
            *path, key = fault["loc"]
            names = [str(other[-1]) for other in missing if [*other[:-1]] == path]
            return f"{place(path)} has the unknown key {_spelling(str(key), names)}"
    fault = faults[0]
    where = place(fault["loc"])
    if fault["type"] == "missing":
        return _missing(place(fault["loc"][:-1]), str(fault["loc"][-1]))
    if fault["type"] == "value_error":
        return f"{where} {fault['ctx']['error']}"
    stated = fault["msg"].removeprefix("Input should be ")
    expected, hint = EXPECTED.get(fault["type"], (stated, "Correct the value."))
    value = printable(repr(fault["input"]))
    return f"{where} must be {expected}, got {value}. {hint.format(key=dotted(fault['loc']))}"


def check_keys(
    where: str,
    raw: Mapping[str, object],
    required: Collection[str],
    optional: Collection[str] = (),
) -> None:
    """Raise ProfileError if a table has an unknown key, or lacks a required one.

    It is for tables whose keys depend on more than a type.

    Args:
        where: the names of the file and the table, for messages.
        raw: the table to check.
        required: the keys that the table must have. It may be a mapping from each key to the values
            that the key accepts, which the message then states.
        optional: further keys that the table may have.
    """
    allowed = sorted({*required, *optional})
    for key in raw:
        if key not in allowed:
            choices = f"it can have the keys {', '.join(allowed)}"
            raise ProfileError(f"{where} has the unknown key {_spelling(key, allowed, choices)}")
    for key in sorted({*required} - set(raw)):
        kind = f": {required[key]}" if isinstance(required, Mapping) else ""
        raise ProfileError(_missing(where, key, kind))


def _missing(where: str, key: str, kind: str = "") -> str:
    example = f", such as {EXAMPLES[key]}" if key in EXAMPLES else "; a shipped profile shows how"
    return f"{where} has no key {key!r}. Add it{kind or example}."


def _spelling(key: str, names: Sequence[str], choices: str = "") -> str:
    """Return the key, the keys to choose from, and the one that was meant."""
    stated = "; ".join(filter(None, (printable(repr(key)), choices)))
    # Most often the unit or the second half of a name is missing.
    for name in names:
        if name.startswith(f"{key}_"):
            return f"{stated}. Write {name!r} (the unit belongs to the name)."
    for name in get_close_matches(key, names, 1):
        return f"{stated}. Write {name!r}."
    return f"{stated}. Remove it or correct its spelling."
