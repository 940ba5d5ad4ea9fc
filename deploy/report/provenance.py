"""Tables in which every figure names its source by number, and the list of these sources."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from deploy.results import Figure, Row
from deploy.tables import unit_of, words_of


@dataclass(frozen=True)
class Note:
    """A source, or a reason why a figure is not there.

    Attributes:
        anchor: id of its line on the page.
        tag: what stands beside a figure.
    """

    anchor: str
    tag: str
    text: str
    keys: dict[str, None] = field(default_factory=dict)
    """Names of the figures that it stands behind, in order."""


@dataclass
class Provenance:
    """Numbers sources and reasons in the order in which a page's figures first name them."""

    sources: dict[str, Note] = field(default_factory=dict)
    reasons: dict[str, Note] = field(default_factory=dict)

    def note(self, key: str, figure: Figure) -> Note:
        """What stands behind a figure of that name."""
        if figure.value is None:
            found = self.reasons.setdefault(figure.reason, self._new("reason", "r", figure.reason, self.reasons))
        else:
            found = self.sources.setdefault(figure.source, self._new("source", "", figure.source, self.sources))
        found.keys[key] = None
        return found

    @staticmethod
    def _new(kind: str, letter: str, text: str, known: dict[str, Note]) -> Note:
        number = len(known) + 1
        return Note(f"{kind}-{number}", f"{letter}{number}", text or "not stated")


@dataclass(frozen=True)
class Cell:
    """A figure as a table shows it; `value` is what it sorts by, empty where there is none."""

    text: str
    unit: str
    interval: str
    mode: str
    value: str
    note: Note


@dataclass(frozen=True)
class Line:
    """A row: its name, a cell or nothing for each figure, a word for each column of words."""

    name: str
    cells: tuple[Cell | None, ...]
    words: tuple[str, ...]


@dataclass(frozen=True)
class Grid:
    """A table: names and units of figures, names of words, and its rows."""

    figures: tuple[str, ...]
    units: tuple[str, ...]
    words: tuple[str, ...]
    lines: tuple[Line, ...]


def grid_of(rows: Sequence[Row], provenance: Provenance) -> Grid:
    """Rows as a table; their sources are noted."""
    keys, words = figure_keys(rows), words_of(list(rows))
    lines = [
        Line(
            row.name,
            tuple(_cell(key, row.figures[key], provenance) if key in row.figures else None for key in keys),
            tuple(row.text.get(word, "") for word in words),
        )
        for row in rows
    ]
    units = [unit_of(key, list(rows)) for key in keys]
    return Grid(tuple(keys), tuple(units), tuple(words), tuple(lines))


def figure_keys(rows: Iterable[Row]) -> list[str]:
    """The names of all figures, in order."""
    return list(dict.fromkeys(key for row in rows for key in row.figures))


def _cell(key: str, figure: Figure, provenance: Provenance) -> Cell:
    note = provenance.note(key, figure)
    if figure.value is None:
        return Cell("\u2013", "", "", "unavailable", "", note)
    text, bracket, interval = str(figure).partition(" [")
    unit = "" if figure.unit in ("ratio", "distance") else figure.unit
    return Cell(text, unit, bracket.strip() + interval, figure.mode, repr(figure.value), note)
