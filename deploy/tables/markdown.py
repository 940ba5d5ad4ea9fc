"""A table as Markdown."""

import re
from collections.abc import Sequence

from beers_deploy.profiles.errors import one_line
from beers_deploy.profiles.figures import Row
from beers_deploy.tables.columns import columns_of, missing, words_of

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
