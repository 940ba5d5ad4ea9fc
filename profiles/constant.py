"""A number, or a list of names, and where it comes from: what a profile holds."""

import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

from beers_deploy.profiles.errors import ProfileError, printable

Status = Literal["published", "inferred", "measured", "assumed", "stated"]
"""published: in a document; measured: on the instrument; inferred: computed from such; assumed: our
choice; stated: the user's own.
"""

Number = float | tuple[float, float]


@dataclass(frozen=True)
class Constant:
    """A value, or a range [low, high], with its provenance."""

    value: Number
    status: Status
    source: str

    @property
    def low(self) -> float:
        """The smallest value it can take."""
        return self.value[0] if isinstance(self.value, tuple) else self.value

    @property
    def high(self) -> float:
        """The largest value it can take."""
        return self.value[1] if isinstance(self.value, tuple) else self.value

    @property
    def middle(self) -> float:
        """The middle of what it can be."""
        return (self.low + self.high) / 2

    def __str__(self) -> str:
        return f"{self.low:g}" if self.low == self.high else f"{self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class Words:
    """A list of names, which may be empty, with its provenance: what an operation can be fused
    with.
    """

    value: tuple[str, ...]
    status: Status
    source: str

    def __str__(self) -> str:
        return ", ".join(self.value) or "none"


def read_words(where: str, raw: object, known: Collection[str] = ()) -> Words:
    """Read `["ReLU"]` or `{ value = ["ReLU"], status = ..., source = ... }`; of any names where
    none are known.
    """
    value, status, source = read_stated(where, raw)
    if not isinstance(value, list) or not all(
        isinstance(name, str) and name in (known or value) for name in value
    ):
        choices = f" out of {', '.join(known)}" if known else ""
        raise ProfileError(
            f"{where} must be a list of names{choices}, got {printable(repr(value))}. Correct the "
            "names; an empty list stands for none."
        )
    return Words(tuple(value), status, source)


def read_constant(where: str, raw: object) -> Constant:
    """Read `0.07`, `[0.03, 0.07]` or `{ value = ..., status = ..., source = ... }`.

    A bare number is the user's own statement: status "stated".
    """
    value, status, source = read_stated(where, raw)
    return Constant(_number(where, value), status, source)


def read_stated(where: str, raw: object) -> tuple[object, Status, str]:
    """Value, status and source of what a profile states in either way; the value, of any kind, is
    not checked.
    """
    if not isinstance(raw, Mapping):
        return raw, "stated", "stated by the profile without a source"
    check_keys(where, raw, required={"value", "status", "source"})
    status = raw["status"]
    source = raw["source"]
    if status not in get_args(Status):
        raise ProfileError(
            f"{where}.status must be one of {', '.join(get_args(Status))}, got "
            f"{printable(repr(status))}. State where the number comes from."
        )
    if not isinstance(source, str) or not source.strip():
        raise ProfileError(
            f"{where}.source must be a text that names a document, got {printable(repr(source))}. "
            "State where the number comes from."
        )
    return raw["value"], status, source


def check_keys(
    where: str,
    raw: Mapping[str, object],
    required: set[str],
    optional: set[str] = frozenset(),  # type: ignore[assignment]
) -> None:
    """Refuse unknown keys first (a typo is the likelier fault), then missing ones."""
    allowed = required | optional
    # A misspelt key is unknown, and leaves its right name missing: the first is the likelier fault.
    for key in raw:
        if key not in allowed:
            raise ProfileError(
                f"{where} has the unknown key {printable(repr(key))}; it can have the keys "
                f"{', '.join(sorted(allowed))}. {_rename(key, allowed)}."
            )
    for key in sorted(required - set(raw)):
        raise ProfileError(f"{where} has no key {key!r}. Add it; a shipped profile shows how.")


def _rename(key: str, allowed: set[str]) -> str:
    """Point at the key that was meant: most often the same one with its unit."""
    similar = sorted(name for name in allowed if name.startswith(key) or key.startswith(name))
    return (
        f"Write {similar[0]!r} (the unit belongs to the name)"
        if similar
        else "Remove it or correct its spelling"
    )


def _number(where: str, raw: object) -> Number:
    if is_number(raw):
        return float(raw)  # type: ignore[arg-type]
    if isinstance(raw, list) and len(raw) == 2 and all(map(is_number, raw)) and raw[0] <= raw[1]:
        return (float(raw[0]), float(raw[1]))
    raise ProfileError(
        f"{where} must be a finite number or a range [low, high], got {printable(repr(raw))}."
    )


def is_number(raw: object) -> bool:
    """Whether a value of a file is a finite number that float64 holds."""
    return (
        # Python counts True as an int. TOML allows integers of any size, which float64 cannot hold.
        isinstance(raw, int | float)
        and not isinstance(raw, bool)
        and abs(raw) <= sys.float_info.max
    )
