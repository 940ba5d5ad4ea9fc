"""Define reported figures: a number with its unit, mode and source; rows of them; and checks
against a limit.

A figure is measured (on this machine, or by the user on a board), predicted (by a model, with an
interval) or published (in a named document). A figure that could not be determined is unavailable,
with the reason. It is never reported as zero.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from beers_deploy.profiles.errors import printable

Mode = Literal["measured", "predicted", "published", "unavailable"]


DIGITS = {"measured": 4, "predicted": 3, "published": 12, "unavailable": 4}
"""The number of significant digits shown for each mode. A prediction deserves fewer, and a
published figure stays as printed.
"""

NOT_FINITE = "the result is not a finite number"


@dataclass(frozen=True)
class Figure:
    """A reported number with its provenance, or no number and the reason why there is none.

    Attributes:
        value: the number, which is finite; None if the figure is unavailable.
        unit: the unit of the number, such as "dB" or "ms".
        mode: how the number was obtained, or "unavailable".
        source: the measurement, the model or the document behind the number.
        interval: the lower and the upper end of its uncertainty, in the same unit; None if unknown.
        reason: why there is no number; empty if there is one.
    """

    value: float | None
    unit: str
    mode: Mode
    source: str = ""
    interval: tuple[float, float] | None = None
    reason: str = ""

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.value or 0.0, *(self.interval or ())))):
            raise ValueError(f"a figure that is not finite: {self.value} {self.interval or ''}")

    def to_json(self) -> dict[str, object]:
        """Return the figure as a dictionary of plain values that matches the JSON schema of result
        files.
        """
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
    """Build a figure that was measured: by this run on this machine, or by the user on a board.

    The figure is unavailable if `value` is NaN or infinite. It has no interval if an end of
    `interval` is NaN or infinite.

    Args:
        value: the measured number.
        unit: the unit of the number.
        source: how it was measured.
        interval: the range in which a repetition is expected, if known.
    """
    if not math.isfinite(value):
        return unavailable(unit, f"{NOT_FINITE} ({float(value)}): {source}")
    if interval is not None and not all(map(math.isfinite, interval)):
        interval = None
    return Figure(float(value), unit, "measured", source, interval)


def predicted(value: float, unit: str, interval: tuple[float, float], source: str) -> Figure:
    """Build a figure that a model computed, with its uncertainty interval.

    It is unavailable if the value or an end of the interval is not finite.

    Args:
        value: the predicted number.
        unit: the unit of the number.
        interval: the range in which the true value is expected.
        source: the name of the model that computed it.
    """
    if not all(map(math.isfinite, (value, *interval))):
        return unavailable(unit, f"{NOT_FINITE} ({float(value)}): {source}")
    return Figure(float(value), unit, "predicted", source, (float(interval[0]), float(interval[1])))


def published(value: float, unit: str, source: str) -> Figure:
    """Build a figure that a document prints.

    Args:
        value: the number as printed.
        unit: the unit of the number.
        source: the document.

    Raises:
        ValueError: the number is not finite.
    """
    return Figure(float(value), unit, "published", source)


def unavailable(unit: str, reason: str) -> Figure:
    """Build a figure without a number.

    Args:
        unit: the unit that the number would have.
        reason: why there is no number.
    """
    return Figure(None, unit, "unavailable", reason=reason)


def number(value: float, digits: int) -> str:
    """Format a value with `digits` significant digits and with its thousands grouped.

    From 1000 upwards no exponent is used.
    """
    rounded = float(f"{value:.{digits}g}")
    if abs(rounded) < 1000:
        return f"{rounded:.{digits}g}"
    decimals = max(digits - 1 - int(math.log10(abs(rounded))), 0)
    text = f"{rounded:,.{decimals}f}"
    return text.rstrip("0").rstrip(".") if decimals else text


@dataclass(frozen=True)
class Row:
    """One row of a printed table.

    Attributes:
        table: the title of the table that the row belongs to.
        name: the name of the row, such as a method or a board.
        figures: the figures of the row, by the name of their column.
        text: further columns that hold text, by the name of their column.
    """

    table: str
    name: str
    figures: Mapping[str, Figure]
    text: Mapping[str, str] = field(default_factory=dict)


def by_table(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Group rows by the title of their table: a dictionary in the order in which the tables first
    appear.
    """
    tables: dict[str, list[Row]] = {}
    for row in rows:
        tables.setdefault(row.table, []).append(row)
    return tables


Bound = Literal["at most", "at least"]

IN_THE_NAME = {"ratio", "node", "layer", "ReLU", "fault", "step", "opset", "size", "network"}
"""Units that are not printed, because the name of the check already states them."""


@dataclass(frozen=True)
class Check:
    """The comparison of one value with its limit, of which a gate (a test that may fail a build)
    consists.

    NaN never passes.

    Attributes:
        name: the name of the measured quantity, for example "MAE".
        value: the measured value, in `unit`; infinite or NaN if a network returned that.
        limit: the largest value that passes, or the smallest if `bound` is "at least"; infinity for
            none.
        unit: the unit of both; a count has the name of the counted objects, for example "node".
        bound: "at most" if values up to the limit pass, "at least" if values from the limit on
            pass.
        detail: where the value was measured, or where the limit comes from; may be empty.
    """

    name: str
    value: float
    limit: float
    unit: str
    bound: Bound = "at most"
    detail: str = ""

    @property
    def passed(self) -> bool:
        """True if the value is within its limit, which itself passes."""
        return self.value >= self.limit if self.bound == "at least" else self.value <= self.limit

    @property
    def actual(self) -> str:
        """The value with its unit and detail, formatted for a person to read."""
        unit = "" if self.unit in IN_THE_NAME else f" {self.unit}"
        # A detail may hold the name of a node of another's file: it must stay on its line of a log.
        detail = f" ({printable(self.detail)})" if self.detail else ""
        return f"{self.value:.{self._digits}g}{unit}{detail}"

    @property
    def allowed(self) -> str:
        """The limit, formatted for a person to read, such as "at most 2"."""
        return f"{self.bound} {self.limit:.{self._digits}g}"

    @property
    def _digits(self) -> int:
        """The number of digits, 4 or more, by which a value beyond the limit differs from it."""
        for digits in range(4, 17):
            if self.passed or f"{self.value:.{digits}g}" != f"{self.limit:.{digits}g}":
                return digits
        return 17

    def __str__(self) -> str:
        return f"{self.name} {self.actual}, allowed {self.allowed}"

    def to_json(self) -> dict[str, object]:
        """Return the check as a dictionary of plain values that matches the JSON schema of result
        files.

        A value or limit that is not finite becomes None, because JSON has no number for it.
        """
        return {
            "name": self.name,
            "value": _finite(self.value),
            "limit": _finite(self.limit),
            "unit": self.unit,
            "bound": self.bound,
            "passed": self.passed,
            # JSON has no number for infinity and NaN: the text of the value stands here instead.
            "detail": self.detail if math.isfinite(self.value) else self.actual,
        }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
