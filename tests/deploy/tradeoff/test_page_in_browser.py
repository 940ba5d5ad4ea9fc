"""The page's table, buttons and slider, driven in a real browser; skipped where there is none."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import onnx
import pytest
from PIL import Image

from deploy.report.plots import DARK, LIGHT
from deploy.tradeoff import boards
from deploy.tradeoff.boards import configurations, every_configuration
from deploy.tradeoff.page import render_study
from deploy.tradeoff.plot import NARROW, WIDE
from deploy.tradeoff.study import Study
from profiles import load_target
from profiles.figures import Row
from tests.deploy.dpu.graphs import integer_convbeers
from tests.deploy.tradeoff.browser import Report, browser, drive, framed
from tests.deploy.tradeoff.made_results import Made, outcome
from tests.deploy.tradeoff.studies import study
from tests.deploy.tradeoff.test_page import apart, within

SORT = """
const table = document.querySelector("table.sorts");
const column = (name) => [...table.tHead.rows[0].cells].findIndex((each) => each.textContent.startsWith(name));
const press = (name) => {
  table.tHead.rows[0].cells[column(name)].querySelector("button").click();
  return [...table.tBodies[0].rows].map((row) => row.cells[0].textContent);
};
const state = () => [...table.tHead.rows[0].cells].map((each) => each.getAttribute("aria-sort"));
const drive = (report) => {
  report.before = state();
  for (const name of ["board latency", "tile", "point"]) {
    report[`${name} up`] = press(name);
    report[`${name} state`] = [state()[column(name)], state().filter((each) => each !== "none").length];
    report[`${name} down`] = press(name);
    report[`${name} reversed`] = [state()[column(name)]];
  }
};
"""

SLIDE = """
const drive = (report) => {
  const [wipe, stage] = [document.querySelector("#wipe"), document.querySelector(".stage")];
  const slider = wipe.querySelector("input"), [left, right] = wipe.querySelectorAll("select");
  const [before, after] = stage.querySelectorAll("img");
  const see = () => [slider.value, getComputedStyle(after).clipPath, before.alt, after.alt, slider.ariaValueText];
  report.hidden = wipe.hidden;
  report.first = see();
  slider.value = 25;
  slider.dispatchEvent(new Event("input"));
  report.moved = see();
  left.selectedIndex = 4;
  left.dispatchEvent(new Event("change"));
  report.chosen = see();
  const box = stage.getBoundingClientRect();
  const at = (share) => ({ clientX: box.left + share * box.width, buttons: 1, bubbles: true });
  stage.dispatchEvent(new PointerEvent("pointerdown", at(0.75)));
  report.touched = see();
  stage.dispatchEvent(new PointerEvent("pointermove", at(1.5)));
  report.beyond = see();
  stage.dispatchEvent(new PointerEvent("pointermove", { ...at(0.1), buttons: 0 }));
  report.hovered = see();
  slider.focus();
  report.focused = document.activeElement === slider;
  report.shown = before.src === document.querySelector("#crop-5").src && before.naturalWidth > 0;
};
"""

SWITCH = """
const drive = (report) => {
  const seen = () => [...document.querySelectorAll(".front-of")].filter((each) => each.getClientRects().length)
    .map((each) => `${each.dataset.quality} ${each.dataset.cost}`);
  report.first = seen();
  const press = (name) => [...document.querySelectorAll("#axes button")].find((b) => b.textContent === name).click();
  press("host p50");
  report.cost = seen();
  press("SSIM");
  report.both = seen();
  report.pressed = [...document.querySelectorAll("#axes [aria-pressed=true]")].map((each) => each.textContent);
};
"""

LOOK = """
const drive = (report) => {
  const page = document.querySelector("iframe")?.contentDocument ?? document;
  const all = (selector) => [...page.querySelectorAll(selector)];
  const seen = (each) => each.getClientRects().length > 0;
  for (const each of all(".front-of")) each.hidden = false;
  for (const each of all("details")) each.open = true;
  const box = (text) => { const b = text.getBBox(); return [b.x, b.y, b.x + b.width, b.y + b.height]; };
  const plots = all(".front-of svg.plot").filter(seen);
  report.texts = plots.map((svg) => [...svg.querySelectorAll("text:not([transform])")].map(box));
  report.sizes = plots.map((svg) => [svg.viewBox.baseVal.width, svg.viewBox.baseVal.height]);
  report.wide = [page.documentElement.scrollWidth, page.defaultView.innerWidth];
  report.broken = all("img").filter((each) => !each.naturalWidth).length;
  report.colours = [getComputedStyle(page.body).backgroundColor,
    getComputedStyle(page.querySelector(".front-of .dot path")).stroke];
};
"""

CHOOSE = """
const drive = (report) => {
  const section = document.querySelector("#boards");
  const [board, configuration, figure] = section.querySelectorAll("select");
  const options = (select) => [...select.options].map((each) => each.value);
  const choose = (select, value) => { select.value = value; select.dispatchEvent(new Event("change")); };
  const see = () => ({
    rows: [...section.querySelectorAll("tbody tr")].filter((row) => row.getClientRects().length)
      .map((row) => row.cells[0].dataset.value),
    marks: [...section.querySelectorAll(".drawn .chip")]
      .map((mark) => ["x", "y"].map((side) => Number(mark.getAttribute(side)))),
    titles: [...section.querySelectorAll(".drawn title")].map((each) => each.textContent),
    heights: [...section.querySelectorAll(".drawn .height")].map((each) => each.textContent),
    drawn: section.querySelector(".drawn").getClientRects().length > 0,
    status: section.querySelector("[role=status]").textContent,
    configuration: configuration.value,
  });
  report.boards = options(board);
  report.first = see();
  choose(board, "zcu104");
  report.configurations = options(configuration);
  report.other = see();
  choose(configuration, "all");
  report.all = see();
  choose(figure, "board efficiency");
  report.unavailable = see();
  choose(board, "vck190");
  report.back = see();
};
"""

TEMPT = """
const drive = (report) => {
  report.widths = [...document.querySelectorAll(".bait")].map((each) => each.naturalWidth);
};
"""


@pytest.fixture(scope="module")
def page() -> str:
    browser()
    return render_study(study())


@pytest.fixture(scope="module")
def sorted_rows(page: str, tmp_path_factory: pytest.TempPathFactory) -> Report:
    return drive(page, SORT, tmp_path_factory.mktemp("sort"))


def test_the_table_sorts_by_numbers_and_the_unavailable_stay_last(sorted_rows: Report) -> None:
    values = {row.name: row.figures["board latency"].value for row in study().points}
    for order, falls in (("up", False), ("down", True)):
        found = [values[name] for name in sorted_rows[f"board latency {order}"]]
        known = [value for value in found if value is not None]
        assert known == sorted(known, reverse=falls)
        assert found == known + [None] * (len(found) - len(known))
        assert len(known) not in (0, len(found))


def test_the_table_sorts_by_words_and_by_numbers_in_words(sorted_rows: Report) -> None:
    rows: dict[str, Row] = {row.name: row for row in study().points}
    tiles = [rows[name].text["tile"] for name in sorted_rows["tile up"]]
    assert list(dict.fromkeys(tiles)) == ["128", "256", "640", "none", "not stated"]
    names = sorted_rows["point up"]
    assert sorted(names) == sorted(rows)
    assert names.index("convbeers float32") < names.index("nl-means") < names.index("traditional-best")
    assert sorted_rows["point down"] == names[::-1]


def test_headings_say_how_the_table_is_sorted(sorted_rows: Report) -> None:
    assert set(sorted_rows["before"]) == {"none"}
    for name in ("board latency", "tile", "point"):
        assert sorted_rows[f"{name} state"] == ["ascending", 1]
        assert sorted_rows[f"{name} reversed"] == ["descending"]


def test_the_slider_wipes_between_any_two_crops(page: str, tmp_path: Path) -> None:
    report = drive(page, SLIDE, tmp_path)
    second = "convbeers-s INT8 legal, C32B3, tile 640, halo exact"
    assert report["hidden"] is False
    assert report["first"][:4] == ["50", "inset(0px 0px 0px 50%)", "degraded", second]
    assert report["moved"][:2] == ["25", "inset(0px 0px 0px 25%)"]
    assert report["moved"][4] == f"25 % degraded, the rest {second}"
    assert report["chosen"][2:4] == ["reference", second]
    assert report["touched"][:2] == ["75", "inset(0px 0px 0px 75%)"]
    assert report["beyond"][0] == report["hovered"][0] == "100"
    assert report["focused"] is True
    assert report["shown"] is True


def test_buttons_choose_the_plot(page: str, tmp_path: Path) -> None:
    report = drive(page, SWITCH, tmp_path)
    assert report["first"] == ["PSNR board latency"]
    assert report["cost"] == ["PSNR host p50"]
    assert report["both"] == ["SSIM host p50"]
    assert report["pressed"] == ["SSIM", "host p50"]


@pytest.fixture(scope="module")
def on_boards(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """A study of two networks on two boards."""
    made = {"convbeers-s": Made(40.0, 2, 8), "convbeers": Made(40.03, 2, 16)}
    path = integer_convbeers(tmp_path_factory.mktemp("net") / "net.onnx", 2, 8)
    found = boards.on_boards(
        [outcome(name, each) for name, each in made.items()],
        every_configuration(["vck190", "zcu104"]),
        lambda _: onnx.load(path),
    )
    return replace(study(), boards=tuple(each.row for each in found))


def test_a_choice_of_board_and_configuration_redraws_the_networks(on_boards: Study, tmp_path: Path) -> None:
    browser()
    report = drive(render_study(on_boards), CHOOSE, tmp_path)
    first, other, every = report["first"], report["other"], report["all"]
    assert report["boards"] == ["vck190", "zcu104"]
    assert first["rows"] == ["convbeers-s, tile 640, vck190 C32B3", "convbeers, tile 640, vck190 C32B3"]
    assert report["configurations"] == ["all", *(dpu.name for dpu in configurations(load_target("zcu104")))]
    assert (other["configuration"], len(other["rows"])) == ("B4096", 2)
    assert all("zcu104 B4096" in title for title in other["titles"])
    assert len(every["rows"]) == len(every["marks"]) == 2 * len(load_target("zcu104").configurations)
    places = {row.name: row.figures["board latency"].value or 0.0 for row in on_boards.boards}
    across = [x for x, _ in every["marks"]]
    assert sorted(across) == [x for _, x in sorted(zip([places[n] for n in every["rows"]], across, strict=True))]
    up = [y for _, y in first["marks"]]
    assert up[0] > up[1]  # the better picture stands higher
    assert len(set(first["heights"])) == len(first["heights"]) > 1  # however near the pictures are
    assert first["status"] == ""
    assert "no power of zcu104 under its DPU is published" in report["unavailable"]["status"]
    assert not report["unavailable"]["drawn"]
    assert report["back"]["drawn"]
    assert report["back"]["configuration"] == "C32B3"


def test_the_choice_is_not_there_without_boards(page: str) -> None:
    assert 'id="boards"' not in page


def rgb(colour: str) -> str:
    return f"rgb({', '.join(str(int(colour[k : k + 2], 16)) for k in (1, 3, 5))})"


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (1280, True), (390, False), (390, True)])
def test_it_looks_right(page: str, tmp_path: Path, width: int, dark: bool) -> None:
    report = drive(page if width > 500 else framed(page, width), LOOK, tmp_path, dark=dark)
    assert report["asked"] == ["/page.html"]
    assert report["broken"] == 0
    assert report["wide"][0] <= report["wide"][1] <= width
    assert report["colours"] == [rgb("#14171b" if dark else "#ffffff"), rgb((DARK if dark else LIGHT)["mark0"])]
    assert len(report["texts"]) == len(study().fronts)
    for boxes, (right, bottom) in zip(report["texts"], report["sizes"], strict=True):
        assert right == (WIDE if width > 500 else NARROW).width
        assert all(apart(a, b) for a, b in combinations(boxes, 2))
        assert all(within(box, (0, 0, right, bottom)) for box in boxes)


def test_the_policy_keeps_even_a_changed_page_from_asking(page: str, tmp_path: Path) -> None:
    Image.new("L", (5, 5)).save(tmp_path / "bait.png")
    changed = page.replace("</body>", '<img class="bait" src="/bait.png"></body>')
    kept = drive(changed, TEMPT, tmp_path)
    let = drive(changed.replace("default-src 'none'; img-src data:", "img-src *"), TEMPT, tmp_path)
    assert kept["widths"] == [0]
    assert "/bait.png" not in kept["asked"]
    assert let["widths"] == [5]
    assert "/bait.png" in let["asked"]
