"""What a reported figure is: a number with its unit, its mode and its source; rows of them, and
checks of a limit.

A figure is measured (here), predicted (by a model, with an interval) or published (by a named
document); what could not be had is unavailable, with the reason, and never a zero.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from beers_deploy.profiles.errors import printable

Mode = Literal["measured", "predicted", "published", "unavailable"]


DIGITS = {"measured": 4, "predicted": 3, "published": 12, "unavailable": 4}
"""Significant digits shown: a prediction deserves fewer, a published figure stays as printed."""

NOT_FINITE = "the result is not a finite number"


@dataclass(frozen=True)
class Figure:
    """A finite number with its unit, its mode and its source, or none and the reason why."""

    value: float | None
    unit: str
    mode: Mode
    source: str = ""
    interval: tuple[float, float] | None = None
    reason: str = ""

    def __post_init__(self) -> None:
        if not all(math.isfinite(number) for number in (self.value or 0.0, *(self.interval or ()))):
            raise ValueError(f"a figure that is not finite: {self.value} {self.interval or ''}")

    def to_json(self) -> dict[str, object]:
        """The figure as the schema wants it."""
        if self.mode == "unavailable":
            return {"value": None, "unit": self.unit, "mode": self.mode, "reason": self.reason}
        interval = list(self.interval) if self.interval else None
        return {
            "value": self.value,
            "unit": self.unit,
            "mode": self.mode,
            "interval": interval,
            "source": self.source,
        }

    def __str__(self) -> str:
        if self.value is None:
            return "unavailable"
        digits = DIGITS[self.mode]
        text = number(self.value, digits)
        # Plain arithmetic needs no interval.
        if self.interval is None or self.interval[0] == self.interval[1]:
            return text
        return f"{text} [{number(self.interval[0], digits)}, {number(self.interval[1], digits)}]"


def measured(
    value: float, unit: str, source: str, interval: tuple[float, float] | None = None
) -> Figure:
    """A number that this run observed on this machine, and how far a repetition might lie from it
    where known.

    Unavailable where it is NaN or infinite; without an interval where that is.
    """
    if not math.isfinite(value):
        return unavailable(unit, f"{NOT_FINITE} ({float(value)}): {source}")
    finite_interval = (
        interval if interval is not None and all(math.isfinite(end) for end in interval) else None
    )
    return Figure(float(value), unit, "measured", source, finite_interval)


def predicted(value: float, unit: str, interval: tuple[float, float], source: str) -> Figure:
    """A number that a model computed, and how far off it may be; unavailable where any of them is
    not finite.
    """
    if not all(math.isfinite(number) for number in (value, *interval)):
        return unavailable(unit, f"{NOT_FINITE} ({float(value)}): {source}")
    return Figure(float(value), unit, "predicted", source, (float(interval[0]), float(interval[1])))


def published(value: float, unit: str, source: str) -> Figure:
    """A number that a document prints."""
    return Figure(float(value), unit, "published", source)


def unavailable(unit: str, reason: str) -> Figure:
    """A number that could not be had."""
    return Figure(None, unit, "unavailable", reason=reason)


def number(value: float, digits: int) -> str:
    """So many significant digits, thousands grouped, no exponent where a person would not write
    one.
    """
    rounded = float(f"{value:.{digits}g}")
    if abs(rounded) < 1000:
        return f"{rounded:.{digits}g}"
    decimals = max(digits - 1 - int(math.log10(abs(rounded))), 0)
    text = f"{rounded:,.{decimals}f}"
    return text.rstrip("0").rstrip(".") if decimals else text


@dataclass(frozen=True)
class Row:
    """One line of a table: a name, its figures, and plain words beside them."""

    table: str
    name: str
    figures: Mapping[str, Figure]
    text: Mapping[str, str] = field(default_factory=dict)


def by_table(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """The rows of each table, in the order in which the tables first appear."""
    tables: dict[str, list[Row]] = {}
    for row in rows:
        tables.setdefault(row.table, []).append(row)
    return tables


Bound = Literal["at most", "at least"]

IN_THE_NAME = {"ratio", "node", "layer", "ReLU", "fault", "step", "opset", "size", "network"}
"""Units that a check's name tells a reader already."""


@dataclass(frozen=True)
class Check:
    """One thing that a gate looks at: a value and its limit.

    The number decides, and NaN keeps no limit.

    Attributes:
        name: what is measured, for example "MAE".
        value: what was found, in `unit`; infinite or NaN where a network gave that.
        limit: the largest value that passes, or the smallest where `bound` says "at least";
            infinity for none.
        unit: of both; a count has the name of what is counted, for example "node".
        bound: the side of the limit that passes.
        detail: where the value was found, or where the limit comes from; empty where there is
            nothing to add.
    """

    name: str
    value: float
    limit: float
    unit: str
    bound: Bound = "at most"
    detail: str = ""

    @property
    def passed(self) -> bool:
        """Whether the value keeps its limit."""
        return self.value >= self.limit if self.bound == "at least" else self.value <= self.limit

    @property
    def found(self) -> str:
        """The value with its unit and its detail, for a person."""
        unit = "" if self.unit in IN_THE_NAME else f" {self.unit}"
        # A detail may hold the name of a node of another's file: it must stay on its line of a log.
        return f"{self.value:.4g}{unit}" + (f" ({printable(self.detail)})" if self.detail else "")

    @property
    def allowed(self) -> str:
        """The limit, for a person."""
        return f"{self.bound} {self.limit:.4g}"

    def __str__(self) -> str:
        return f"{self.name} {self.found}, allowed {self.allowed}"

    def to_json(self) -> dict[str, object]:
        """The check as the results schema wants it; None for what JSON has no number for."""
        return {
            "name": self.name,
            "value": _finite(self.value),
            "limit": _finite(self.limit),
            "unit": self.unit,
            "bound": self.bound,
            "passed": self.passed,
            # JSON has no number for infinity and NaN: the text of the value stands here instead.
            "detail": self.detail if math.isfinite(self.value) else self.found,
        }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
