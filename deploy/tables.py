"""Rows as tables on a terminal: one line a row, the mode of every figure beside it."""

from collections.abc import Iterable

from rich.console import Console
from rich.table import Table
from rich.text import Text

from deploy.results import Figure, Row

MARK = {"measured": ("m", "green"), "predicted": ("p", "yellow"), "published": ("d", "blue")}
LEGEND = "m measured here, p predicted [interval], d published in a document"


def print_rows(title: str, rows: Iterable[Row], console: Console | None = None) -> None:
    """Print the rows of one table; units stand in the header, reasons for missing figures below."""
    rows = list(rows)
    keys = list(dict.fromkeys(key for row in rows for key in row.figures))
    words = list(dict.fromkeys(key for row in rows for key in row.text))
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for key in keys:
        table.add_column(f"{key}\n({unit_of(key, rows)})", justify="right")
    for key in words:
        table.add_column(key, overflow="fold")
    for row in rows:
        figures = [cell(row.figures.get(key)) for key in keys]
        table.add_row(row.name, *figures, *(row.text.get(key, "") for key in words))
    console = console or Console()
    console.print(table)
    console.print(LEGEND, style="dim", highlight=False, markup=False)
    for reason in dict.fromkeys(missing(rows)):
        console.print(reason, style="dim", highlight=False, markup=False)


def unit_of(key: str, rows: list[Row]) -> str:
    """The unit of a column: that of its first figure."""
    return next(row.figures[key].unit for row in rows if key in row.figures)


def cell(figure: Figure | None) -> Text:
    """A figure with its mode, or nothing."""
    if figure is None or figure.value is None:
        return Text("" if figure is None else "-")
    return Text.assemble(str(figure), " ", MARK[figure.mode])


def missing(rows: list[Row]) -> list[str]:
    """Why figures are unavailable."""
    return [
        f"- {key} of {row.name}: {figure.reason}"
        for row in rows
        for key, figure in row.figures.items()
        if figure.value is None
    ]
