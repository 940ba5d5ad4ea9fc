"""The one kind of document that commands write with --json: rows of figures that say where they
come from.
"""

import io
import json
import os
import platform
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rich import table as rich_table
from rich.console import Console
from rich.measure import Measurement
from rich.text import Text

from beers_deploy import __version__
from beers_deploy.frames import bars, figures_of, html_table, tidy_frame, wide_frame, words_of
from beers_deploy.model.io.files import sha256, write_text
from beers_deploy.model.processor import decided, processor_name
from beers_deploy.profiles.errors import OptionError, encodable, one_line, printable, visible
from beers_deploy.profiles.figures import Check, Figure, Row, by_table

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

SCHEMA_NAME = "beers-deploy/results"
SCHEMA_VERSION = 2
SCHEMA_PATH = Path(__file__).parent / "schema" / "results-2.json"


class Input(NamedTuple):
    """What a figure rests on, by its name and SHA-256: of a network in memory, which is no file."""

    name: str
    sha256: str


def input_of(path: Path) -> Input:
    """A file's name and digest."""
    return Input(path.name, sha256(path))


def inputs_of(*paths: Path | None) -> tuple[Input, ...]:
    """Return name and digest of each file that exists: taken before the files are read."""
    return tuple(input_of(path) for path in paths if path is not None and path.is_file())


def require_same(before: Iterable[Input], *paths: Path | None) -> None:
    """Raise OptionError if a file was replaced since `inputs_of`: the digest would be that of
    another one.
    """
    # A file that is gone meanwhile has no digest, so the lists may differ in length.
    for then, now in zip(before, inputs_of(*paths), strict=False):
        if then != now:
            expected = "a file that stays as it is"
            remedy = "wait until it is written, then run this again"
            raise OptionError(
                then.name, expected=expected, got="a change during this run", remedy=remedy
            )


@dataclass(frozen=True, repr=False)
class Table:
    """The figures that one verb found, and where they come from: what `--json` writes and a
    notebook shows.

    Attributes:
        command: the verb.
        arguments: what it was given.
        inputs: files and networks that the figures rest on.
        rows: the figures, each with its value, unit, mode, interval and source.
        checks: of a verb that judges, its verdict.
        notes: what a reader must know, a sentence each.

    Examples:
        >>> table = bd.check("convbeers-xs-int8", "vck190")
        >>> table.save("check.json").name
        'check.json'
        >>> bool(table)
        True
    """

    command: str
    arguments: Mapping[str, object]
    inputs: tuple[Path | Input, ...]
    rows: tuple[Row, ...]
    checks: tuple[Check, ...] = ()
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """The whole as the schema of results documents wants it."""
        inputs = [item if isinstance(item, Input) else input_of(item) for item in self.inputs]
        checks = [check.to_json() for check in self.checks]
        verdict = "passed" if self else "failed"
        document: dict[str, object] = {
            "schema": SCHEMA_NAME,
            "schema_version": SCHEMA_VERSION,
            "tool_version": __version__,
            "command": self.command,
            "arguments": {key: _plain(value) for key, value in self.arguments.items()},
            "inputs": [item._asdict() for item in inputs],
            "host": host(),
            **({"verdict": verdict, "checks": checks} if checks else {}),
            "rows": [
                {
                    "table": row.table,
                    "name": row.name,
                    "figures": {key: figure.to_json() for key, figure in row.figures.items()},
                    "text": dict(row.text),
                }
                for row in self.rows
            ],
            "notes": list(self.notes),
        }
        # The name of a file may hold bytes of another encoding, which UTF-8 cannot hold.
        return {key: _encodable(value) for key, value in document.items()}

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write `to_dict` as a JSON file, whole or not at all."""
        write_text(Path(path), json.dumps(self.to_dict(), indent=1) + "\n")
        return Path(path)

    def to_pandas(self, tidy: bool = False) -> "pd.DataFrame":
        """The figures as a pandas DataFrame.

        Args:
            tidy: one line a figure with value, unit, mode, low, high and source. Otherwise one line
                a row, a column for each figure and for the words beside them; `attrs["units"]` has
                the units.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        return tidy_frame(self.rows) if tidy else wide_frame(self.rows)

    def plot(self, figure: str | None = None, ax: "Axes | None" = None) -> "Axes":
        """Bars of one figure of every row that has it, with its interval, coloured by mode.

        Args:
            figure: its name; the first that any row has if None.
            ax: axes of matplotlib to draw on; new ones if None.

        Raises:
            MissingExtraError: matplotlib is not installed.
            OptionError: no row has such a figure.
        """
        return bars(self.rows, figure, ax)

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __bool__(self) -> bool:
        return all(check.passed for check in self.checks)

    def __repr__(self) -> str:
        names = ", ".join(row.name for row in self.rows[:3]) + (
            ", ..." if len(self.rows) > 3 else ""
        )
        return f"{type(self).__name__}({self.command}: {len(self.rows)} rows: {printable(names)})"

    def __str__(self) -> str:
        """Return all tables as the commands print them, and the notes."""
        stream = io.StringIO()
        for name, rows in by_table(self.rows).items():
            print_rows(name, rows, Console(file=stream, width=PIPE_WIDTH, force_jupyter=False))
        lines = [line.rstrip() for line in stream.getvalue().splitlines()]
        return "\n".join([*lines, *map(one_line, self.notes)])

    def _repr_html_(self) -> str:
        """What a notebook shows: each table, the source of a figure as its tooltip."""
        return "".join(
            html_table(name, rows) for name, rows in by_table(self.rows).items()
        ) + "".join(f"<p>{escape(visible(note))}</p>" for note in self.notes)


def host() -> dict[str, object]:
    """What the measured figures were measured on, and what was asked of its kernels; None for what
    is not told.
    """
    import psutil

    return {
        "system": platform.system(),
        "machine": platform.machine(),
        "processor": processor_name(),
        "python": platform.python_version(),
        "cpus": psutil.cpu_count() or 1,
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        # Windows has no such count: psutil begins one when asked, and returns 0 for the first
        # seconds.
        "load_1_min": None if platform.system() == "Windows" else round(psutil.getloadavg()[0], 2),
        "kernels": decided(),
    }


def _encodable(value: object) -> object:
    """Return a value of a document with text that any reader of JSON takes."""
    if isinstance(value, dict):
        return {encodable(key): _encodable(item) for key, item in value.items()}

    if isinstance(value, list):
        return [_encodable(item) for item in value]
    return encodable(value) if isinstance(value, str) else value


def _plain(value: object) -> object:
    return value if isinstance(value, str | int | float | bool | type(None)) else str(value)


COLOURS = {"measured": "green", "predicted": "yellow", "published": "blue"}
LEGEND = "measured: here; predicted: by a model, with its [interval]; published: in a document"
PIPE_WIDTH = 200
"""Columns when the output is no terminal: nothing is cut."""


def print_rows(title: str, rows: Iterable[Row], console: Console | None = None) -> None:
    """Print the rows of one table, reasons for missing figures below it.

    One line a row; or, where there are more figures than rows, one line a figure. Where a terminal
    is too narrow for either, one line a figure of each row: no number is ever cut or broken.
    """
    rows = list(rows)
    console = console or default_console()
    keys = figures_of(rows)
    table = by_figure(rows, keys) if len(keys) > len(rows) else by_row(rows, keys)
    # On its own console, the least width of a table never exceeds the console's.
    wide_options = console.options.update(width=PIPE_WIDTH)
    if Measurement.get(console, wide_options, table).minimum > console.width:
        table = one_by_one(rows)
    table.title = plain(title)
    table.title_justify = "left"
    console.print(table)
    if keys:
        console.print(LEGEND, style="dim", highlight=False, markup=False)
    for reason in missing(rows):
        console.print(plain(reason), style="dim")


def default_console() -> Console:
    """Standard output, wide enough for whole tables when it is a file or a pipe."""
    console = Console()
    return console if console.is_terminal else Console(width=PIPE_WIDTH)


def plain(text: str) -> Text:
    """Return words as they are, on one line: no markup, and nothing that a terminal would obey."""
    return Text(one_line(text))


MARKUP = re.compile(r"[\\`*_\[\]<>&|]")
"""Characters that Markdown reads as markup within a line or a cell, or as the end of a cell."""


def markdown_text(text: str) -> str:
    """Return text on one line that Markdown shows as it is: a layer's name comes from the network's
    file.
    """
    return MARKUP.sub(lambda match: f"\\{match[0]}", one_line(text))


def by_row(rows: list[Row], keys: list[str]) -> rich_table.Table:
    """One line a row; the units in the header, and the mode where it is that of
    the whole column.
    """
    table = rich_table.Table("")
    words = words_of(rows)
    for key in keys:
        mode = common_mode(key, rows)
        about = ", ".join(filter(None, (unit_of(key, rows), mode)))
        table.add_column(
            Text("\n").join(map(plain, (key, f"({about})") if about else (key,))), justify="right"
        )
    for word in words:
        table.add_column(plain(word), overflow="fold")
    for row in rows:
        figures = [cell(row.figures.get(key), common_mode(key, rows)) for key in keys]
        table.add_row(plain(row.name), *figures, *(plain(row.text.get(word, "")) for word in words))
    return table


def by_figure(rows: list[Row], keys: list[str]) -> rich_table.Table:
    """One line a figure, the rows side by side; its mode in a column where it
    is that of them all.
    """
    table = rich_table.Table("", "unit", "mode")
    for row in rows:
        table.add_column(plain(row.name), justify="right", overflow="fold")
    for key in keys:
        mode = common_mode(key, rows)
        figures = [cell(row.figures.get(key), mode) for row in rows]
        table.add_row(plain(key), plain(unit_of(key, rows)), mode, *figures)
    for word in words_of(rows):
        table.add_row(plain(word), "", "", *(plain(row.text.get(word, "")) for row in rows))
    return table


def one_by_one(rows: list[Row]) -> rich_table.Table:
    """One line a figure, row after row: the narrowest table."""
    table = rich_table.Table("", "", "", "unit")
    # Long text is folded, because no number may be cut.
    table.columns[1].overflow = table.columns[2].overflow = "fold"
    for row in rows:
        figures = [
            (plain(key), cell(figure, ""), plain(figure.unit))
            for key, figure in row.figures.items()
        ]
        words = [(plain(word), plain(text), plain("")) for word, text in row.text.items()]
        table.add_section()
        for number, line in enumerate([*figures, *words] or [()]):
            table.add_row(plain("" if number else row.name), *line)
    return table


def unit_of(key: str, rows: list[Row]) -> str:
    """The unit of a column: that of all its figures; empty where they differ, as those of a
    comparison.
    """
    # The rows of a comparison have figures of different units in one column.
    units = {row.figures[key].unit for row in rows if key in row.figures}
    return units.pop() if len(units) == 1 else ""


def common_mode(key: str, rows: list[Row]) -> str:
    """The mode of all figures of a column that there are; empty where they
    differ or none is there.
    """
    modes = {
        row.figures[key].mode
        for row in rows
        if key in row.figures and row.figures[key].value is not None
    }
    return modes.pop() if len(modes) == 1 else ""


def cell(figure: Figure | None, said: str) -> Text:
    """A figure, its mode behind it unless the table says it elsewhere; or nothing."""
    if figure is None or figure.value is None:
        return Text("" if figure is None else "-")
    text = Text(str(figure), COLOURS[figure.mode])
    return text if said else text.append(f" {figure.mode}")


def missing(rows: list[Row]) -> list[str]:
    """Why figures are unavailable: a line a reason."""
    names: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        for key, figure in row.figures.items():
            if figure.value is None:
                names.setdefault((key, figure.reason), []).append(row.name)
    few = {
        place: ", ".join(row_names) if len(row_names) < len(rows) / 2 else ""
        for place, row_names in names.items()
    }
    return [
        f"- {key}{f' of {few[key, reason]}' if few[key, reason] else ''}: {reason}"
        for key, reason in names
    ]
