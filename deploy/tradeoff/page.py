"""The report of a trade-off: one HTML file that asks the network for nothing, its plot as SVG and PNG, points as CSV.

Every plot is laid out twice, for a wide screen and for a phone; the page's style sheet shows one of them.
"""

import csv
import io
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from markupsafe import Markup

from deploy import __version__
from deploy.report.axes import Axis, padded
from deploy.report.labels import Box, Wish, place, text_width
from deploy.report.layer_bars import layer_bars
from deploy.report.legend import legend_of
from deploy.report.marks import Mark, filling_of, marks_of
from deploy.report.page import TEMPLATES, Grid, Provenance, figure_keys, grid_of, templates
from deploy.report.plot import FONT_PX, LABEL_PX, Dot, Plot, State
from deploy.report.plot_png import write_png
from deploy.report.plot_svg import plot_style, plot_svg
from deploy.results import unit_of, words_of
from deploy.tradeoff.study import Crop, Front, Study
from model.io.files import write_text
from model.io.pictures import picture_url, stretch_of
from profiles.figures import Figure, Row, by_table, number

RISING = {"PSNR", "SSIM", "flat SNR", "board throughput", "board efficiency"}
"""Figures of which more is better."""


@dataclass(frozen=True)
class Points:
    """The rows of a study, and how their methods look; a row's number is its place in the table."""

    rows: Sequence[Row]
    marks: Mapping[str, Mark]

    def mark(self, row: Row) -> Mark:
        """The shape and colour of its method, filled as its precision."""
        return replace(self.marks[method_of(row)], filling=filling_of(row.text.get("precision", "")))

    def on(self, front: Front) -> list[tuple[int, Row]]:
        """Number and row of the points that can be drawn."""
        return [(k, row) for k, row in enumerate(self.rows) if drawn(row, front)]


def method_of(row: Row) -> str:
    """What the row's point runs."""
    return row.text.get("method", row.name)


def drawn(row: Row, front: Front) -> bool:
    """Whether it has both figures, a cost above zero, and neither published: those were found on other images."""
    found = [row.figures.get(key) for key in (front.x, front.y)]
    if any(figure is None or figure.value is None or figure.mode == "published" for figure in found):
        return False
    return (row.figures[front.x].value or 0.0) > 0


def state_of(front: Front, name: str) -> State:
    """Where a point lies beside the front."""
    return "front" if name in front.members else "beaten" if name in front.beaten else "even"


LABEL_LINES = 3


@dataclass(frozen=True)
class Canvas:
    """A size in pixels; how many letters a line of a label has; whether labels end at the first comma."""

    width: int
    height: int
    letters: int
    brief: bool


WIDE, NARROW = Canvas(1080, 660, 30, brief=False), Canvas(400, 640, 24, brief=True)


def wishes_of(front: Front, rows: Sequence[Row], dots: Sequence[Dot], canvas: Canvas) -> list[Wish]:
    """Names of the front's steps, best first; then of the best point of each other method, where there is room."""
    sign = 1 if front.y in RISING else -1
    by_quality = sorted(
        zip(rows, dots, strict=True), key=lambda each: -sign * (each[0].figures[front.y].value or 0.0)
    )
    named = {method_of(row) for row in rows if row.name in front.members}
    best = {method_of(row): dot for row, dot in reversed(by_quality) if method_of(row) not in named}
    steps = [dot for _, dot in by_quality if dot.name in front.steps]
    wanted = [*steps, *sorted(best.values(), key=lambda dot: dot.y)]
    heads = Counter(_head(dot.name) for dot in wanted)
    return [
        Wish(dot.x, dot.y, _lines(dot.name, canvas, heads[_head(dot.name)] == 1), dot.state == "front")
        for dot in wanted
    ]


def _head(name: str) -> str:
    return name.partition(", ")[0]


def _lines(name: str, canvas: Canvas, alone: bool) -> tuple[str, ...]:
    """A name in a few lines, a new one after its first comma; brief where that is enough to tell it by."""
    parts = [_head(name)] if canvas.brief and alone else name.split(", ", 1)
    lines = [line for part in parts for line in textwrap.wrap(part, canvas.letters)] or [name]
    if len(lines) > LABEL_LINES:
        lines[LABEL_LINES - 1] = lines[LABEL_LINES - 1][: canvas.letters - 1] + "\u2026"
    return tuple(lines[:LABEL_LINES])


LEFT_PX, RIGHT_PX, TOP_PX, BELOW_PX = 66, 14, 34, 54
TICK_PX = (64, 44)
MARGIN, REACH = 0.07, 0.5
"""Shares of the values' range: left free around them; at most shown beyond them of intervals."""

BETTER = "better: up and to the left"


def plot_of(front: Front, points: Points, canvas: Canvas) -> Plot:
    """The plot of one front."""
    shown = points.on(front)
    rows = [row for _, row in shown]
    legend, legend_px = legend_of(rows, points.marks, canvas.width, canvas.height)
    frame = (LEFT_PX, TOP_PX, canvas.width - RIGHT_PX, canvas.height - BELOW_PX - legend_px)
    x = _axis(rows, front, front.x, (frame[0], frame[2]), logarithmic=True)
    y = _axis(rows, front, front.y, (frame[3], frame[1]), logarithmic=False)
    dots = [_dot(front, points, *each, x, y) for each in shown]
    line = tuple(_staircase(front, dots, frame))
    better = (frame[0], frame[1], frame[0] + text_width(BETTER, FONT_PX) + 12, frame[1] + 26)
    lines = [*_thin(line), *(bar for dot in dots if dot.state == "front" for bar in dot.bars)]
    wishes = wishes_of(front, rows, dots, canvas)
    return Plot(
        title=f"{front.y} against {front.x}",
        size=(canvas.width, canvas.height),
        frame=frame,
        x_title=_axis_title(front.x, rows),
        y_title=_axis_title(front.y, rows),
        x_ticks=_ticks(x, int((frame[2] - frame[0]) / TICK_PX[0])),
        y_ticks=_ticks(y, int((frame[3] - frame[1]) / TICK_PX[1])),
        front=line,
        dots=tuple(sorted(dots, key=lambda dot: dot.radius)),
        labels=tuple(place(wishes, [better, *(dot.box for dot in dots)], lines, frame, LABEL_PX)),
        legend=tuple(legend),
        better=BETTER,
    )


def _axis(rows: Sequence[Row], front: Front, key: str, ends_px: tuple[float, float], *, logarithmic: bool) -> Axis:
    """Holds all values, and the intervals of the front's members as far as they do not squeeze the values."""
    values = [row.figures[key].value or 0.0 for row in rows] or [1.0, 10.0]
    members = [row.figures[key].interval for row in rows if row.name in front.members]
    ends = [end for interval in members if interval for end in interval if end > 0 or not logarithmic]
    inner = padded(min(values), max(values), MARGIN, logarithmic=logarithmic)
    outer = padded(min(values), max(values), REACH, logarithmic=logarithmic)
    low, high = max(outer[0], min([*ends, inner[0]])), min(outer[1], max([*ends, inner[1]]))
    better_first = logarithmic == (key in RISING)  # cheap is left and good is up, whichever way the figure runs
    start, end = ends_px[::-1] if better_first else ends_px
    return Axis(low, high, start, end, logarithmic)


def _ticks(axis: Axis, most: int) -> tuple[tuple[float, str], ...]:
    return tuple((axis.place(tick), number(tick, 12)) for tick in axis.ticks(most))


def _axis_title(key: str, rows: Sequence[Row]) -> str:
    modes = " and ".join(dict.fromkeys(row.figures[key].mode for row in rows))
    unit = next((row.figures[key].unit for row in rows), "")
    return f"{key}, {unit} ({modes})" if rows else key


def _dot(front: Front, points: Points, row_number: int, row: Row, x: Axis, y: Axis) -> Dot:
    across, up = row.figures[front.x], row.figures[front.y]
    place_x, place_y = x.place(across.value or 0.0), y.place(up.value or 0.0)
    bars: list[Box] = []
    if across.interval:
        ends = sorted(map(x.place, across.interval))
        bars.append((ends[0], place_y, ends[1], place_y))
    if up.interval:
        ends = sorted(map(y.place, up.interval))
        bars.append((place_x, ends[0], place_x, ends[1]))
    state = state_of(front, row.name)
    beaten = f"beaten by {front.beaten[row.name]}" if row.name in front.beaten else ""
    said = [f"{key} {figure} {figure.unit}, {figure.mode}" for key, figure in ((front.y, up), (front.x, across))]
    title = "\n".join(line for line in (row.name, *said, beaten) if line)
    return Dot(row.name, place_x, place_y, points.mark(row), state, tuple(bars), f"point-{row_number + 1}", title)


def _staircase(front: Front, dots: Sequence[Dot], frame: Box) -> Iterator[tuple[float, float]]:
    """The best quality for each cost: from the bottom at the cheapest member to the right edge."""
    members = sorted((dot.x, dot.y) for dot in dots if dot.name in front.members)
    if not members:
        return
    yield members[0][0], frame[3]
    yield members[0]
    for (_, before), (x, y) in pairwise(members):
        yield x, before
        yield x, y
    yield frame[2], members[-1][1]


def _thin(line: Sequence[tuple[float, float]]) -> list[Box]:
    """The steps of a line as boxes."""
    return [(min(a, c), min(b, d), max(a, c) + 1, max(b, d) + 1) for (a, b), (c, d) in pairwise(line)]


PARTS = ("low", "high", "mode", "source")
"""Columns after that of the value; the source of an unavailable figure is the reason."""


def write_points(rows: Sequence[Row], path: Path) -> None:
    """Write a line a point: its name, its words, and five columns a figure."""
    keys, words = figure_keys(rows), words_of(list(rows))
    header = ["point", *words]
    for key in keys:
        header += [f"{key} ({unit_of(key, list(rows))})", *(f"{key} {part}" for part in PARTS)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        figures = [part for key in keys for part in _parts(row.figures.get(key))]
        writer.writerow([row.name, *(row.text.get(word, "") for word in words), *figures])
    write_text(path, text.getvalue())


def _parts(figure: Figure | None) -> list[str]:
    if figure is None:
        return [""] * (1 + len(PARTS))
    if figure.value is None:
        return ["", "", "", figure.mode, figure.reason]
    low, high = (repr(end) for end in figure.interval) if figure.interval else ("", "")
    return [repr(figure.value), low, high, figure.mode, figure.source]


FIRST = ("board latency", "PSNR")
"""The axes of the plot that is shown first, and written as SVG and PNG."""

STATES = {"front": "on the front", "even": "not told apart from the front", "beaten": "beaten by {}"}


FILES = ("tradeoff.html", "tradeoff.svg", "tradeoff.png", "points.csv")


def write_study(study: Study, out: Path) -> None:
    """Write each of FILES into a folder, whole or not at all.

    Raises:
        MachineError: a file cannot be written.
    """
    fronts = ordered(study.fronts)
    first = plot_of(fronts[0] if fronts else Front(*FIRST, (), (), {}, ()), points_of(study), WIDE)
    write_text(out / "tradeoff.svg", plot_svg(first, alone=True))
    write_png(first, out / "tradeoff.png")
    write_points(study.points, out / "points.csv")
    write_text(out / "tradeoff.html", render_study(study))


def ordered(fronts: Sequence[Front]) -> list[Front]:
    """The fronts, that of quality against board latency first."""
    return sorted(fronts, key=lambda front: (front.x, front.y) != FIRST)


def points_of(study: Study) -> Points:
    """The study's points, a look for each method."""
    return Points(study.points, marks_of(map(method_of, study.points)))


def render_study(study: Study) -> str:
    """The page as HTML."""
    provenance, points, fronts = Provenance(), points_of(study), ordered(study.fronts)
    script = Markup((TEMPLATES / "tradeoff.js").read_text(encoding="utf-8"))  # noqa: S704 - our own file
    shown = {
        "study": study,
        "plots": [_shown(front, points) for front in fronts],
        "costs": list(dict.fromkeys(front.x for front in fronts)),
        "qualities": list(dict.fromkeys(front.y for front in fronts)),
        "points": grid_of([_with_place(row, fronts) for row in study.points], provenance),
        "marks": [points.mark(row) for row in study.points],
        "crops": crop_urls(study.crops),
        "layers": {name: (layer_bars(rows), grid_of(rows, provenance)) for name, rows in study.layers.items()},
        "placement": {name: _grids(rows, provenance) for name, rows in study.placement.items()},
        "provenance": provenance,
    }
    template = templates().get_template("tradeoff.html")
    return template.render(shown, plot_style=plot_style(), script=script, version=__version__).lstrip()


@dataclass(frozen=True)
class Shown:
    """A front with its plot, for a wide screen and for a narrow one."""

    front: Front
    wide: Markup
    narrow: Markup


def _shown(front: Front, points: Points) -> Shown:
    return Shown(front, *(plot_svg(plot_of(front, points, canvas)) for canvas in (WIDE, NARROW)))


def _with_place(row: Row, fronts: Sequence[Front]) -> Row:
    """The row, with where it lies beside the first front as its first word."""
    if not fronts:
        return row
    front = fronts[0]
    state = STATES[state_of(front, row.name)].format(front.beaten.get(row.name, "")) if drawn(row, front) else ""
    return replace(row, text={f"{front.y} against {front.x}": state, **row.text})


def _grids(rows: Sequence[Row], provenance: Provenance) -> dict[str, Grid]:
    return {name: grid_of(found, provenance) for name, found in by_table(rows).items()}


def crop_urls(crops: Sequence[Crop]) -> list[str]:
    """Pictures of crops, all with the reference's grey scale, or the first one's where there is none."""
    if not crops:
        return []
    stretch = stretch_of(next((crop.dn for crop in crops if crop.point == "reference"), crops[0].dn))
    return [picture_url(stretch.to_bytes(crop.dn)) for crop in crops]
