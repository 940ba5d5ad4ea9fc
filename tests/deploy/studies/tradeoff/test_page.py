"""The page: its tables, its plot, and how both look in a browser."""

import base64
import re
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from beers_deploy.report.page import render
from beers_deploy.report.plots import DARK, LIGHT
from beers_deploy.studies.tradeoff.advice import Measured, front_rows, pareto_front, recommend
from beers_deploy.studies.tradeoff.page import SIZE_PX, Tradeoff, plot_svg, report_of, series
from tests.deploy.browser import seen
from tests.deploy.studies.tradeoff.made import COMPARE, family

SVG = "{http://www.w3.org/2000/svg}"
COST = "board latency"


def study(points: list[Measured] | None = None) -> Tradeoff:
    found = list(family()) if points is None else points
    front = pareto_front(found, COST)
    best, line = recommend(found, [], [], COMPARE)
    return Tradeoff(
        "tradeoff",
        {},
        (),
        (),
        notes=("No board was used.",),
        board="vck190",
        points=found,
        front=front,
        front_rows=front_rows(front, COST, COMPARE),
        cost=COST,
        best=best,
        line=line,
    )


def page() -> str:
    found = study()
    return render(report_of(found, plot_svg(found)))


def test_the_plot_numbers_the_members_of_the_front_and_the_table_names_them() -> None:
    root = ET.fromstring(plot_svg(study()))  # noqa: S314 - our own
    words = [text.text for text in root.iter(f"{SVG}text")]
    assert [word for word in words if word in ("1", "2", "3", "4")][-4:] == ["1", "2", "3", "4"]
    assert {"tiny", "small", "medium", "large", "slow"} <= set(words)
    assert "4. large" in page()


def test_every_series_has_a_look_of_its_own() -> None:
    looks = [(colour, marker) for _, colour, marker, _ in series(list(family()))]
    assert len(set(looks)) == len(looks) == 5


def test_a_study_without_points_has_a_page(tmp_path: Path) -> None:
    study([]).report(tmp_path)
    assert "no point has every figure" in (tmp_path / "tradeoff.html").read_text()


def test_the_pages_plot_is_the_file_beside_it(tmp_path: Path) -> None:
    study().report(tmp_path)
    html = (tmp_path / "tradeoff.html").read_text()
    (shown,) = re.findall(r"data:image/svg\+xml;base64,([^\"]+)", html)
    assert base64.b64decode(shown).decode() == (tmp_path / "tradeoff.svg").read_text()
    assert not re.search(r'(src|href)="(?!data:)', html), "nothing is asked of the network"


@pytest.mark.slow
@pytest.mark.parametrize("width_px", [1280, 390])
def test_nothing_is_wider_than_the_window(width_px: int, tmp_path: Path) -> None:
    look = """const image = document.images[0], root = document.documentElement;
    return [root.scrollWidth - root.clientWidth, image.naturalWidth, image.getBoundingClientRect().width];"""
    over, natural, shown = seen(page(), look, tmp_path, width_px=width_px)
    assert over <= 0
    assert natural == SIZE_PX[0]
    assert shown > 340


@pytest.mark.slow
def test_a_press_on_a_heading_sorts_by_it_and_another_reverses(tmp_path: Path) -> None:
    look = """const table = [...document.querySelectorAll("table.sortable")].at(-1);
    const head = [...table.tHead.rows[0].cells].find((each) => each.textContent.startsWith("board latency"));
    const names = () => [...table.tBodies[0].rows].map((row) => row.cells[0].textContent);
    head.click(); const up = names(); head.click(); return [up, names(), head.getAttribute("aria-sort")];"""
    up, down, state = seen(page(), look, tmp_path)
    assert up == ["tiny", "small", "medium", "slow", "large"]
    assert down == up[::-1]
    assert state == "descending"


@pytest.mark.slow
@pytest.mark.parametrize(("dark", "colours"), [(False, LIGHT), (True, DARK)])
def test_the_page_follows_the_screen(dark: bool, colours: dict[str, str], tmp_path: Path) -> None:
    look = "return getComputedStyle(document.documentElement).getPropertyValue('--page').trim();"
    assert seen(page(), look, tmp_path, dark=dark) == colours["page"]
