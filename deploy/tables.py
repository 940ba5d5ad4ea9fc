"""Rows as tables on a terminal, the mode of every figure beside it."""

from collections.abc import Iterable

from rich.console import Console
from rich.table import Table
from rich.text import Text

from deploy.results import Figure, Row

MARK = {"measured": ("m", "green"), "predicted": ("p", "yellow"), "published": ("d", "blue")}
LEGEND = "m measured here, p predicted [interval], d published in a document"
PIPE_WIDTH = 200
"""Columns when the output is no terminal: nothing is cut."""


def print_rows(title: str, rows: Iterable[Row], console: Console | None = None) -> None:
    """Print the rows of one table, reasons for missing figures below it.

    One line a row; or, where there are more figures than rows, one line a figure.
    """
    rows = list(rows)
    console = console or default_console()
    keys = list(dict.fromkeys(key for row in rows for key in row.figures))
    table = by_figure(rows, keys) if len(keys) > len(rows) else by_row(rows, keys)
    table.title, table.title_justify = title, "left"
    console.print(table)
    if keys:
        console.print(LEGEND, style="dim", highlight=False, markup=False)
    for reason in missing(rows):
        console.print(reason, style="dim", highlight=False, markup=False)


def default_console() -> Console:
    """Standard output, wide enough for whole tables when it is a file or a pipe."""
    console = Console()
    return console if console.is_terminal else Console(width=PIPE_WIDTH)


def by_row(rows: list[Row], keys: list[str]) -> Table:
    """One line a row, the units in the header."""
    table = Table("")
    words = words_of(rows)
    for key in keys:
        table.add_column(f"{key}\n({unit_of(key, rows)})", justify="right")
    for word in words:
        table.add_column(word, overflow="fold")
    for row in rows:
        figures = [cell(row.figures.get(key)) for key in keys]
        table.add_row(row.name, *figures, *(row.text.get(word, "") for word in words))
    return table


def by_figure(rows: list[Row], keys: list[str]) -> Table:
    """One line a figure, the rows side by side."""
    table = Table("", "unit")
    for row in rows:
        table.add_column(row.name, justify="right", overflow="fold")
    for key in keys:
        table.add_row(key, unit_of(key, rows), *(cell(row.figures.get(key)) for row in rows))
    for word in words_of(rows):
        table.add_row(word, "", *(row.text.get(word, "") for row in rows))
    return table


def words_of(rows: list[Row]) -> list[str]:
    """The names of the plain words beside figures."""
    return list(dict.fromkeys(word for row in rows for word in row.text))


def unit_of(key: str, rows: list[Row]) -> str:
    """The unit of a column: that of its first figure."""
    return next(row.figures[key].unit for row in rows if key in row.figures)


def cell(figure: Figure | None) -> Text:
    """A figure with its mode, or nothing."""
    if figure is None or figure.value is None:
        return Text("" if figure is None else "-")
    return Text.assemble(str(figure), " ", MARK[figure.mode])


def missing(rows: list[Row]) -> list[str]:
    """Why figures are unavailable: a line a reason."""
    names: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        for key, figure in row.figures.items():
            if figure.value is None:
                names.setdefault((key, figure.reason), []).append(row.name)
    few = {place: ", ".join(found) if len(found) < len(rows) / 2 else "" for place, found in names.items()}
    return [f"- {key}{f' of {few[key, reason]}' if few[key, reason] else ''}: {reason}" for key, reason in names]
