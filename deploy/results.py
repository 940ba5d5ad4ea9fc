"""`Table`: the result of a verb, with the origin of each figure.

It is shown on a terminal, as HTML and as Markdown, and saved as one kind of JSON document.
"""

import io
import json
import os
import platform
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rich.console import Console

from beers_deploy import __version__
from beers_deploy.model.io.files import sha256, write_text
from beers_deploy.model.processor import decided, processor_name
from beers_deploy.profiles.errors import OptionError, encodable, one_line, printable
from beers_deploy.profiles.figures import Check, Row, by_table
from beers_deploy.tables.columns import LEGEND
from beers_deploy.tables.frames import bars, tidy_frame, wide_frame
from beers_deploy.tables.html import html_table, html_text
from beers_deploy.tables.markdown import markdown_table, markdown_text
from beers_deploy.tables.terminal import PIPE_WIDTH, default_console, plain, print_rows

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

SCHEMA_NAME = "beers-deploy/results"
SCHEMA_VERSION = 2
SCHEMA_PATH = Path(__file__).parent / "schema" / "results-2.json"


class Input(NamedTuple):
    """A file or a network that figures rest on, by its name and SHA-256."""

    name: str
    sha256: str


def input_of(path: Path) -> Input:
    """Return the name and the digest of a file."""
    return Input(path.name, sha256(path))


def inputs_of(*paths: Path | None) -> tuple[Input, ...]:
    """Return name and digest of each file that exists. Call it before the files are read."""
    return tuple(input_of(path) for path in paths if path is not None and path.is_file())


def require_same(before: Iterable[Input], *paths: Path | None) -> None:
    """Raise OptionError if a file was replaced since `inputs_of`, because the digest would be that
    of another file.
    """
    # A file that is gone meanwhile has no digest, so the lists may differ in length.
    for then, now in zip(before, inputs_of(*paths), strict=False):
        if then != now:
            raise OptionError(
                f"{then.name} changed during this run. Wait until it is written, then run this "
                "again."
            )


@dataclass(frozen=True, repr=False)
class Table:
    """The figures of a verb, its checks, and their origins.

    A table is true if all its checks passed. Iterating over it yields its rows.

    Attributes:
        command: the verb.
        arguments: the arguments of the verb.
        inputs: files and networks that the figures rest on.
        rows: the figures, each with its value, unit, mode, interval and source.
        checks: the checks of the verb; the command exits with 1 if one of them failed.
        notes: sentences that a reader must know.
        title: heading of the whole.
        headings: the heading of each table of rows, if its name is not clear enough by itself.
        captions: a sentence to be shown after a table, by its heading.
        details: tables, figures and words that are shown only in detail, by their names.

    Examples:
        >>> table = bd.check("convbeers-xs-int8", target="vck190")
        >>> table.save("check.json").name
        'check.json'
        >>> bool(table)
        True
    """

    command: str = ""
    arguments: Mapping[str, object] = field(default_factory=dict)
    inputs: tuple[Path | Input, ...] = ()
    rows: tuple[Row, ...] = ()
    checks: tuple[Check, ...] = ()
    notes: tuple[str, ...] = ()
    title: str = ""
    headings: Mapping[str, str] = field(default_factory=dict)
    captions: Mapping[str, str] = field(default_factory=dict)
    details: frozenset[str] = frozenset()

    @property
    def failed(self) -> tuple[Check, ...]:
        """The checks that did not pass."""
        return tuple(check for check in self.checks if not check.passed)

    @property
    def verdict(self) -> str:
        """A sentence that states whether the checks passed; empty without checks."""
        if not self.checks:
            return ""
        if self.failed:
            reasons = "; ".join(map(str, self.failed))
            failed = f"{len(self.failed)} of {len(self.checks)} checks"
            return f"{self.command} FAILED, {failed}: {reasons}"
        return f"{self.command} passed, all {len(self.checks)} checks"

    def shown(self, details: bool = False) -> dict[str, list[Row]]:
        """Return the rows of each table that is shown, by its heading.

        Args:
            details: if True, include tables, figures and words that are shown only in detail.
        """
        tables: dict[str, list[Row]] = {}
        for name, rows in by_table(self.rows).items():
            # Two tables of one heading are shown as one.
            shown = tables.setdefault(self.headings.get(name, name), [])
            if details:
                shown += rows
            elif name not in self.details:
                for row in rows:
                    figures = {k: v for k, v in row.figures.items() if k not in self.details}
                    text = {k: v for k, v in row.text.items() if k not in self.details}
                    shown.append(Row(row.table, row.name, figures, text))
        return {heading: rows for heading, rows in tables.items() if rows}

    def print(self, console: Console | None = None, details: bool = False) -> None:
        """Print the tables, checks and notes.

        Args:
            console: the console of rich; standard output if None.
            details: if True, include tables, figures and words that are shown only in detail.
        """
        console = console or default_console()
        if self.title:
            console.print(plain(self.title), style="bold", highlight=False)
        tables = self.shown(details)
        for heading, rows in tables.items():
            print_rows(heading if heading != self.title else "", rows, console)
            if heading in self.captions:
                console.print(plain(self.captions[heading]), highlight=False, soft_wrap=True)
        if any(row.figures for row in chain.from_iterable(tables.values())):
            console.print(LEGEND, style="dim", highlight=False, markup=False)
        for sentence in self.sentences:
            # Whoever searches a log finds a sentence on one line.
            console.print(plain(sentence), highlight=False, soft_wrap=True)

    @property
    def sentences(self) -> list[str]:
        """The sentences below the tables: each check with its outcome, the notes, the verdict."""
        checks = [f"{'ok    ' if check.passed else 'FAILED'} {check}" for check in self.checks]
        return [*checks, *self.notes, *filter(None, (self.verdict,))]

    def to_dict(self) -> dict[str, object]:
        """Return the table in the schema of results documents."""
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

    def to_json(self) -> str:
        """Return `to_dict` as JSON."""
        return json.dumps(self.to_dict(), indent=1) + "\n"

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the table as a JSON file, atomically, and return its path."""
        write_text(Path(path), self.to_json())
        return Path(path)

    def to_markdown(self) -> str:
        """Return the title, the tables, checks, notes and the verdict as Markdown."""
        lines = [f"# {markdown_text(self.title)}", ""] if self.title else []
        for heading, rows in self.shown().items():
            lines += [f"## {markdown_text(heading)}", "", *markdown_table(rows), ""]
            if heading in self.captions:
                lines += [markdown_text(self.captions[heading]), ""]
        lines += [f"- {markdown_text(sentence)}" for sentence in self.sentences]
        return "\n".join(lines).rstrip() + "\n"

    def to_pandas(self, tidy: bool = False) -> "pd.DataFrame":
        """Return the figures as a pandas DataFrame.

        Args:
            tidy: if True, one line for each figure with value, unit, mode, low, high and source.
                Otherwise one line for each row, with a column for each figure and each text;
                `attrs["units"]` has the units.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        return tidy_frame(self.rows) if tidy else wide_frame(self.rows)

    def plot(self, figure: str | None = None, ax: "Axes | None" = None) -> "Axes":
        """Draw bars of one figure of every row that has it, with its interval, coloured by mode.

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
        return not self.failed

    def __repr__(self) -> str:
        names = ", ".join(row.name for row in self.rows[:3]) + (
            ", ..." if len(self.rows) > 3 else ""
        )
        return f"{type(self).__name__}({self.command}: {len(self.rows)} rows: {printable(names)})"

    def __str__(self) -> str:
        """Return the same text as `print`, without colours."""
        stream = io.StringIO()
        self.print(Console(file=stream, width=PIPE_WIDTH, force_jupyter=False))
        return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())

    def _repr_html_(self) -> str:
        """Return the HTML that a notebook shows: each table, checks and notes."""
        tables = []
        for heading, rows in self.shown().items():
            tables.append(html_table(heading, rows))
            if heading in self.captions:
                tables.append(f"<p>{html_text(one_line(self.captions[heading]))}</p>")
        sentences = [f"<p>{html_text(one_line(sentence))}</p>" for sentence in self.sentences]
        return "".join(tables) + "".join(sentences)


def host() -> dict[str, object]:
    """Return a description of the machine that measured the figures, with None for unknown
    values.
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
    """Return a value of a document with text that any JSON reader accepts."""
    if isinstance(value, dict):
        return {encodable(key): _encodable(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_encodable(item) for item in value]
    return encodable(value) if isinstance(value, str) else value


def _plain(value: object) -> object:
    return value if isinstance(value, str | int | float | bool | type(None)) else str(value)
