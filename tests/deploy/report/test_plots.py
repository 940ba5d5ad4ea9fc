from xml.etree import ElementTree as ET

import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import rc_context

from beers_deploy.report.plots import DARK, LIGHT, look, new_figure, round_values, set_ticks, svg_of


@given(st.floats(-6, 6), st.floats(0.01, 12), st.integers(3, 16), st.booleans())
def test_ticks_are_few_rising_and_on_the_axis(
    start: float, decades: float, most: int, logarithmic: bool
) -> None:
    low = 10**start
    high = 10 ** (start + decades)
    values = round_values(low, high, most, logarithmic=logarithmic)
    assert 1 <= len(values) <= most
    assert values == sorted(set(values))
    assert all(low * (1 - 1e-9) <= value <= high * (1 + 1e-9) for value in values)


@pytest.mark.parametrize(
    ("low", "high", "logarithmic", "values"),
    [(1, 10_000, True, [1, 10, 100, 1000, 10_000]), (41.5, 46.5, False, [42, 43, 44, 45, 46])],
)
def test_ticks_are_round(low: float, high: float, logarithmic: bool, values: list[float]) -> None:
    assert round_values(low, high, 6, logarithmic=logarithmic) == values


def drawn() -> str:
    """Return the SVG of a line with every kind of text, with markup and a control character."""
    with look():
        figure = new_figure(300, 200)
        axes = figure.add_subplot(xlabel="$cost$ <a> & \x01", ylabel="quality \u4e2d")
        axes.plot([1, 2], [3, 4], marker="D", color=LIGHT["mark0"])
        set_ticks(axes.xaxis, 4)
        return svg_of(figure, "a plot")


def test_words_in_an_svg_are_plain_text_whatever_a_name_holds() -> None:
    words = " ".join(ET.fromstring(drawn()).itertext())  # noqa: S314 - our own
    assert "$cost$ <a> & \\x01" in words


def test_every_colour_of_an_svg_follows_the_screen() -> None:
    text = drawn()
    for name, colour in LIGHT.items():
        assert text.count(colour) == 1, "it must be in the style sheet only"
        assert f"--{name}: {DARK[name]};" in text
    assert "stroke: var(--mark0)" in text


def test_the_users_settings_for_matplotlib_change_nothing() -> None:
    plain = drawn()
    with rc_context(
        {"lines.linewidth": 9, "font.size": 30, "axes.grid": False, "svg.fonttype": "path"}
    ):
        assert drawn() == plain
