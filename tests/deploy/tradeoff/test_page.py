import csv
import re
from dataclasses import replace
from html.parser import HTMLParser
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from markupsafe import escape
from matplotlib.collections import LineCollection
from PIL import Image

from deploy.report.plots import PX_PER_INCH
from deploy.tradeoff.labels import Box
from deploy.tradeoff.marks import Points
from deploy.tradeoff.page import render_study, write_study
from deploy.tradeoff.plot import NARROW, WIDE, Canvas, Plot, plot_of
from deploy.tradeoff.study import Front, Study, front_rows
from profiles.errors import MachineError
from profiles.figures import Row, unavailable
from tests.deploy.tradeoff.studies import PEERS, UNITS, crops, front, point, study, words

FILES = ("tradeoff.html", "tradeoff.svg", "tradeoff.png", "points.csv")
LOADING = {"src", "href", "srcset", "poster", "data", "action", "formaction", "background", "xlink:href", "ping"}
NASTY = '<script>alert("1")</script> & "><img src=x onerror=alert(2)>'


class Tags(HTMLParser):
    """Every tag of a page with its attributes, and the words of each table row by its id."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.rows: dict[str, str] = {}
        self._row = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {key: value or "" for key, value in attrs}
        self.tags.append((tag, found))
        if tag == "tr":
            self._row = found.get("id", "")

    def handle_endtag(self, tag: str) -> None:
        self._row = "" if tag == "tr" else self._row

    def handle_data(self, data: str) -> None:
        if self._row:
            self.rows[self._row] = self.rows.get(self._row, "") + f" {data}"


def outside(page: str) -> list[str]:
    """Every address in a page that is neither in it nor part of it."""
    loaded = [v for _, attributes in Tags(page).tags for key, v in attributes.items() if key in LOADING]
    styled = re.findall(r"url\(|@import[^;]*", page)
    return [address for address in loaded if not address.startswith(("#", "data:"))] + styled


@pytest.fixture(scope="module")
def found() -> Study:
    return study()


@pytest.fixture(scope="module")
def page(found: Study) -> str:
    return render_study(found)


@pytest.fixture(scope="module")
def written(found: Study, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds the study's report."""
    folder = tmp_path_factory.mktemp("written")
    write_study(found, folder)
    return folder


def test_the_page_asks_the_network_for_nothing(page: str) -> None:
    assert outside(page) == []
    policy = next(a["content"] for _, a in Tags(page).tags if a.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http" not in policy


def test_every_inner_link_leads_somewhere(page: str) -> None:
    tags = Tags(page).tags
    ids = [attributes["id"] for _, attributes in tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert {a["href"][1:] for tag, a in tags if tag == "a"} <= set(ids)


def test_every_figure_of_every_point_is_there_with_unit_mode_and_source(found: Study, page: str) -> None:
    rows = Tags(page).rows
    for number, row in enumerate(found.points, 1):
        said = " ".join(rows[f"point-{number}"].split())
        assert row.name in said
        for figure in row.figures.values():
            value, bracket, interval = str(figure).partition(" [")
            unit = "" if figure.unit in ("ratio", "distance") else f" {figure.unit}"
            shown = f"{value}{unit}{f' [{interval}' if bracket else ''} {figure.mode}"
            assert (shown if figure.value is not None else "unavailable r") in said


def test_what_is_unavailable_says_why_to_the_pointer_and_to_the_reader(page: str) -> None:
    reason = "the DPU takes INT8 alone, with scales that are powers of two"
    cells = [a for tag, a in Tags(page).tags if tag == "td" and a.get("class") == "unavailable"]
    assert any(a["title"] == reason for a in cells)
    assert all(a["data-value"] == "" for a in cells)
    assert re.search(rf"<b>r\d+</b> {reason}", page)


def test_sections_stand_in_the_order_of_reading(found: Study, page: str) -> None:
    order = [
        found.headline,
        found.recommended[0].text["sentence"],
        'class="front-of"',
        found.advice[0],
        'id="crop-1"',
        'id="point-1"',
        'class="layers"',
    ]
    order += ["What runs where", 'id="sources"', "How to read this", found.notes[0]]
    places = [page.index(each if each in page else str(escape(each))) for each in order]
    assert places == sorted(places)


def test_names_are_escaped(tmp_path: Path, found: Study) -> None:
    odd = point(NASTY, 47, 1, 3, words(NASTY, "network", NASTY, NASTY, NASTY, NASTY))
    odd = replace(odd, figures={**odd.figures, "SSIM": unavailable("ratio", NASTY)})
    crop = replace(found.crops[0], point=NASTY, title=NASTY)
    rows = (odd, *found.points)
    nasty = replace(
        found,
        headline=NASTY,
        points=rows,
        fronts=(replace(front(rows, "board latency", "PSNR"), prices=(NASTY,), dominated={rows[3].name: NASTY}),),
        advice=(NASTY,),
        crops=(crop, *found.crops),
        layers={NASTY: found.layers["convbeers-s, C32B3, tile 640"]},
        placement={NASTY: found.placement["convbeers"]},
        notes=(NASTY,),
        boards=(replace(odd, text={"method": NASTY, "board": NASTY, "configuration": NASTY}),),
    )
    write_study(nasty, tmp_path)
    page = (tmp_path / "tradeoff.html").read_text()
    tags = Tags(page).tags
    assert sum(tag == "script" for tag, _ in tags) == 1
    assert all("onerror" not in attributes for _, attributes in tags)
    assert outside(page) == []
    svg = ET.parse(tmp_path / "tradeoff.svg")  # noqa: S314 - written a line above
    titles = [title.text or "" for title in svg.iter("{http://www.w3.org/2000/svg}title")]
    assert any(title.startswith(NASTY) for title in titles)
    assert not list(svg.iter("{http://www.w3.org/2000/svg}script"))
    with (tmp_path / "points.csv").open(newline="") as stream:
        assert next(csv.DictReader(stream))["point"] == NASTY


def test_the_csv_reads_back(written: Path, found: Study) -> None:
    with (written / "points.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert [line["point"] for line in lines] == [row.name for row in found.points]
    for line, row in zip(lines, found.points, strict=True):
        assert {word: line[word] for word in row.text} == dict(row.text)
        for key, figure in row.figures.items():
            value, ends = line[f"{key} ({UNITS[key]})"], (line[f"{key} low"], line[f"{key} high"])
            assert (float(value) if value else None) == figure.value
            assert (tuple(map(float, ends)) if ends[0] else None) == figure.interval
            assert line[f"{key} mode"] == figure.mode
            assert line[f"{key} source"] == (figure.source or figure.reason)


@pytest.mark.slow
def test_the_same_study_gives_the_same_bytes(tmp_path: Path, written: Path) -> None:
    write_study(study(), tmp_path)
    for name in FILES:
        assert (tmp_path / name).read_bytes() == (written / name).read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(FILES)


def test_pictures_are_whole(written: Path) -> None:
    picture = Image.open(written / "tradeoff.png")
    assert picture.size == (2 * WIDE.width, 2 * WIDE.height)
    assert len(set(np.asarray(picture).reshape(-1, 3)[::7].view("V3").ravel().tolist())) > 50
    svg = ET.parse(written / "tradeoff.svg")  # noqa: S314 - our own file
    said = " ".join("".join(text.itertext()) for text in svg.iter("{http://www.w3.org/2000/svg}text"))
    assert "board latency, s (predicted)" in said
    assert "PSNR, dB (measured)" in said
    assert not list(svg.iter("{http://www.w3.org/2000/svg}a"))


def test_a_study_of_nothing_is_a_page_too(tmp_path: Path) -> None:
    empty = Study("Nothing could be had.", (), (), (), (), {}, {}, ())
    write_study(empty, tmp_path)
    assert "there is nothing to plot" in (tmp_path / "tradeoff.html").read_text()
    assert (tmp_path / "points.csv").read_text() == "point\n"


def test_one_point_and_odd_crops(tmp_path: Path, found: Study) -> None:
    rows = (point("alone", 44, 1, 5, words("alone", "network", "INT8 legal", "640", "0", "C32B3")),)
    alone = replace(found, points=rows, fronts=(front(rows, "board latency", "PSNR"),), crops=crops(np.ones((1, 7))))
    write_study(alone, tmp_path)
    assert '<g class="label">' in (tmp_path / "tradeoff.svg").read_text()


def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path: Path, found: Study) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(MachineError):
        write_study(found, tmp_path / "file" / "out")


def test_published_and_missing_figures_are_not_plotted(found: Study) -> None:
    names = shown(found, plot_of(found.fronts[0], Points.of(found.points), WIDE)).keys()
    assert "paper: ConvBEERS on the DPU" not in names
    assert "convbeers-s float32" not in names
    assert PEERS.keys() <= names


def shown(study: Study, plot: Plot) -> dict[str, tuple[float, float]]:
    """Places of points by their names."""
    return {study.points[int(anchor.removeprefix("point-")) - 1].name: at for anchor, at in plot.places.items()}


def test_quality_is_up_and_cost_is_right(found: Study) -> None:
    for each in found.fronts:
        places = shown(found, plot_of(each, Points.of(found.points), WIDE))
        members = [places[name] for name in each.members]
        assert [x for x, _ in members] == sorted(x for x, _ in members)
        assert [y for _, y in members] == sorted((y for _, y in members), reverse=True)


@pytest.mark.parametrize("canvas", [WIDE, NARROW])
def test_every_step_of_a_front_is_named(found: Study, canvas: Canvas) -> None:
    for each in found.fronts:
        plot = plot_of(each, Points.of(found.points), canvas)
        named = {label.wish.lines[0].partition(",")[0] for label in plot.labels}
        assert {name.partition(",")[0] for name in each.steps} <= named


def test_members_that_are_no_steps_need_no_name(found: Study) -> None:
    front = replace(found.fronts[0], steps=found.fronts[0].members[-1:])
    named = [label.wish.lines for label in plot_of(front, Points.of(found.points), WIDE).labels]
    of_members = [lines for lines in named if any(name.startswith(lines[0]) for name in front.members)]
    assert len(of_members) < len(front.members)


def apart(a: Box, b: Box) -> bool:
    return a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]


def within(a: Box, b: Box) -> bool:
    return a[0] >= b[0] and a[1] >= b[1] and a[2] <= b[2] and a[3] <= b[3]


def check_labels(plot: Plot) -> None:
    for a, b in combinations([label.box for label in plot.labels], 2):
        assert apart(a, b)
    for label in plot.labels:
        assert within(label.box, plot.frame)
        assert all(apart(label.box, box) for box in plot.boxes)
    for x, y in plot.places.values():
        assert plot.frame[0] <= x <= plot.frame[2]
        assert plot.frame[1] <= y <= plot.frame[3]


@st.composite
def clouds(draw: st.DrawFn) -> tuple[Row, ...]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    spread = draw(st.sampled_from([1e-9, 0.1, 2.0]))
    methods = draw(st.lists(st.text(min_size=1, max_size=60), min_size=1, max_size=30))
    return tuple(
        point(
            f"{methods[k % len(methods)]} {k}, C32B3, tile 640",
            float(44 + spread * rng.normal()),
            float(np.exp(spread * rng.normal())),
            float(10 * np.exp(spread * rng.normal())),
            words(methods[k % len(methods)], "network", "INT8 legal", "640", "0", "C32B3"),
        )
        for k in range(60)
    )


@settings(max_examples=10, phases=[Phase.generate])  # a study of sixty points shrinks for minutes
@given(clouds(), st.sampled_from([WIDE, NARROW]), st.sampled_from(["board latency", "host p50"]))
def test_labels_of_sixty_points_hide_nothing(rows: tuple[Row, ...], canvas: Canvas, x: str) -> None:
    each = front(rows, x, "PSNR")
    plot = plot_of(each, Points.of(rows), canvas)
    assert len(plot.places) == 60
    check_labels(plot)


@pytest.mark.parametrize("canvas", [WIDE, NARROW])
def test_the_legend_stays_on_the_canvas_and_clear_of_itself(found: Study, canvas: Canvas) -> None:
    plot = plot_of(found.fronts[2], Points.of(found.points), canvas)
    texts = [text.get_text() for text in plot.figure.texts if text.get_gid() == "legend"]
    assert {"convbeers-s", "traditional-best", "INT8 legal", "INT8 free", "bf16", "float32"} <= set(texts)
    assert all(apart(a, b) for a, b in combinations(plot.legend, 2))
    assert all(within(box, (0, plot.frame[3] + 44, canvas.width, canvas.height)) for box in plot.legend)


def test_an_empty_front_has_no_line(found: Study) -> None:
    for each in (found.fronts[0], Front("board latency", "PSNR", (), (), {}, ())):
        plot = plot_of(each, Points.of(found.points if each.members else ()), WIDE)
        assert ('class="front"' in plot.svg()) == bool(each.members)
        assert bool(plot.places) == bool(each.members)


def bars(plot: Plot, at: tuple[float, float]) -> list[tuple[float, float]]:
    """Lower and upper end in pixels of the upright bars that pass through a place."""
    axes = plot.figure.axes[0]
    (drawn,) = (each for each in axes.collections if isinstance(each, LineCollection))
    height = plot.figure.get_size_inches()[1] * PX_PER_INCH
    ends = [axes.transData.transform(segment) for segment in drawn.get_segments()]
    upright = [each for each in ends if abs(each[0][0] - each[1][0]) < 1e-6 < abs(each[0][1] - each[1][1])]
    return [(height - a[1], height - b[1]) for a, b in upright if abs(a[0] - at[0]) < 1e-6]


def test_an_upright_bar_is_that_of_the_paired_difference_and_not_of_the_figure(found: Study) -> None:
    each = found.fronts[0]
    plot = plot_of(each, Points.of(found.points), WIDE)
    places, by_name = shown(found, plot), {row.name: row for row in found.points}
    scale = [
        (places[name][1], by_name[name].figures["PSNR"].value or 0.0) for name in (each.members[0], each.members[-1])
    ]
    px_per_db = (scale[0][0] - scale[1][0]) / (scale[1][1] - scale[0][1])
    name = each.members[2]
    low, high = each.differences[name].figure.interval or (0.0, 0.0)
    value = each.differences[name].figure.value or 0.0
    (a, b) = next(pair for pair in bars(plot, places[name]) if min(pair) < places[name][1] < max(pair))
    assert max(a, b) - places[name][1] == pytest.approx(px_per_db * (value - low), rel=0.01)
    assert places[name][1] - min(a, b) == pytest.approx(px_per_db * (high - value), rel=0.01)
    assert (high - low) < 0.5 * sum(
        (by_name[name].figures["PSNR"].interval or (0, 0))[k] * (-1, 1)[k] for k in (0, 1)
    )
    bare = plot_of(replace(each, differences={}), Points.of(found.points), WIDE)
    assert not bars(bare, shown(found, bare)[name])


def test_the_level_of_what_all_are_held_against_is_drawn_and_told(found: Study) -> None:
    held = Points.of(found.points, found.against, found.differences)
    plot, bare = plot_of(found.fronts[0], held, WIDE), plot_of(found.fronts[0], Points.of(found.points), WIDE)
    assert 'class="against"' in plot.svg()
    assert 'class="against"' not in bare.svg()
    (level,) = (np.asarray(line.get_ydata())[0] for line in plot.figure.axes[0].lines if line.get_gid() == "against")
    best = next(row for row in found.points if row.name == found.against)
    assert level == best.figures["PSNR"].value
    titles = {title.partition("\n")[0]: title for title in plot.titles.values()}
    assert f"PSNR less that of {found.against}: " in titles["traditional-fast"]
    assert f"PSNR less that of {found.against}: " not in titles[found.against]
    member = found.fronts[0].members[1]
    assert f"PSNR less that of {found.fronts[0].members[0]}: " in titles[member]


def usual(study: Study) -> list[Row]:
    """The points but for the poorest."""
    return [row for row in study.points if row.name != "unsupervised-wiener"]


def test_a_poor_outlier_stands_at_the_lower_edge_with_its_value(found: Study) -> None:
    """Else it would press all others together."""
    poor = point("awful", 11, 1, 3, words("awful", "peer", "float32", "none", "none", "none"))
    rows = (*usual(found), poor)
    for x, y in (("board latency", "PSNR"), ("board latency", "LPIPS-squeeze")):
        each = front(rows, x, y)
        plot = plot_of(each, Points.of(rows, found.against), WIDE)
        places = shown(replace(found, points=rows), plot)
        others = [at[1] for name, at in places.items() if name != "awful"]
        assert max(others) < places["awful"][1] < plot.frame[3]
        assert max(others) - min(others) > 0.5 * (plot.frame[3] - plot.frame[1])
        (label,) = (label for label in plot.labels if label.wish.lines[0] == "awful")
        assert label.wish.lines[-1].endswith("off the scale")
        value = str(replace(poor.figures[y], interval=None))
        assert value in label.wish.lines[-1]
        assert any(value in title for title in plot.titles.values() if title.startswith("awful"))
        check_labels(plot)


def test_where_none_is_poor_all_stand_at_their_values(found: Study) -> None:
    rows = [row for row in found.points if row.text["kind"] == "network"]
    plot = plot_of(front(rows, "board latency", "PSNR"), Points.of(rows), WIDE)
    assert not any("off the scale" in line for label in plot.labels for line in label.wish.lines)


def test_differences_stand_behind_their_qualities_and_on_each_front(found: Study, page: str) -> None:
    heads = re.findall(r'data-key="([^"]+)"', page[page.index('id="point-1"') - 6000 : page.index('id="point-1"')])
    assert heads[heads.index("PSNR") + 1] == "PSNR difference"
    assert "PSNR difference from the one before" in page
    assert f"The dotted line is the PSNR of {found.against}." in page
    assert "95 % intervals of the paired difference" in page
    for row in found.recommended:
        assert row.text["sentence"] in page
    assert "on each board" in page


def test_a_front_of_one_member_has_a_reason_in_place_of_a_difference(found: Study) -> None:
    rows = front_rows(found, found.fronts[0])
    assert [row.name for row in rows] == list(found.fronts[0].members)
    steps = [row.figures["PSNR difference from the one before"] for row in rows]
    assert "cheapest" in steps[0].reason
    assert [row.text["before"] for row in rows] == ["none", *found.fronts[0].members[:-1]]
    assert all(step.interval for step in steps[1:])
    assert all(row.figures["PSNR difference"].value is not None for row in rows)
