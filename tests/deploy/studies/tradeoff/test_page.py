"""Tests of the page: its tables, its plot, and how both look in a browser."""

import base64
import re
from dataclasses import replace
from itertools import product
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from beers_deploy.report.page import render
from beers_deploy.report.plots import DARK, LIGHT, look
from beers_deploy.studies.tradeoff.front import Measured
from beers_deploy.studies.tradeoff.page import (
    SIZE_PX,
    Tradeoff,
    figure_of,
    plot_svg,
    report_of,
    series,
)
from beers_deploy.studies.tradeoff.run import weigh
from tests.deploy.browser import inspect_page
from tests.deploy.studies.tradeoff.synthetic import family, question, synthetic

SVG = "{http://www.w3.org/2000/svg}"
BOARDS = ("vck190",)


def study(
    points: list[Measured] | None = None,
    budget: str | None = None,
    boards: tuple[str, ...] = BOARDS,
) -> Tradeoff:
    candidates = list(family()) if points is None else points
    return weigh(candidates, boards, question(budget), ("No board was used.",))


def words_of(result: Tradeoff) -> list[str]:
    """Return the words in a study's plot."""
    root = ET.fromstring(plot_svg(result))  # noqa: S314 - our own
    return [text.text or "" for text in root.iter(f"{SVG}text")]


def test_with_several_boards_a_network_has_its_own_colour_and_a_board_its_own_marker() -> None:
    points = [
        replace(synthetic(name, 45.0, cost, board=board), name=f"{name} {board}")
        for cost, (name, board) in enumerate(product(("one", "other"), ("vck190", "zcu104")), 1)
    ]
    result = study(points, boards=("vck190", "zcu104"))
    lines = list(series(result))
    assert len({(line.name, line.colour) for line in lines}) == 2
    assert len({(line.board, line.marker) for line in lines}) == 2
    assert len({(line.colour, line.marker) for line in lines}) == 4
    assert {"vck190", "zcu104", "one", "other"} <= set(words_of(result))


@pytest.mark.parametrize("most_s", [9.9, 2_813.0, 4_200_000.0])
def test_every_label_lies_within_the_picture(most_s: float) -> None:
    points = [*family(), synthetic("a network with a rather long name", 44.0, most_s)]
    with look():
        figure = figure_of(study(points, "latency<=9s"))
        # Both extents are in inches.
        box = figure.get_tightbbox()
        width, height = figure.get_size_inches()
    assert box.x0 >= 0
    assert box.y0 >= 0
    assert box.x1 <= width
    assert box.y1 <= height


def test_the_plot_marks_the_recommended_point_and_the_budget() -> None:
    within = words_of(study(budget="latency<=3s"))
    assert {"recommended", "\N{LESS-THAN OR EQUAL TO} 3 s", "1", "4", "tiny", "slow"} <= set(within)
    assert "recommended" not in words_of(study(budget="latency<=0.1s"))
    assert not any("\N{LESS-THAN OR EQUAL TO}" in word for word in words_of(study()))


def test_the_pages_plot_is_the_file_next_to_it(tmp_path: Path) -> None:
    study().report(tmp_path)
    html = (tmp_path / "tradeoff.html").read_text()
    (encoded,) = re.findall(r"data:image/svg\+xml;base64,([^\"]+)", html)
    assert base64.b64decode(encoded).decode() == (tmp_path / "tradeoff.svg").read_text()
    assert not re.search(r'(src|href)="(?!data:)', html), "nothing is asked of the network"
    assert "4. large" in html
    study([]).report(tmp_path)
    assert "no point has every figure" in (tmp_path / "tradeoff.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(("width_px", "dark", "colours"), [(1280, False, LIGHT), (390, True, DARK)])
def test_the_page_fits_the_window_follows_the_theme_and_is_sorted_by_a_click(
    width_px: int, dark: bool, colours: dict[str, str], tmp_path: Path
) -> None:
    look = """const image = document.images[0], root = document.documentElement;
    const table = [...document.querySelectorAll("table.sortable")].at(-1);
    const heads = [...table.tHead.rows[0].cells];
    const head = heads.find((each) => each.textContent.startsWith("board latency"));
    const names = () => [...table.tBodies[0].rows].map((row) => row.cells[0].textContent);
    const sizes = [root.scrollWidth - root.clientWidth, image.naturalWidth, image.width];
    head.click();
    const up = names();
    head.click();
    const colour = getComputedStyle(root).getPropertyValue("--page").trim();
    return [sizes, up, names(), head.getAttribute("aria-sort"), colour];"""
    result = study()
    html = render(report_of(result, plot_svg(result)))
    sizes, up, down, state, colour = inspect_page(
        html, look, tmp_path, width_px=width_px, dark=dark
    )
    overflow_px, natural_px, displayed_px = sizes
    assert overflow_px <= 0
    assert natural_px == SIZE_PX[0]
    assert displayed_px > 340
    assert up == ["tiny", "small", "medium", "slow", "large"]
    assert down == up[::-1]
    assert state == "descending"
    assert colour == colours["page"]
