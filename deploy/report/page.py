"""Render a report: tables of rows and pictures, in one HTML file that asks the network for nothing."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from deploy import __version__
from deploy.report.templates import templates
from deploy.results import Figure, Row
from deploy.tables import missing, unit_of
from model.files import write_text

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
    """The page as HTML."""
    tables = [_grid(table) for table in report.tables]
    return templates().get_template("report.html").render(report=report, tables=tables, version=__version__)


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
