"""The plot of one front: a mark for each point with its bars, the front's line, labels and a legend.

Quality is up and cost to the right. Every plot is laid out twice, for a wide screen and for a phone; the page's style
sheet shows one of them.
"""

import math
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import CARETDOWN
from matplotlib.patheffects import withStroke

from deploy.report.plots import LIGHT, PX_PER_INCH, TITLE_PX, look, new_figure, set_ticks, svg_of, text_width
from deploy.tradeoff.labels import Box, Label, Wish, place
from deploy.tradeoff.marks import (
    LABEL_PX,
    RADIUS_PX,
    ROW_PX,
    WORDS_PX,
    Entry,
    Points,
    State,
    legend_of,
    method_of,
    state_of,
    value_of,
)
from deploy.tradeoff.outcome import DIRECTIONS
from deploy.tradeoff.study import Front, figure_words
from model.io.files import whole_file
from profiles.figures import Row


@dataclass(frozen=True)
class Canvas:
    """A size in pixels; how many letters a line of a label has; whether labels end at the first comma."""

    width: int
    height: int
    letters: int
    brief: bool


WIDE, NARROW = Canvas(1080, 660, 30, brief=False), Canvas(400, 640, 24, brief=True)
LEFT_PX, RIGHT_PX, TOP_PX, BELOW_PX = 80, 14, 34, 54
LEAST_PX = 260
"""The frame's least height: below a long legend the canvas grows."""

TICK_PX = (60, 44)
BETTER = "better: up and to the left"


@dataclass(frozen=True)
class Plot:
    """A figure drawn within `look`, and what lies where on it, in pixels from its upper left corner.

    Attributes:
        front: what it shows.
        figure: matplotlib's.
        frame: where values stand.
        places: of each point by the id of its row, (x, y).
        boxes: that marks cover.
        labels: of some points.
        titles: what appears when the pointer rests on a point.
        legend: what each of its parts covers.
    """

    front: Front
    figure: Figure
    frame: Box
    places: Mapping[str, tuple[float, float]]
    boxes: Sequence[Box]
    labels: Sequence[Label]
    titles: Mapping[str, str]
    legend: Sequence[Box]

    def svg(self, *, alone: bool = False) -> Markup:
        """For the page, with links to its table; `alone` as a file of its own."""
        name = f"{self.front.y} against {self.front.x}"
        return svg_of(self.figure, name, self.titles, linked=not alone, alone=alone)

    def write_png(self, path: Path) -> None:
        """Write it with two pixels for each of its own, light, whole or not at all."""
        with whole_file(path) as temporary, look():
            for text in self.figure.texts:
                if text.get_gid() == "label":
                    text.set_path_effects([withStroke(linewidth=3, foreground=LIGHT["page"])])
            self.figure.savefig(temporary, format="png", dpi=2 * PX_PER_INCH, metadata={"Software": None})


def plot_of(front: Front, points: Points, canvas: Canvas) -> Plot:
    """Draw one front: quality up, cost to the right, a mark for each point that has both.

    Args:
        front: which two figures, and which points are on it.
        points: all of the study, with their looks.
        canvas: the size; it grows in height below a long legend.
    """
    titles = {anchor: _title(front, row, points) for anchor, row in points.on(front)}
    front, rows = pressed(front, points, [row for _, row in points.on(front)])
    shown = list(zip(titles, rows, strict=True))
    legend = legend_of(points, rows, canvas.width)
    legend_px = max((entry.y for entry in legend), default=0.0) + ROW_PX / 2
    height = max(canvas.height, TOP_PX + LEAST_PX + BELOW_PX + math.ceil(legend_px))
    canvas = replace(canvas, height=height)
    frame = (LEFT_PX, TOP_PX, canvas.width - RIGHT_PX, height - BELOW_PX - legend_px)
    with look():
        figure = new_figure(canvas.width, height)
        parts = _draw_legend(figure, legend, height - legend_px, canvas)
        axes = _make_axes(figure, front, rows, frame, canvas)
        stairs = _draw_front(axes, front, rows)
        _draw_intervals(axes, front, points, rows)
        _draw_level(axes, front, points)
        for anchor, row in shown:
            line = points.mark(row).line(state := state_of(front, row.name), *_values(front, row))
            line.set(gid=anchor, clip_on=False, zorder=4 + RADIUS_PX[state])
            axes.add_line(line)
            if OFF in row.text:
                axes.plot(
                    value_of(row, front.x), axes.get_ylim()[0], marker=CARETDOWN, color=LIGHT["ink"], clip_on=False
                )
        places = {anchor: _pixels(axes, [_values(front, row)], canvas)[0] for anchor, row in shown}
        boxes = [_covered(places[anchor], state_of(front, row.name)) for anchor, row in shown]
        better = (frame[0], frame[1], frame[0] + text_width(BETTER) + 12, frame[1] + 26)
        lines = [*_thin(_pixels(axes, stairs, canvas)), *_bars(axes, front, rows, canvas)]
        wishes = wishes_of(front, [(row, places[anchor]) for anchor, row in shown], canvas)
        labels = place(wishes, [better, *boxes], lines, frame, LABEL_PX)
        _write(figure, 12, 21, f"{front.y} against {front.x}", canvas, size=TITLE_PX, weight="bold")
        _write(figure, frame[0] + 8, frame[1] + 18, BETTER, canvas, color=LIGHT["soft"])
        for label in labels:
            _draw_label(figure, label, canvas)
    return Plot(front, figure, frame, places, boxes, labels, titles, parts)


def _values(front: Front, row: Row) -> tuple[float, float]:
    return value_of(row, front.x), value_of(row, front.y)


OFF = "off the scale"
"""The word of a row whose mark stands at the lower edge, with its value."""
PRESSED = 0.12
"""How far below the others such marks stand, as a share of what those span."""


def pressed(front: Front, points: Points, rows: Sequence[Row]) -> tuple[Front, list[Row]]:
    """The front and its rows with poor outliers moved to the lower edge: else a few would press all others together.

    Poor is what lies below Tukey's lower fence (Exploratory Data Analysis, 1977), 1.5 interquartile ranges below the
    lower quartile, and below the point that all are held against, by more than a quarter of its own distance from
    the best.
    """
    sign = DIRECTIONS[front.y]
    good = {row.name: sign * value_of(row, front.y) for row in rows}
    low, high = np.percentile(list(good.values()), (25, 75)) if good else (0.0, 0.0)
    held, best = good.get(points.against, np.inf), max(good.values(), default=0.0)
    fence = min(low - 1.5 * (high - low), held - max(best - held, 0.0) / 4)
    inside = [each for each in good.values() if each >= fence]
    if high == low or len(inside) == len(good):
        return front, list(rows)
    edge = sign * float(min(inside) - PRESSED * (max(inside) - min(inside)))
    kept = {name: each for name, each in front.differences.items() if good[name] >= fence}
    found = [row if good[row.name] >= fence else _moved(row, front.y, edge) for row in rows]
    return replace(front, differences=kept), found


def _moved(row: Row, key: str, value: float) -> Row:
    figure = row.figures[key]
    figures = {**row.figures, key: replace(figure, value=value, interval=None)}
    return replace(row, figures=figures, text={**row.text, OFF: figure_words(replace(figure, interval=None))})


def _title(front: Front, row: Row, points: Points) -> str:
    said = [f"{key} {figure_words(row.figures[key])}, {row.figures[key].mode}" for key in (front.y, front.x)]
    before, held = front.differences.get(row.name), points.differences.get(row.name)
    if before:
        said.append(f"{front.y} less that of {before.against}: {figure_words(before.figure)}")
    if held and row.name != points.against:
        said.append(f"{front.y} less that of {points.against}: {figure_words(held.figures[f'{front.y} difference'])}")
    dominated = f"dominated by {front.dominated[row.name]}" if row.name in front.dominated else ""
    return "\n".join(line for line in (row.name, *said, dominated) if line)


def _draw_legend(figure: Figure, legend: Sequence[Entry], top_px: float, canvas: Canvas) -> list[Box]:
    """Returns what its parts cover."""
    for entry in legend:
        line = entry.mark.line(entry.state, entry.x / canvas.width, 1 - (top_px + entry.y) / canvas.height)
        line.set_transform(figure.transFigure)
        figure.add_artist(line)
        _write(figure, entry.x + WORDS_PX, top_px + entry.y + 4.5, entry.text, canvas, size=LABEL_PX, gid="legend")
    reach = ROW_PX / 2
    return [
        (e.x - reach, top_px + e.y - reach, e.x + WORDS_PX + text_width(e.text, LABEL_PX), top_px + e.y + reach)
        for e in legend
    ]


MARGIN, REACH = 0.07, 0.5
"""Shares of the values' range: left free around them; at most shown beyond them of intervals."""


def _make_axes(figure: Figure, front: Front, rows: Sequence[Row], frame: Box, canvas: Canvas) -> Axes:
    left, top, right, bottom = frame
    width, height = canvas.width, canvas.height
    axes = figure.add_axes((left / width, 1 - bottom / height, (right - left) / width, (bottom - top) / height))
    y_limits = _limits(rows, front, front.y, logarithmic=False)
    axes.set(xscale="log", xlim=_limits(rows, front, front.x, logarithmic=True))
    axes.set(ylim=y_limits if DIRECTIONS[front.y] > 0 else y_limits[::-1])  # good is up, whichever way it runs
    axes.set(xlabel=_axis_title(front.x, rows), ylabel=_axis_title(front.y, rows))
    axes.yaxis.set_label_coords(-(left - 22) / (right - left), 0.5)
    set_ticks(axes.xaxis, int((right - left) / TICK_PX[0]))
    set_ticks(axes.yaxis, int((bottom - top) / TICK_PX[1]))
    return axes


def _limits(rows: Sequence[Row], front: Front, key: str, *, logarithmic: bool) -> tuple[float, float]:
    """They hold all values, and the bars of the front's members as far as they do not squeeze the values."""
    forth, back = (math.log, math.exp) if logarithmic else (float, float)
    values = [forth(value_of(row, key)) for row in rows] or [0.0, 1.0]
    members = [_bar(front, row, key) for row in rows if row.name in front.members]
    ends = [forth(end) for bar in members if bar for end in bar if end > 0 or not logarithmic]
    low, high = min(values), max(values)
    span = high - low or max(abs(high), 1.0)
    inner, outer = ((low - share * span, high + share * span) for share in (MARGIN, REACH))
    return back(max(outer[0], min([*ends, inner[0]]))), back(min(outer[1], max([*ends, inner[1]])))


def _axis_title(key: str, rows: Sequence[Row]) -> str:
    modes = " and ".join(dict.fromkeys(row.figures[key].mode for row in rows))
    unit = next((row.figures[key].unit for row in rows), "")
    return f"{key}, {unit} ({modes})" if rows else key


def _draw_front(axes: Axes, front: Front, rows: Sequence[Row]) -> list[tuple[float, float]]:
    """The best quality for each cost, from the bottom at the cheapest member to the right edge; its corners."""
    members = sorted(_values(front, row) for row in rows if row.name in front.members)
    if not members:
        return []
    right, bottom = axes.get_xlim()[1], axes.get_ylim()[0]
    stairs = [(members[0][0], bottom), members[0]]
    for (_, before), (x, y) in pairwise(members):
        stairs += [(x, before), (x, y)]
    stairs.append((right, members[-1][1]))
    axes.fill(*zip(*stairs, (right, bottom), strict=True), color=LIGHT["reached"], linewidth=0, zorder=0)
    axes.plot(*zip(*stairs, strict=True), color=LIGHT["ink"], linewidth=1.6, zorder=3, gid="front", clip_on=False)
    return stairs


BAR, PALE_BAR = 0.75, 0.16
"""Opacity of an interval, and of that of a point off the front."""


def _draw_intervals(axes: Axes, front: Front, points: Points, rows: Sequence[Row]) -> None:
    segments, colours = [], []
    for row in rows:
        for ends in _intervals(axes, front, row):
            segments.append(ends)
            colours.append(to_rgba(LIGHT[points.mark(row).colour], BAR if row.name in front.members else PALE_BAR))
    axes.add_collection(LineCollection(segments, colors=colours, linewidths=1.4, zorder=2), autolim=False)


def _bar(front: Front, row: Row, key: str) -> tuple[float, float] | None:
    """What a bar covers: a cost's own interval; of a quality that of the paired difference, about the value."""
    if key == front.x:
        return row.figures[key].interval
    before = front.differences.get(row.name)
    if before is None or before.figure.interval is None:
        return None
    level = value_of(row, key) - (before.figure.value or 0.0)
    return level + before.figure.interval[0], level + before.figure.interval[1]


def _intervals(axes: Axes, front: Front, row: Row) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
    """Both ends of both bars; one that goes on beyond the axes ends at their edge."""
    (x, y), (across, up) = _values(front, row), (_bar(front, row, key) for key in (front.x, front.y))
    if across:
        low, high = _within(across, axes.get_xlim())
        yield (low, y), (high, y)
    if up:
        low, high = _within(up, axes.get_ylim())
        yield (x, low), (x, high)


def _draw_level(axes: Axes, front: Front, points: Points) -> None:
    """A dotted line at the quality of the point that all are held against, where it lies within the axes."""
    found = [row.figures[front.y].value for row in points.rows if row.name == points.against]
    low, high = sorted(axes.get_ylim())
    for value in found:
        if value is not None and low < value < high:
            axes.axhline(value, color=LIGHT["soft"], linewidth=1.2, linestyle=(0, (1, 3)), zorder=1, gid="against")


def _within(ends: tuple[float, float], limits: tuple[float, float]) -> list[float]:
    low, high = sorted(limits)
    return [min(max(end, low), high) for end in ends]


def _pixels(axes: Axes, places: Sequence[tuple[float, float]], canvas: Canvas) -> list[tuple[float, float]]:
    """Places on the canvas of values."""
    return [(float(x), float(canvas.height - y)) for x, y in axes.transData.transform(places)] if places else []


def _covered(at: tuple[float, float], state: State) -> Box:
    """What a mark covers."""
    reach = 1.45 * RADIUS_PX[state] + 1
    return at[0] - reach, at[1] - reach, at[0] + reach, at[1] + reach


def _bars(axes: Axes, front: Front, rows: Sequence[Row], canvas: Canvas) -> Iterator[Box]:
    """What the intervals of the front's members cover."""
    for row in rows:
        for ends in _intervals(axes, front, row) if row.name in front.members else ():
            yield from _thin(_pixels(axes, ends, canvas))


def _thin(line: Sequence[tuple[float, float]]) -> list[Box]:
    """The steps of a line as boxes."""
    return [(min(a, c), min(b, d), max(a, c) + 1, max(b, d) + 1) for (a, b), (c, d) in pairwise(line)]


LABEL_LINES = 3


def wishes_of(front: Front, shown: Sequence[tuple[Row, tuple[float, float]]], canvas: Canvas) -> list[Wish]:
    """Names of the front's steps, best first; then of the best point of each other method, where there is room.

    Args:
        front: what is plotted.
        shown: its points, each with its place in pixels.
        canvas: what it is plotted on.
    """
    by_quality = sorted(shown, key=lambda each: -DIRECTIONS[front.y] * value_of(each[0], front.y))
    named = {method_of(row) for row, _ in shown if row.name in front.members}
    best = {method_of(row): (row, at) for row, at in reversed(by_quality) if method_of(row) not in named}
    steps = [each for each in by_quality if each[0].name in front.steps]
    wanted = [*steps, *sorted(best.values(), key=lambda each: each[1][1])]
    heads = Counter(_head(row.name) for row, _ in wanted)
    return [
        Wish(*at, _lines(row, canvas, heads[_head(row.name)] == 1), row.name in front.members) for row, at in wanted
    ]


def _head(name: str) -> str:
    return name.partition(", ")[0]


def _lines(row: Row, canvas: Canvas, alone: bool) -> tuple[str, ...]:
    """A name in a few lines, a new one after its first comma; brief where that is enough to tell it by."""
    parts = [_head(row.name)] if canvas.brief and alone else row.name.split(", ", 1)
    lines = [line for part in parts for line in textwrap.wrap(part, canvas.letters)] or [""]
    if len(lines) > LABEL_LINES:
        lines[LABEL_LINES - 1] = lines[LABEL_LINES - 1][: canvas.letters - 1] + "\u2026"
    beyond = [f"{row.text[OFF]}, {OFF}"] if OFF in row.text else []
    return (*lines[:LABEL_LINES], *beyond)


def _draw_label(figure: Figure, label: Label, canvas: Canvas) -> None:
    if label.leader:
        ends = [(x / canvas.width, 1 - y / canvas.height) for x, y in (label.leader, (label.wish.x, label.wish.y))]
        leader = Line2D(*zip(*ends, strict=True), color=LIGHT["soft"], linewidth=1, transform=figure.transFigure)
        figure.axes[0].add_line(leader)
        leader.set_clip_on(False)
    for y, text in zip(label.baselines, label.wish.lines, strict=True):
        _write(figure, label.text_x, y, text, canvas, ha=label.alignment, size=LABEL_PX, gid="label")


def _write(figure: Figure, x: float, y: float, text: str, canvas: Canvas, **style: object) -> None:
    """A line of text; (x, y) is its baseline's start, or what `ha` says, in pixels."""
    figure.text(x / canvas.width, 1 - y / canvas.height, text, **style)  # type: ignore[arg-type] # matplotlib's own
