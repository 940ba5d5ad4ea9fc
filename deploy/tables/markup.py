"""A table as HTML, as a notebook shows it, and as Markdown."""

import re
from collections.abc import Sequence
from html import escape

from beers_deploy.profiles.errors import one_line, visible
from beers_deploy.profiles.figures import Figure, Row
from beers_deploy.tables.columns import Column, columns_of, missing, words_of

STYLE = "border-bottom: 1px solid; padding: 2px 8px; text-align: left"


def html_table(title: str, rows: Sequence[Row]) -> str:
    """Render rows as an HTML table with a line for each row, for notebooks.

    Each figure is followed by its mode: measured, predicted or published. The tooltip of a figure
    is its source, or the reason why it is missing.

    Args:
        title: the heading of the column of names.
        rows: the rows of the table.
    """
    columns = columns_of(rows)
    words = words_of(rows)
    head = [_cell("th", title)]
    for column in columns:
        unit = f" ({column.unit})" if column.unit else ""
        head.append(_cell("th", f"{column.name}{unit}"))
    head += [_cell("th", word) for word in words]
    lines = []
    for row in rows:
        cells = [_cell("th", row.name)]
        cells += [_figure(row.figures.get(column.name), column) for column in columns]
        cells += [_cell("td", row.text.get(word, "")) for word in words]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    header = f"<thead><tr>{''.join(head)}</tr></thead>"
    return f"<table>{header}<tbody>{''.join(lines)}</tbody></table>"


def html_text(text: str) -> str:
    """Return text escaped as HTML, so that none of it acts as markup."""
    return escape(visible(text))


def _cell(tag: str, text: str, tooltip: str = "") -> str:
    about = f' title="{html_text(tooltip)}"' if tooltip else ""
    return f'<{tag} style="{STYLE}"{about}>{html_text(text)}</{tag}>'


def _figure(figure: Figure | None, column: Column) -> str:
    if figure is None:
        return _cell("td", "")
    if figure.value is None:
        return _cell("td", "unavailable", figure.reason)
    text, _ = column.stated(figure)
    return _cell("td", f"{text} {figure.mode}", figure.source)


MARKUP = re.compile(r"[\\`*_\[\]<>&|]")
"""Characters that Markdown treats as markup within a line or a cell, or as the end of a cell."""


def markdown_text(text: str) -> str:
    """Escape text and put it on one line, so that Markdown shows it literally.

    Names of layers come from files, which may contain markup.
    """
    return MARKUP.sub(lambda match: f"\\{match[0]}", one_line(text))


def markdown_table(rows: Sequence[Row]) -> list[str]:
    """Render rows as the lines of a Markdown table, and below it why figures are missing.

    A heading states the unit and the mode of its column if they are the same in all rows; otherwise
    the cells state them.
    """
    columns = columns_of(rows)
    words = words_of(rows)
    names = (
        f"{column.name} ({column.about})" if column.about else column.name for column in columns
    )
    heads = ["", *names]
    lines = [[*heads, *words], ["---"] * (len(heads) + len(words))]
    for row in rows:
        cells = [row.name, *(column.text(row) for column in columns)]
        lines.append([*cells, *(row.text.get(word, "") for word in words)])
    texts = [f"| {' | '.join(map(markdown_text, cells))} |" for cells in lines]
    reasons = missing(rows)
    if reasons:
        texts += ["", *(f"- {markdown_text(reason)}" for reason in reasons)]
    return texts
