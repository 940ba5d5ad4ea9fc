"""What changed between two runs: figures of two results documents, matched by
table, row and name.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jsonschema import Draft202012Validator

from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Figure, Row
from beers_deploy.profiles.toml import read_json
from beers_deploy.results import SCHEMA_PATH

Place = tuple[str, str, str]
"""Table, row and name of a figure."""

LIMIT = re.compile(r"(?P<name>.+?)\s*(?P<side>[<>])\s*(?P<change>[+-]?\d+(\.\d+)?)(?P<percent>%?)")


@dataclass(frozen=True)
class Change:
    """One figure in both documents."""

    place: Place
    before: Figure
    after: Figure

    @property
    def difference(self) -> float:
        """After less before, in the figure's unit."""
        return (self.after.value or 0.0) - (self.before.value or 0.0)

    @property
    def percent(self) -> float | None:
        """The difference in per cent of what it was; None of nothing."""
        return 100 * self.difference / abs(self.before.value) if self.before.value else None


@dataclass(frozen=True)
class Limit:
    """A change that fails a job: `MAE>2%` (rises by more), `PSNR<-0.05` (falls by more, in its
    unit).
    """

    name: str
    above: bool
    change: float
    in_percent: bool

    def broken_by(self, change: Change) -> bool:
        """Whether a figure of that name changed so much, or is no longer to be had.

        From zero, any rise is endless in per cent.
        """
        if change.place[2] != self.name or change.before.value is None:
            return False
        if change.after.value is None:
            return True
        amount = change.difference if not self.in_percent else change.percent
        if amount is None:
            # From zero any change is endless in per cent; its sign decides which limit it breaks.
            amount = float("inf") * change.difference if change.difference else 0.0
        return amount > self.change if self.above else amount < self.change


@dataclass(frozen=True)
class Changes:
    """Figures in both documents, and the places of those in one of them only."""

    both: tuple[Change, ...]
    gone: tuple[Place, ...]
    new: tuple[Place, ...]

    @property
    def changed(self) -> list[Change]:
        """Figures of another value."""
        return [change for change in self.both if change.before.value != change.after.value]


def broken(found: Changes, limits: Sequence[Limit]) -> list[str]:
    """What fails a job, a line each: changes beyond a limit, and figures with a limit that are
    gone.
    """
    shared = {place[2] for place in (*(change.place for change in found.both), *found.gone)}
    for limit in limits:
        if limit.name not in shared:
            expected = (
                f"a figure of the first document: {', '.join(sorted(shared)) or 'it shares none'}"
            )
            raise OptionError(
                "fail_on", expected=expected, got=repr(limit.name), remedy="correct the name"
            )
    changed = [change for change in found.both if any(limit.broken_by(change) for limit in limits)]
    names = {limit.name for limit in limits}
    lines = [f"{' / '.join(change.place)}: {change.before} -> {change.after}" for change in changed]
    return lines + [f"{' / '.join(place)}: gone" for place in found.gone if place[2] in names]


def parse_limit(text: str) -> Limit:
    """Read NAME>CHANGE or NAME<CHANGE, the change in the figure's unit or in %."""
    match = LIMIT.fullmatch(text.strip())
    if match is None:
        remedy = "write 'MAE>2%' or 'PSNR<-0.05'"
        raise OptionError(
            "fail_on", expected="NAME>CHANGE or NAME<CHANGE", got=repr(text), remedy=remedy
        )
    return Limit(
        match["name"], match["side"] == ">", float(match["change"]), bool(match["percent"])
    )


def read_document(path: Path) -> dict[str, object]:
    """A results document."""
    try:
        document = read_json(path)
        schema = Draft202012Validator(json.loads(SCHEMA_PATH.read_text(encoding="utf-8")))
        error = next(schema.iter_errors(document), None)
        got = "" if error is None else f"another document: {error.message[:100]}"
    except FileNotFoundError:
        got = "no such file"
    except (OSError, ValueError) as error:
        got = " ".join(str(error).split())[:100]
    if got:
        remedy = "give what a command wrote with --json"
        raise OptionError(str(path), expected="a results document", got=got, remedy=remedy)
    return document  # type: ignore[return-value]


def changes(before: Mapping[str, object], after: Mapping[str, object]) -> Changes:
    """Match the figures of two documents."""
    old = figures_of(before)
    new = figures_of(after)
    both = tuple(Change(place, figure, new[place]) for place, figure in old.items() if place in new)
    return Changes(
        both, tuple(p for p in old if p not in new), tuple(p for p in new if p not in old)
    )


def figures_of(document: Mapping[str, object]) -> dict[Place, Figure]:
    """Every figure of a document that was validated, by its place."""
    rows: Sequence[Mapping[str, object]] = document["rows"]  # type: ignore[assignment]
    result: dict[Place, Figure] = {}
    for row in rows:
        figures: Mapping[str, dict[str, object]] = row["figures"]  # type: ignore[assignment]
        for name, figure in figures.items():
            place = (str(row["table"]), str(row["name"]), name)
            interval: tuple[object, ...] | None = tuple(figure.get("interval") or ()) or None  # type: ignore[arg-type]
            result[place] = Figure(**{**figure, "interval": interval})  # type: ignore[arg-type]
    return result


def change_rows(changes: Sequence[Change]) -> list[Row]:
    """A row a change, with what it is about in words."""
    return [
        Row(
            "changes",
            f"{change.place[0]}: {change.place[1]}",
            {"before": change.before, "after": change.after},
            {
                "figure": f"{change.place[2]} ({change.after.unit})",
                "by": f"{change.difference:+.3g}",
                "change": "-" if change.percent is None else f"{change.percent:+.2g} %",
            },
        )
        for change in changes
    ]
