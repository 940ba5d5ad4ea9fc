"""Tables on a terminal of any width: no number is cut or broken.

Several layouts are tried, and the first that fits is printed:

1. a line for each row, or for each figure if there are more figures than rows
2. the same with each interval below its value
3. and 4. the other way round
5. a block for each row, which fits any width
"""

import textwrap
from collections.abc import Iterable, Sequence
from itertools import chain, product

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from beers_deploy.profiles.errors import one_line
from beers_deploy.profiles.figures import Row
from beers_deploy.tables.columns import Column, columns_of, missing, words_of

COLOURS = {"measured": "green", "predicted": "yellow", "published": "blue"}
PIPE_WIDTH = 160
"""The width in columns if the output is not a terminal."""

NAME_WIDTH = 18
"""The minimum number of columns for a name or a word, if it is that long."""

HEADING_WIDTH = 16
"""The number of columns at which the name of a row is wrapped if it heads a column."""


def default_console() -> Console:
    """Return a console of rich on standard output, PIPE_WIDTH columns wide if that is no
    terminal.
    """
    console = Console()
    return console if console.is_terminal else Console(width=PIPE_WIDTH)


def plain(text: str) -> Text:
    """Return text for rich to print literally on one line, without markup or control characters."""
    return Text(one_line(text))


def print_rows(title: str, rows: Iterable[Row], console: Console) -> None:
    """Print one table in the best layout that fits, and below it why figures are missing.

    Args:
        title: the title of the table.
        rows: the rows of the table.
        console: the console of rich to print to, whose width decides the layout.
    """
    table_rows = list(rows)
    console.print(plain(title), style="bold", highlight=False)
    down = len(columns_of(table_rows)) > len(table_rows)
    for by_figure, stacked in product((down, not down), (False, True)):
        build = _by_figure if by_figure else _by_row
        layout = build(table_rows, stacked)
        # On its own console, the least width of a table never exceeds the console's.
        wide = console.options.update(width=10 * PIPE_WIDTH)
        needed = Measurement.get(console, wide, layout)
        if needed.maximum > console.width:
            # Names are shortened before figures: rich narrows the widest columns, whatever their
            # least width, unless it is fixed.
            for column in layout.columns:
                column.width = column.min_width if column.justify == "right" else None
        if needed.minimum <= console.width:
            console.print(layout)
            break
    else:
        _print_blocks(table_rows, console)
    for reason in missing(table_rows):
        console.print(plain(f"- {reason}"), style="dim", highlight=False, soft_wrap=True)
    console.print()


def _empty() -> Table:
    return Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False, show_edge=False)


def _by_row(rows: Sequence[Row], stacked: bool) -> Table:
    """Return a table with a line for each row; the headings state units and modes."""
    table = _empty()
    columns = [[plain(row.name) for row in rows]]
    _add_words(table, "", columns[0])
    for column in columns_of(rows):
        about = f"({column.about})" if column.about else ""
        heading = [*_wrapped(column.name), *_wrapped(about)]
        cells = [_cell(row, column, stacked) for row in rows]
        _add_figures(table, heading, cells)
        columns.append(cells)
    for word in words_of(rows):
        cells = [plain(row.text.get(word, "")) for row in rows]
        _add_words(table, word, cells)
        columns.append(cells)
    for line in zip(*columns, strict=True):
        table.add_row(*line)
    return table


def _by_figure(rows: Sequence[Row], stacked: bool) -> Table:
    """Return a table with a line for each figure. Its unit and its mode are in columns."""
    table = _empty()
    figures = columns_of(rows)
    words = words_of(rows)
    none = [plain("")] * len(words)
    columns = [
        [plain(name) for name in (*(column.name for column in figures), *words)],
        [*(plain(column.unit) for column in figures), *none],
        [*(plain(column.mode) for column in figures), *none],
    ]
    for heading, cells in zip(("", "unit", "mode"), columns, strict=True):
        _add_words(table, heading, cells)
    for row in rows:
        cells = [_cell(row, column, stacked) for column in figures]
        _add_figures(table, _wrapped(row.name), cells)
        columns.append([*cells, *(plain(row.text.get(word, "")) for word in words)])
    for line in zip(*columns, strict=True):
        table.add_row(*line)
    return table


def _add_figures(table: Table, heading: Sequence[str], cells: Sequence[Text]) -> None:
    """Add a column in which no number is broken. Words in it are wrapped."""
    lines = [*heading, *chain.from_iterable(cell.plain.split("\n") for cell in cells)]
    least = max(map(cell_len, lines), default=0)
    text = Text("\n").join(map(plain, heading))
    table.add_column(text, justify="right", overflow="fold", min_width=least)


def _add_words(table: Table, heading: str, cells: Sequence[Text]) -> None:
    """Add a column whose text is wrapped if it is longer than the terminal has room for."""
    longest = max(map(cell_len, (heading, *(cell.plain for cell in cells))), default=0)
    table.add_column(plain(heading), overflow="fold", min_width=min(longest, NAME_WIDTH))


def _wrapped(name: str) -> list[str]:
    """Return a heading in lines of at most `HEADING_WIDTH` columns."""
    return textwrap.wrap(one_line(name), HEADING_WIDTH) or [""]


def _cell(row: Row, column: Column, stacked: bool) -> Text:
    """Return the figure of a row in the colour of its mode.

    Args:
        row: the row.
        column: determines whether unit and mode follow the figure.
        stacked: True to put interval and mode below the value.
    """
    figure = row.figures.get(column.name)
    if figure is None or figure.value is None:
        return Text("" if figure is None else "-")
    text, mode = column.stated(figure)
    if stacked:
        text = text.replace(" [", "\n[")
    shown = Text(text, COLOURS[figure.mode])
    if mode:
        shown.append("\n" if stacked else " ").append(mode)
    return shown


def _print_blocks(rows: Sequence[Row], console: Console) -> None:
    """Print a block for each row: its name, then a line for each figure and each word."""
    for row in rows:
        console.print(plain(row.name), highlight=False)
        block = Table(box=None, show_header=False, padding=(0, 1), pad_edge=False)
        block.add_column(min_width=1)
        for _ in range(2):
            block.add_column(overflow="fold")
        for key in row.figures:
            block.add_row("", plain(key), _cell(row, Column(key, "", ""), stacked=False))
        for word, words in row.text.items():
            block.add_row("", plain(word), plain(words))
        console.print(block)
