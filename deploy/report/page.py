"""Render a report: tables of rows and pictures, in one HTML file that needs no network access."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from beers_deploy import __version__
from beers_deploy.model.io.files import write_text
from beers_deploy.profiles.errors import visible
from beers_deploy.profiles.figures import Figure, Row
from beers_deploy.tables.columns import columns_of, missing, words_of

INTERVAL = re.compile(r"\[[^\[\]]*\]")


def template(name: str) -> jinja2.Template:
    """Load a jinja2 template of this folder, such as "report.html".

    Values that are inserted into it are escaped, and an undefined name raises an error.
    """
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    # A name that the template misspells raises an error instead of writing nothing.
    strict = jinja2.StrictUndefined
    # Autoescape deals with markup; `finalize` sees every value that is written, and escapes what is
    # not printable.
    environment = jinja2.Environment(
        loader=loader,
        autoescape=True,
        undefined=strict,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_shown,
    )
    environment.filters["unbroken"] = _unbroken
    return environment.get_template(name)


def _unbroken(text: str) -> Markup:
    """Return the text as markup, with each interval in brackets on one line."""
    markup = str(escape(visible(text)))
    unbroken = INTERVAL.sub(lambda interval: interval[0].replace(" ", "\N{NO-BREAK SPACE}"), markup)
    return Markup(unbroken)  # noqa: S704 - escaped above


def _shown(value: object) -> object:
    """Return a value as a page shows it. Control characters are removed from text of files."""
    return visible(value) if isinstance(value, str) and not isinstance(value, Markup) else value


WIDE = 8
"""The number of columns that fit on a page next to the names of the rows."""


@dataclass(frozen=True)
class Section:
    """A table of a report.

    Attributes:
        title: the heading above the table.
        rows: the rows of the table.
        caption: a sentence on how to read the table; empty for none.
    """

    title: str
    rows: Sequence[Row]
    caption: str = ""

    def grid(self, sorts: bool) -> dict[str, Any]:
        """Return the table as the template shows it: heading, columns, lines and notes.

        Args:
            sorts: True if a click on a heading sorts the table. Its rows are then never turned into
                columns.
        """
        rows = list(self.rows)
        figures = columns_of(rows)
        words = words_of(rows)
        columns = [_head(column.name, column.unit) for column in figures]
        columns += [_head(word, word=True) for word in words]
        cells = []
        for row in rows:
            texts = [row.text.get(word, "") for word in words]
            line = [_cell(row.figures.get(column.name)) for column in figures]
            line += [{"text": text, "mode": "word", "title": "", "value": text} for text in texts]
            cells.append(line)
        sides = [columns, [_head(row.name) for row in rows]]
        if not sorts and len(columns) > max(WIDE, len(rows)):
            # Columns that do not fit on a page are turned into rows, because a page is open
            # downwards.
            sides.reverse()
            cells = [list(line) for line in zip(*cells, strict=True)]
        return {
            "title": self.title,
            "caption": self.caption,
            "header": sides[0],
            "lines": list(zip(sides[1], cells, strict=True)),
            "missing": missing(rows),
        }


@dataclass(frozen=True)
class Picture:
    """A picture of a report.

    Attributes:
        title: the heading above the picture.
        source: the picture itself as a data: address.
        caption: a sentence below the picture.
    """

    title: str
    source: str
    caption: str


@dataclass(frozen=True)
class Report:
    """The content of an HTML page, in reading order.

    Attributes:
        title: the title of the page.
        headline: the result, in one or two sentences.
        tables: the tables.
        pictures: the pictures.
        notes: sentences that a reader of the figures must know.
        sorts: True if a click on a heading sorts its table. Rows are then never turned into
            columns.
    """

    title: str
    headline: str
    tables: Sequence[Section]
    pictures: Sequence[Picture]
    notes: Sequence[str]
    sorts: bool = False


def render(report: Report) -> str:
    """Render a report as the text of one HTML file, with its pictures embedded."""
    tables = [table.grid(report.sorts) for table in report.tables]
    return template("report.html").render(report=report, tables=tables, version=__version__)


def write_report(report: Report, path: Path) -> None:
    """Write a report as one HTML file, atomically."""
    write_text(path, render(report))


def _head(name: str, unit: str = "", word: bool = False) -> dict[str, str]:
    return {"text": name, "unit": unit, "mode": "word" if word else ""}


def _cell(figure: Figure | None) -> dict[str, str]:
    if figure is None:
        return {"text": "", "mode": "", "title": "", "value": ""}
    if figure.value is None:
        return {"text": "-", "mode": "unavailable", "title": figure.reason, "value": ""}
    return {
        "text": str(figure),
        "mode": figure.mode,
        "title": figure.source,
        "value": repr(figure.value),
    }
