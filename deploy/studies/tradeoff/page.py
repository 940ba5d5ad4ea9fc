"""The result of a study, its plot, and its page: the recommended line, the plot with its front,
boards, and all points.
"""

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from markupsafe import Markup

from beers_deploy.model.io.files import write_text
from beers_deploy.model.traditional.baselines import BASELINES
from beers_deploy.performance.swath import interval_ends
from beers_deploy.profiles.errors import optional
from beers_deploy.profiles.figures import Row
from beers_deploy.report.page import Picture, Report, Section, write_report
from beers_deploy.report.plots import (
    LIGHT,
    SERIES,
    data_url,
    look,
    new_figure,
    set_ticks,
    svg_of,
)
from beers_deploy.results import Table
from beers_deploy.studies.tradeoff.advice import Constraint, with_unit
from beers_deploy.studies.tradeoff.front import BOARDS, FRONT, PSNR, Measured, placed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILES = ("tradeoff.html", "tradeoff.svg")

SHOWN_WORDS = ("board", "configuration", "tile", "halo", "sensor")

BOARDS_CAPTION = (
    "The best point of each board within the budget, chosen as the recommended one is, or why no "
    "point of that board keeps the limits. The difference in PSNR is on the same images."
)
FRONT_CAPTION = (
    "Of the points on all boards that keep the budget's other limits, none is both cheaper and "
    "better than one of these. A gain is the difference in PSNR on the same images from the next "
    "cheaper point, a ratio the cost over that of the same point."
)
POINTS_CAPTION = (
    "Press a heading to sort by it, again to reverse. A swath on a board is predicted; images and "
    "times on this machine are measured."
)

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
PIPELINES = "traditional pipelines"
LIBRARIES = "other libraries"
HOST = "this machine"
LEGEND_COLUMNS = 2

CAPTION = (
    "Numbers are those of the front's table; the line is the front, small marks lie below it. The "
    "ring is around the recommended point, dashed lines are the limits of budget and need. Upright "
    "bars: 95 % interval of the gain in PSNR over the next cheaper point of the front. Bars "
    "across: interval of the cost."
)


@dataclass(frozen=True, repr=False, kw_only=True)
class Tradeoff(Table):
    """The result of the study of accuracy against time: the recommended point, the Pareto front,
    and every point with its figures. Its truth value is True if a point meets all constraints.

    Attributes:
        boards: the names of all boards that were compared.
        points: all operating points (a method on a device, with its tiles), in the order networks,
            traditional pipelines, other libraries, the paper's published runs.
        front: the points for which no other is both cheaper and better, over all boards, sorted by
            increasing cost.
        constraints: the user's limits of budget and need.
        cost: the name of the figure that quality is traded against, such as "board latency".
        best: the recommended point; None if no point complies with the constraints.
        line: the sentence that states the recommendation.
        remarks: sentences on how the figures were measured.
    """

    boards: Sequence[str]
    points: Sequence[Measured]
    front: Sequence[Measured]
    constraints: Sequence[Constraint]
    cost: str
    best: Measured | None
    line: str
    remarks: Sequence[str]

    @property
    def front_rows(self) -> list[Row]:
        """The rows of the front, numbered from the cheapest point, each with its gain in PSNR over
        the next cheaper one.
        """
        return [row for row in self.rows if row.table.startswith(FRONT)]

    @property
    def board_rows(self) -> list[Row]:
        """The rows of the boards, each with the board's best point within the constraints, or the
        reason why it has none.
        """
        return [row for row in self.rows if row.table == BOARDS]

    @property
    def board(self) -> str:
        """The name of the board of the recommended point; the first board if no point is
        recommended or the point runs on this machine.
        """
        # A point of this machine alone has no board among those that were compared.
        name = self.best.text["board"] if self.best else ""
        return name if name in self.boards else self.boards[0]

    def plot(self, figure: str | None = None, ax: "Axes | None" = None) -> "Axes":
        """Plot PSNR of every point against its cost, with the front, the recommended point and the
        budget.

        Args:
            figure: the name of a figure of which bars are drawn instead, as for any table; None
                draws the plot of PSNR against cost.
            ax: axes of matplotlib to draw on; None makes new ones.

        Returns:
            The axes.
        """
        if figure is not None:
            return super().plot(figure, ax)
        axes = ax if ax is not None else optional("matplotlib.pyplot", "plot").subplots()[1]
        draw(axes, self)
        return cast("Axes", axes)

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write tradeoff.html and tradeoff.svg into a folder, and return the path of the page."""
        svg = plot_svg(self)
        page, plot = (Path(folder) / name for name in FILES)
        write_text(plot, svg)
        write_report(report_of(self, svg), page)
        return page


def report_of(study: Tradeoff, svg: str) -> Report:
    """Arrange the result of a study as a page: recommendation, plot, boards, front and all points.

    Args:
        study: the result.
        svg: the plot, as `plot_svg` returns it.
    """
    picture = Picture(f"{PSNR} against {study.cost}", data_url(svg), CAPTION)
    points = []
    for point in study.points:
        words = {word: point.text.get(word, "") for word in SHOWN_WORDS}
        points.append(Row("points", point.name, point.figures, words))
    tables = [
        Section("Board by board", study.board_rows, BOARDS_CAPTION),
        Section("The front, from cheap to expensive", study.front_rows, FRONT_CAPTION),
        Section(f"All {len(points)} points", points, POINTS_CAPTION),
    ]
    headline = f"{study.line[0].upper()}{study.line[1:]}."
    return Report(
        "What accuracy costs in time", headline, tables, [picture], study.remarks, sorts=True
    )


class Series(NamedTuple):
    """The points of a plot that share one colour and marker.

    Attributes:
        name: the network, `PIPELINES` for all traditional pipelines, or `LIBRARIES` for all methods
            of other libraries.
        board: the board that the points run on, or `HOST`.
        colour: the colour of the marks, as matplotlib accepts it.
        marker: the shape of the marks, as matplotlib accepts it.
        points: the operating points.
    """

    name: str
    board: str
    colour: str
    marker: str
    points: Sequence[Measured]


def plot_svg(study: Tradeoff) -> Markup:
    """Draw PSNR against cost, and return the text of an SVG file. The points of the front have the
    numbers of its table.
    """
    with look():
        return svg_of(
            figure_of(study), f"{PSNR} against {study.cost}; numbers as in the table of the front"
        )


def figure_of(study: Tradeoff) -> "Figure":
    """Draw PSNR against cost on a new figure of matplotlib. Call this within the context `look`,
    which sets the style.
    """
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
        x, y = _places(study.front, study.cost)
        places_px = axes.transData.transform(np.column_stack([x, y]))
        first = 0
        for number in range(1, len(x) + 1):
            # Neighbours whose marks overlap share a label.
            if number < len(x) and math.dist(places_px[number], places_px[first]) < NEAR_PX:
                continue
            words = str(number) if number == first + 1 else f"{first + 1}\u2013{number}"
            at = x[first], y[first]
            axes.annotate(words, at, (-8, 9), "data", "offset points", ha="right", weight="bold")
            first = number
    return figure


def draw(axes: "Axes", study: Tradeoff) -> None:
    """Draw points, front, limits and the recommended point on axes of matplotlib. The numbers of
    the front are left to `figure_of`, because their places depend on the size of the axes.
    """
    axes.set(xscale="log", xlabel=_label(study, study.cost), ylabel=_label(study, PSNR))
    groups = list(series(study))
    for group in groups:
        # The front's marks come last, so that they lie on top.
        points = sorted(group.points, key=lambda point: point in study.front)
        large = [point in study.front for point in points]
        style: dict[str, Any] = {"alpha": np.where(large, 1.0, PALE), "marker": group.marker}
        sizes = np.where(large, FRONT_PX2, OTHERS_PX2)
        x, y = _places(points, study.cost)
        axes.scatter(x, y, sizes, group.colour, linewidths=0, zorder=2, **style)
    _draw_front(axes, study)
    # The points set the range: a limit outside must not widen it.
    axes.margins(0.1)
    axes.autoscale_view()
    _draw_limits(axes, study)
    if study.best is not None:
        x, y = _places([study.best], study.cost)
        ring: dict[str, Any] = {"facecolors": "none", "edgecolors": LIGHT["ink"], "linewidths": 1.8}
        axes.scatter(x, y, s=RING_PX2, label="recommended", zorder=4, **ring)
    # The entries of the legend are marks without a point: networks by colour, and boards by marker.
    several = len(study.boards) > 1
    networks = {
        group.name: (group.colour, MARKERS[0] if several else group.marker) for group in groups
    }
    boards = {group.board: (LIGHT["soft"], group.marker) for group in groups} if several else {}
    for name, (colour, marker) in (*networks.items(), *sorted(boards.items())):
        axes.scatter([], [], s=FRONT_PX2, c=colour, marker=marker, label=name, linewidths=0)
    if groups:
        set_ticks(axes.xaxis, 6)
        set_ticks(axes.yaxis, 8)


def series(study: Tradeoff) -> Iterator[Series]:
    """Yield the points of a study that can be plotted, grouped by colour and marker.

    Each network has a colour. Each board has a marker, or each network if there is one board.
    """
    names: dict[str, int] = {}
    groups: dict[tuple[str, str], list[Measured]] = {}
    for point in placed(study.points, study.cost):
        name = point.text["method"]
        if point.point is None or point.point.variant.network is None:
            name = LIBRARIES if name in BASELINES else PIPELINES
        names.setdefault(name, len(names))
        groups.setdefault((name, point.text["board"]), []).append(point)
    # By the order of names, so that a board has one marker however the boards were listed.
    places = [HOST, *sorted(study.boards)]
    for (name, board), members in groups.items():
        colour = LIGHT[SERIES[names[name] % len(SERIES)]]
        number = names[name] if len(study.boards) == 1 else places.index(board)
        yield Series(name, board, colour, MARKERS[number % len(MARKERS)], members)


def _places(points: Sequence[Measured], cost: str) -> tuple[list[float], list[float]]:
    return [point.value(cost) for point in points], [point.value(PSNR) for point in points]


def _draw_front(axes: "Axes", study: Tradeoff) -> None:
    # Between two points of the front the cheaper one is the best that can be had.
    axes.step(*_places(study.front, study.cost), where="post", color=LIGHT["soft"], lw=1, zorder=1)
    for point, row in zip(study.front, study.front_rows, strict=True):
        x = point.value(study.cost)
        y = point.value(PSNR)
        cost = interval_ends(point.figures[study.cost])
        axes.plot(cost, [y, y], color=LIGHT["line"], lw=2, zorder=0)
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


def _draw_limits(axes: "Axes", study: Tradeoff) -> None:
    """Draw the limits on cost and PSNR as dashed lines with their text. The axes retain their range
    if a limit is outside.

    A limit on another figure, such as power, has no place in the plot.
    """
    low, high = axes.get_xlim()
    style: dict[str, Any] = {"color": LIGHT["ink"], "lw": 1.2, "ls": "--", "zorder": 1}
    for limit in study.constraints:
        if limit.key == study.cost and low <= limit.limit <= high:
            axes.axvline(limit.limit, **style)
            sign = "\N{LESS-THAN OR EQUAL TO}" if limit.at_most else "\N{GREATER-THAN OR EQUAL TO}"
            # The axis is logarithmic, so its middle is the geometric mean of its limits.
            side = "right" if limit.limit > np.sqrt(low * high) else "left"
            place = (limit.limit, 1.01)
            words = f"{sign} {with_unit(f'{limit.limit:g}', limit.unit)}"
            axes.annotate(words, place, xycoords=("data", "axes fraction"), ha=side, va="bottom")
        elif limit.key == PSNR and axes.get_ylim()[0] <= limit.limit <= axes.get_ylim()[1]:
            axes.axhline(limit.limit, **style)


def _label(study: Tradeoff, key: str) -> str:
    figure = next((point.figures[key] for point in study.points if key in point.figures), None)
    where = f" on {study.boards[0]}" if key.startswith("board") and len(study.boards) == 1 else ""
    return f"{key}{where}, {figure.unit}" if figure else key
