import io

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console

from beers_deploy.profiles.figures import (
    DIGITS,
    Row,
    measured,
    number,
    predicted,
    published,
    unavailable,
)
from beers_deploy.results import Table
from beers_deploy.tables.columns import LEGEND
from beers_deploy.tables.terminal import PIPE_WIDTH, default_console

TALL = [
    Row(
        "t",
        "one",
        {"latency": predicted(2, "s", (1, 3), "m"), "power": unavailable("W", "no [counter]")},
    ),
    Row("t", "two", {"latency": published(42, "s", "paper")}, {"remedy": "none"}),
    Row("t", "three", {}),
]
WIDE = [
    Row(
        "t",
        "one",
        {f"figure {k}": measured(k + 0.5, "px", "here") for k in range(12)},
        {"remedy": "pad " * 30},
    )
]
TABLES = {
    "tall": TALL,
    "wide": WIDE,
    "words alone": [Row("t", "one", {}, {"finding": "a [b] c"})],
    "empty": [],
}


def shown(rows: list[Row], width: int) -> str:
    stream = io.StringIO()
    Table(rows=tuple(rows)).print(Console(file=stream, width=width))
    return stream.getvalue()


@pytest.mark.parametrize("width", [40, 80, 200])
def test_values_modes_and_reasons_are_shown(width: int) -> None:
    text = shown(TALL, width)
    for word in ("42", "published", "predicted", "no [counter]"):
        assert word in text


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("width", [40, 80, 200])
def test_no_line_is_wider_than_the_terminal(name: str, width: int) -> None:
    assert all(cell_len(line) <= width for line in shown(TABLES[name], width).splitlines())


def test_every_figure_of_a_wide_row_is_read_at_80_columns() -> None:
    """With more figures than rows, each figure has a line, so that no column is too narrow."""
    lines = shown(WIDE, 80).splitlines()
    for k in range(12):
        assert any(
            f"figure {k} " in line and "measured" in line and line.endswith(f" {k + 0.5:g}")
            for line in lines
        )


@given(st.integers(40, 200))
def test_long_names_give_way_before_a_figure_is_cut(width: int) -> None:
    """Names are wrapped, so that each of the wide figures keeps its interval and mode."""
    figures = {f"figure {k}": predicted(913_456, "px", (503_456, 1_660_123), "m") for k in range(4)}
    stated = {key: published(77_777, "px", "paper") for key in figures}
    name = "convbeers-s, INT8 on the DPU (C32B3), whole tiles, halo 22 px"
    rows = [Row("t", f"{name}, {k}", figures if k else stated) for k in range(6)]
    text = shown(rows, width)
    assert text.count("1,660,000]") == 5 * 4
    assert text.count("77,777") == 4
    assert text.count("predicted") - text.count("predicted by") == 5 * 4


def test_a_missing_figure_is_a_dash_with_its_reason_once() -> None:
    rows = [Row("t", "one", {"power": unavailable("W", "no counter")})] * 2
    text = shown(rows, 80)
    assert text.count("no counter") == 1
    assert "0" not in text.replace(LEGEND, "")


def test_a_tag_is_a_word_and_no_unit() -> None:
    """A tag m next to a number of metres or seconds was mistaken for the unit."""
    mixed = [
        Row("t", "ours", {"time": measured(1.586, "s", "here")}),
        Row("t", "board", {"time": predicted(2, "s", (1, 3), "model")}),
    ]
    for width in (40, 80):
        text = shown(mixed, width)
        assert all(word in text for word in ("1.586", "measured", "predicted", "(s)"))
        assert " m " not in text
        alike = shown([mixed[0]] * 2, width)
        assert alike.count("measured") == 2, "in the heading, and in the legend"
        line_of_ours = next(
            line for line in shown(mixed[:1], width).splitlines() if "1.586" in line
        )
        assert line_of_ours.split() in (["time", "s", "measured", "1.586"], ["ours", "1.586"])


def test_a_table_of_words_needs_no_legend() -> None:
    assert LEGEND not in shown(TABLES["words alone"], 200)
    assert LEGEND in shown(TALL, 200)


def test_a_pipe_is_wide_enough_for_whole_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    assert default_console().width == PIPE_WIDTH


@given(st.floats(-1e9, 1e9), st.sampled_from(sorted(set(DIGITS.values()))))
@example(1234.5, 12)
def test_a_shown_number_is_the_number_to_its_digits(value: float, digits: int) -> None:
    text = number(value, digits)
    assert float(text.replace(",", "")) == pytest.approx(
        value, rel=5.01 * 10.0**-digits, abs=1e-300
    )
    assert "e" not in text or abs(value) < 1e-4
