"""Tests that a report's tables are complete, and are transposed if their figures do not fit."""

import re
from html import unescape

import pytest

from beers_deploy.profiles.figures import Row, measured, unavailable
from beers_deploy.report.page import WIDE, Report, Section, render


def lines(rows: list[Row]) -> list[list[str]]:
    """Return the text of each cell of a page's table, row by row."""
    page = render(Report("A page", "Its headline", [Section("A table", rows)], [], []))
    cells = [
        re.findall(r"<t[dh]\b[^>]*>(.*?)</t[dh]>", line, re.DOTALL)
        for line in re.findall(r"(?s)<tr>.*?</tr>", page)
    ]
    return [
        [" ".join(unescape(re.sub("<.*?>", " ", cell)).split()) for cell in line] for line in cells
    ]


def rows_of(figures: int, count: int) -> list[Row]:
    return [
        Row(
            "t",
            f"row <{k}>",
            {f"figure {n}": measured(100 * k + n, "s", "a watch") for n in range(figures)},
        )
        for k in range(count)
    ]


@pytest.mark.parametrize(
    ("figures", "count"), [(1, 1), (WIDE, 2), (WIDE + 1, 2), (WIDE + 1, WIDE + 3)]
)
def test_every_figure_is_in_the_cell_of_its_row_and_name(figures: int, count: int) -> None:
    rows = rows_of(figures, count)
    (_, *columns), *body = lines(rows)
    transposed = columns == [row.name for row in rows]
    assert transposed == (figures > WIDE and figures > count)
    for head, *cells in body:
        for column, cell in zip(columns, cells, strict=True):
            name, figure = (column, head) if transposed else (head, column)
            row = next(row for row in rows if row.name == name)
            assert cell == f"{row.figures[figure.removesuffix(' s')]} measured"


@pytest.mark.parametrize("figures", [2, WIDE + 2])
def test_texts_and_reasons_of_missing_figures_are_shown(figures: int) -> None:
    row = Row(
        "t",
        "one",
        {**rows_of(figures, 1)[0].figures, "power": unavailable("W", "no meter")},
        {"note": "so & so"},
    )
    text = render(
        Report("A page", "Its headline", [Section("A table", [row], "How to read it")], [], [])
    )
    assert "so &amp; so" in text
    assert "no meter" in text
    assert "How to read it" in text
