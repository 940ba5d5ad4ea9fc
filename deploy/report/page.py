"""Render a report: tables of rows and pictures, in one HTML file that asks the network for nothing."""

import base64
import hashlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import jinja2

from deploy import __version__
from deploy.results import missing, unit_of, words_of
from model.io.files import write_text
from profiles.figures import Figure, Row

INTERVAL = re.compile(r"\[[^\[\]]*\]")


TEMPLATES = Path(__file__).parents[1]
"""The folder whose packages hold the pages' templates."""


@cache
def templates() -> jinja2.Environment:
    """The environment, with the filters `corners`, `digest` and `unbroken`."""
    loader = jinja2.FileSystemLoader(TEMPLATES)
    made = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    made.filters |= {"corners": corners, "digest": digest, "unbroken": unbroken}
    return made


def corners(polygon: Iterable[tuple[float, float]]) -> str:
    """A polygon as SVG writes it."""
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in polygon)


def unbroken(text: str) -> str:
    """The text with each interval in brackets on one line."""
    return INTERVAL.sub(lambda found: found[0].replace(" ", "\N{NO-BREAK SPACE}"), text)


def digest(text: str) -> str:
    """What a content security policy names a script or a style sheet by."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


WIDE = 8
"""Columns that fit on a page beside the names of the rows."""


@dataclass(frozen=True)
class Table:
    """A table of the report, with a sentence on how to read it."""

    title: str
    rows: Sequence[Row]
    caption: str = ""


@dataclass(frozen=True)
class Picture:
    """A picture as a data: address, and what it shows."""

    title: str
    source: str
    caption: str


@dataclass(frozen=True)
class Report:
    """What a page holds, in reading order."""

    title: str
    headline: str
    tables: Sequence[Table]
    pictures: Sequence[Picture]
    notes: Sequence[str]


def render(report: Report) -> str:
    """The report as one HTML file, pictures embedded."""
    tables = [_grid(table) for table in report.tables]
    return templates().get_template("report/report.html").render(report=report, tables=tables, version=__version__)


def write_report(report: Report, path: Path) -> None:
    """Write the page, whole or not at all."""
    write_text(path, render(report))


def _grid(table: Table) -> dict[str, object]:
    """Header and lines of a table; figures stand below each other where beside each other they would not fit."""
    rows = list(table.rows)
    figures = list(dict.fromkeys(key for row in rows for key in row.figures))
    words = list(dict.fromkeys(key for row in rows for key in row.text))
    columns = [_head(key, unit_of(key, rows)) for key in figures] + [_head(word, word=True) for word in words]
    cells = [
        [_cell(row.figures.get(key)) for key in figures] + [_word(row.text.get(word, "")) for word in words]
        for row in rows
    ]
    heads = [_head(row.name) for row in rows]
    if len(columns) > max(WIDE, len(rows)):
        columns, heads, cells = heads, columns, [list(line) for line in zip(*cells, strict=True)]
    return {
        "title": table.title,
        "caption": table.caption,
        "header": columns,
        "lines": list(zip(heads, cells, strict=True)),
        "missing": missing(rows),
    }


def _head(name: str, unit: str = "", word: bool = False) -> dict[str, str]:
    return {"text": name, "unit": unit, "mode": "word" if word else ""}


def _word(text: str) -> dict[str, str]:
    return {"text": text, "mode": "word", "title": ""}


def _cell(figure: Figure | None) -> dict[str, str]:
    if figure is None:
        return {"text": "", "mode": "", "title": ""}
    if figure.value is None:
        return {"text": "-", "mode": "unavailable", "title": figure.reason}
    return {"text": str(figure), "mode": figure.mode, "title": figure.source}


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
    """A figure as a table shows it; `value` is what it sorts by, empty where there is none, `ends` its interval's."""

    text: str
    unit: str
    interval: str
    mode: str
    value: str
    note: Note
    ends: tuple[str, ...] = ()


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
            tuple(_sourced_cell(key, row.figures[key], provenance) if key in row.figures else None for key in keys),
            tuple(row.text.get(word, "") for word in words),
        )
        for row in rows
    ]
    units = [unit_of(key, list(rows)) for key in keys]
    return Grid(tuple(keys), tuple(units), tuple(words), tuple(lines))


def figure_keys(rows: Iterable[Row]) -> list[str]:
    """The names of all figures, in order."""
    return list(dict.fromkeys(key for row in rows for key in row.figures))


def _sourced_cell(key: str, figure: Figure, provenance: Provenance) -> Cell:
    note = provenance.note(key, figure)
    if figure.value is None:
        return Cell("\u2013", "", "", "unavailable", "", note)
    text, bracket, interval = str(figure).partition(" [")
    unit = "" if figure.unit in ("ratio", "distance") else figure.unit
    ends = tuple(map(repr, figure.interval or ()))
    return Cell(text, unit, bracket.strip() + interval, figure.mode, repr(figure.value), note, ends)
