"""Lays out the plot of a front: quality upwards, cost to the right on a logarithmic axis, the best top left."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

from deploy.report.axes import Axis, padded
from deploy.report.labels import Box, place, text_width
from deploy.report.legend import legend_of
from deploy.report.plot import FONT_PX, LABEL_PX, Dot, Plot
from deploy.report.tradeoff_names import Canvas, wishes_of
from deploy.report.tradeoff_points import RISING, Points, state_of
from deploy.results import Row, number
from deploy.tradeoff.study import Front

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
