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
from beers_deploy.profiles.errors import (
    OptionError,
    as_path,
    counted,
    encodable,
    one_line,
    printable,
)
from beers_deploy.profiles.figures import Check, Row, by_table
from beers_deploy.tables.columns import LEGEND
from beers_deploy.tables.frames import bars, tidy_frame, wide_frame
from beers_deploy.tables.markup import html_table, html_text, markdown_table, markdown_text
from beers_deploy.tables.terminal import PIPE_WIDTH, default_console, plain, print_rows

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

SCHEMA_NAME = "beers-deploy/results"
SCHEMA_VERSION = 2
SCHEMA_PATH = Path(__file__).parent / "schema" / "results-2.json"


class Input(NamedTuple):
    """A file or a network that figures depend on.

    Attributes:
        name: the name of the file, or a description such as "samples in memory".
        sha256: the SHA-256 of its content in hexadecimal.
    """

    name: str
    sha256: str


def input_of(path: Path) -> Input:
    """Read a file and return its name and SHA-256, as a results document lists its inputs."""
    return Input(path.name, sha256(path))


def inputs_of(*paths: Path | None) -> tuple[Input, ...]:
    """Return the name and SHA-256 of each file, to detect later that a file was replaced.

    Call this before the files are used, and `require_same` afterwards.

    Args:
        paths: the files. None, folders and files that do not exist are left out.
    """
    return tuple(input_of(path) for path in paths if path is not None and path.is_file())


def require_same(before: Iterable[Input], *paths: Path | None) -> None:
    """Refuse results whose input files changed while they were computed.

    Args:
        before: what `inputs_of` returned for the same files before they were used.
        paths: the files, in the same order.

    Raises:
        OptionError: a file has another name or content than before.
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
    """The result of a command of this package: its figures and checks, with their origins.

    A verb is a function that is also a command, such as `bench`. A figure is a number with its
    unit, its mode (measured, predicted, published or unavailable), its interval and its source.
    A table is true if all its checks passed, or if it has none. Iterating over it yields its rows.

    Attributes:
        command: the name of the verb.
        arguments: the value of each argument of the verb, by the name of the argument.
        inputs: the files and networks that the figures depend on. A path is read when the table is
            written as a document.
        rows: the rows. Each belongs to a table that it names, and has figures and texts by column.
        checks: comparisons of a value with its limit; the command exits with 1 if one of them
            failed.
        notes: sentences shown below the tables, for example on the limits of the figures.
        title: the heading above all tables.
        headings: the heading to show in place of a table's name, by that name.
        captions: a sentence to show below a table, by the table's heading.
        details: the names of tables and of columns that are shown only on request.

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
        """The checks whose value is beyond the limit."""
        return tuple(check for check in self.checks if not check.passed)

    @property
    def verdict(self) -> str:
        """A sentence that states whether all checks passed, and which failed; "" without checks."""
        if not self.checks:
            return ""
        if self.failed:
            reasons = "; ".join(map(str, self.failed))
            failed = f"{len(self.failed)} of {len(self.checks)} checks"
            return f"{self.command} FAILED, {failed}: {reasons}"
        return f"{self.command} passed, all {len(self.checks)} checks"

    def shown(self, details: bool = False) -> dict[str, list[Row]]:
        """Select the rows and columns that a reader sees, grouped by table.

        Args:
            details: True to include the tables and columns that `Table.details` names.

        Returns:
            The rows of each table that is not empty, by the table's heading.
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
        """Print the title, the tables, and below them the checks, notes and verdict.

        Args:
            console: a `rich.console.Console` to print to; None for standard output.
            details: True to include the tables and columns that `Table.details` names.
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
        """The lines below the tables: each check with "ok" or "FAILED", the notes, the verdict."""
        checks = [f"{'ok    ' if check.passed else 'FAILED'} {check}" for check in self.checks]
        return [*checks, *self.notes, *filter(None, (self.verdict,))]

    def to_dict(self) -> dict[str, object]:
        """Return the results document: the table, its inputs' SHA-256, and the machine.

        The keys are those of the JSON schema deploy/schema/results-2.json. All values are of types
        that JSON has. Input files that are still paths are read here.
        """
        inputs = [item if isinstance(item, Input) else input_of(item) for item in self.inputs]
        checks = [check.to_json() for check in self.checks]
        verdict = "passed" if self else "failed"
        document: dict[str, object] = {
            "schema": SCHEMA_NAME,
            "schema_version": SCHEMA_VERSION,
            "tool_version": __version__,
            "command": self.command,
            "arguments": {
                key: value if isinstance(value, str | int | float | None) else str(value)
                for key, value in self.arguments.items()
            },
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
        """Return the document of `to_dict` as JSON text."""
        return json.dumps(self.to_dict(), indent=1) + "\n"

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the document of `to_dict` as a JSON file, atomically, and return its path."""
        file = as_path(path)
        write_text(file, self.to_json())
        return file

    def to_markdown(self) -> str:
        """Render the title, the tables, checks, notes and the verdict as Markdown text."""
        lines = [f"# {markdown_text(self.title)}", ""] if self.title else []
        for heading, rows in self.shown().items():
            lines += [f"## {markdown_text(heading)}", "", *markdown_table(rows), ""]
            if heading in self.captions:
                lines += [markdown_text(self.captions[heading]), ""]
        lines += [f"- {markdown_text(sentence)}" for sentence in self.sentences]
        return "\n".join(lines).rstrip() + "\n"

    def to_pandas(self, tidy: bool = False) -> "pd.DataFrame":
        """Convert the rows to a pandas DataFrame, for plots and further computation.

        Args:
            tidy: True for one line for each figure, with the columns value, unit, mode, low, high
                and source. False for one line for each row, with a column for each figure and each
                text; `DataFrame.attrs["units"]` then has the unit of each figure.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        return tidy_frame(self.rows) if tidy else wide_frame(self.rows)

    def plot(self, figure: str | None = None, ax: "Axes | None" = None) -> "Axes":
        """Draw a bar chart of one figure of all rows, with matplotlib.

        A bar has the colour of its mode (measured, predicted or published), and an error bar if it
        has an interval. Rows without the figure are left out.

        Args:
            figure: the name of the figure, a column of the table; None for the first one.
            ax: the axes to draw on; None for new ones.

        Returns:
            The axes with the chart.

        Raises:
            MissingExtraError: matplotlib is not installed.
            OptionError: no row has a figure of this name.
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
        return (
            f"{type(self).__name__}({self.command}: {counted(len(self.rows), 'row')}: "
            f"{printable(names)})"
        )

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
    """Describe this machine, for the documents of figures that were measured on it.

    Returns:
        The operating system, the architecture and name of the processor, Python's version, the
        number of logical CPUs, the memory in GB, the load average over a minute, and what tests in
        this process found about the runtimes' kernels. A load that the system does not count is
        None.
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
