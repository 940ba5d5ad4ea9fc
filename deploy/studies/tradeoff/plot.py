"""The plot of a study: PSNR against cost, with the front, the recommended point and the limits."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from markupsafe import Markup

from beers_deploy.model.traditional.peers import PEERS
from beers_deploy.profiles.figures import Row
from beers_deploy.report.plots import LIGHT, SERIES, look, new_figure, set_ticks, svg_of
from beers_deploy.studies.tradeoff.advice import Constraint
from beers_deploy.studies.tradeoff.front import PSNR, Measured, ends, placed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE_PX = (560, 520)
TEXT_PX = 15
"""Size of the plot and of its text. The plot fits a desktop screen, and its text stays legible on a
telephone, where it is scaled down.
"""
FRONT_PX2 = 90
OTHERS_PX2 = 34
RING_PX2 = 330
"""Areas of marks: those of the front, those of other points, and the ring around the recommended
point.
"""
NEAR_PX = 16
"""Marks at most this far apart share a label."""
PALE = 0.45
MARKERS = ("o", "s", "D", "^", "v", "P", "X")
CHAINS = "traditional pipelines"
LIBRARIES = "other libraries"
RECOMMENDED = "recommended"
AT_MOST = "\N{LESS-THAN OR EQUAL TO}"
AT_LEAST = "\N{GREATER-THAN OR EQUAL TO}"
HOST = "this machine"
LEGEND_COLUMNS = 2

CAPTION = (
    "Numbers are those of the front's table; the line is the front, small marks lie below it. The "
    "ring is around the recommended point, dashed lines are the limits of budget and need. Upright "
    "bars: 95 % interval of the gain in PSNR over the next cheaper point of the front. Bars "
    "across: interval of the cost."
)


@dataclass(frozen=True)
class Series:
    """Points of one style: those of one network, of the pipelines, or of other libraries, on one
    board.
    """

    name: str
    board: str
    colour: str
    marker: str
    points: Sequence[Measured]


class Plotted(Protocol):
    """The parts of a trade-off that a plot shows, with the meanings of `page.Tradeoff`."""

    @property
    def boards(self) -> Sequence[str]: ...  # noqa: D102 - see there
    @property
    def points(self) -> Sequence[Measured]: ...  # noqa: D102
    @property
    def front(self) -> Sequence[Measured]: ...  # noqa: D102
    @property
    def front_rows(self) -> Sequence[Row]: ...  # noqa: D102
    @property
    def constraints(self) -> Sequence[Constraint]: ...  # noqa: D102
    @property
    def cost(self) -> str: ...  # noqa: D102
    @property
    def best(self) -> Measured | None: ...  # noqa: D102


def plot_svg(study: Plotted) -> Markup:
    """Return the plot as an SVG file, with the numbers of the front's members."""
    with look():
        return svg_of(
            figure_of(study), f"{PSNR} against {study.cost}; numbers as in the table of the front"
        )


def figure_of(study: Plotted) -> "Figure":
    """Draw the plot. Call this within `look`."""
    from matplotlib import rc_context

    with rc_context({"font.size": TEXT_PX}):
        figure = new_figure(*SIZE_PX)
        # It makes room for labels below the axes, of which the last one is centred on its tick.
        figure.set_layout_engine("constrained")
        axes = figure.add_subplot()
        draw(axes, study)
        if axes.get_legend_handles_labels()[1]:
            figure.legend(loc="outside lower center", ncols=LEGEND_COLUMNS)
        # The distances between marks are known when the axes have their size.
        figure.draw_without_rendering()
        _draw_numbers(axes, study)
    return figure


def draw(axes: "Axes", study: Plotted) -> None:
    """Draw points, front, limits and recommended point. The caller adds the numbers once it has
    sized the axes.
    """
    axes.set(xscale="log", xlabel=_label(study, study.cost), ylabel=_label(study, PSNR))
    groups = list(series(study))
    for group in groups:
        _scatter(axes, group, study)
    _draw_front(axes, study)
    # The points set the range: a limit outside must not widen it.
    axes.margins(0.1)
    axes.autoscale_view()
    _draw_limits(axes, study)
    _draw_best(axes, study)
    _draw_legend(axes, groups, study)
    if groups:
        set_ticks(axes.xaxis, 6)
        set_ticks(axes.yaxis, 8)


def series(study: Plotted) -> Iterator[Series]:
    """Yield the points by style: a colour for each network, and for several boards a marker for
    each.
    """
    names: dict[str, int] = {}
    groups: dict[tuple[str, str], list[Measured]] = {}
    for point in placed(study.points, study.cost):
        name = _kind(point)
        names.setdefault(name, len(names))
        groups.setdefault((name, point.text["board"]), []).append(point)
    # By the order of names, so that a board has one marker however the boards were listed.
    places = {board: number for number, board in enumerate([HOST, *sorted(study.boards)])}
    for (name, board), members in groups.items():
        colour = LIGHT[SERIES[names[name] % len(SERIES)]]
        number = names[name] if len(study.boards) == 1 else places.get(board, 0)
        yield Series(name, board, colour, MARKERS[number % len(MARKERS)], members)


def _kind(point: Measured) -> str:
    if point.point is not None and point.point.variant.network is not None:
        return point.text["method"]
    return LIBRARIES if point.text["method"] in PEERS else CHAINS


def _scatter(axes: "Axes", group: Series, study: Plotted) -> None:
    # The front's marks come last, so that they lie on top.
    for large in (False, True):
        points = [point for point in group.points if (point in study.front) == large]
        x, y = _places(points, study.cost)
        size, alpha = (FRONT_PX2, 1.0) if large else (OTHERS_PX2, PALE)
        style: dict[str, Any] = {
            "c": group.colour,
            "marker": group.marker,
            "alpha": alpha,
            "zorder": 2 + large,
        }
        axes.scatter(x, y, s=size, linewidths=0, **style)


def _places(points: Sequence[Measured], cost: str) -> tuple[list[float], list[float]]:
    return [point.value(cost) for point in points], [point.value(PSNR) for point in points]


def _draw_front(axes: "Axes", study: Plotted) -> None:
    # Between two points of the front the cheaper one is the best that can be had.
    axes.step(*_places(study.front, study.cost), where="post", color=LIGHT["soft"], lw=1, zorder=1)
    for point, row in zip(study.front, study.front_rows, strict=True):
        x = point.value(study.cost)
        y = point.value(PSNR)
        axes.plot(ends(point.figures[study.cost]), [y, y], color=LIGHT["line"], lw=2, zorder=0)
        gain = row.figures.get("PSNR gain")
        if gain is not None and gain.interval is not None:
            before = y - (gain.value or 0.0)
            axes.plot(
                [x, x],
                [before + end for end in gain.interval],
                color=LIGHT["soft"],
                lw=1.5,
                zorder=1,
            )


def _draw_limits(axes: "Axes", study: Plotted) -> None:
    """Draw the limits on cost and PSNR as dashed lines with their text. The axes retain their range
    if a limit is outside.

    A limit on another figure, such as power, has no place in the plot.
    """
    low, high = axes.get_xlim()
    style: dict[str, Any] = {"color": LIGHT["ink"], "lw": 1.2, "ls": "--", "zorder": 1}
    for limit in study.constraints:
        if limit.key == study.cost and low <= limit.limit <= high:
            axes.axvline(limit.limit, **style)
            words = f"{AT_MOST if limit.at_most else AT_LEAST} {limit.in_words(limit.limit)}"
            # The axis is logarithmic, so its middle is the geometric mean of its limits.
            right = limit.limit > np.sqrt(low * high)
            place: dict[str, Any] = {"ha": "right" if right else "left", "va": "bottom"}
            axes.annotate(
                words,
                (limit.limit, 1.0),
                (0, 3),
                ("data", "axes fraction"),
                "offset points",
                **place,
            )
        elif limit.key == PSNR and axes.get_ylim()[0] <= limit.limit <= axes.get_ylim()[1]:
            axes.axhline(limit.limit, **style)


def _draw_best(axes: "Axes", study: Plotted) -> None:
    if study.best is None:
        return
    x, y = _places([study.best], study.cost)
    style: dict[str, Any] = {
        "facecolors": "none",
        "edgecolors": LIGHT["ink"],
        "linewidths": 1.8,
        "zorder": 4,
    }
    axes.scatter(x, y, s=RING_PX2, label=RECOMMENDED, **style)


def _draw_legend(axes: "Axes", groups: Sequence[Series], study: Plotted) -> None:
    """Add the entries of the legend, as marks without a point: networks by colour, and for several
    boards the markers.
    """
    several = len(study.boards) > 1
    networks = {
        group.name: (group.colour, MARKERS[0] if several else group.marker) for group in groups
    }
    boards = {group.board: (LIGHT["soft"], group.marker) for group in groups} if several else {}
    for name, (colour, marker) in (*networks.items(), *sorted(boards.items())):
        axes.scatter([], [], s=FRONT_PX2, c=colour, marker=marker, label=name, linewidths=0)


def _draw_numbers(axes: "Axes", study: Plotted) -> None:
    """Write the members' numbers next to their marks, with one label for neighbours whose marks
    overlap.
    """
    groups: list[tuple[int, int, Measured]] = []
    for number, point in enumerate(study.front, 1):
        if groups and _distance_px(axes, point, groups[-1][2], study.cost) < NEAR_PX:
            groups[-1] = (groups[-1][0], number, groups[-1][2])
        else:
            groups.append((number, number, point))
    for first, last, point in groups:
        words = str(first) if first == last else f"{first}\u2013{last}"
        at = point.value(study.cost), point.value(PSNR)
        axes.annotate(words, at, (-8, 9), "data", "offset points", ha="right", weight="bold")


def _distance_px(axes: "Axes", a: Measured, b: Measured, cost: str) -> float:
    ends_px = axes.transData.transform([(point.value(cost), point.value(PSNR)) for point in (a, b)])
    return float(np.hypot(*(ends_px[1] - ends_px[0])))


def _label(study: Plotted, key: str) -> str:
    figure = next((point.figures[key] for point in study.points if key in point.figures), None)
    where = f" on {study.boards[0]}" if key.startswith("board") and len(study.boards) == 1 else ""
    return f"{key}{where}, {figure.unit}" if figure else key
