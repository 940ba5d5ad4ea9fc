"""What a study found, and its page: the recommended line, the plot with its front, and a table of all points."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from markupsafe import Markup

from beers_deploy.model.io.files import write_text
from beers_deploy.model.traditional.peers import PEERS
from beers_deploy.profiles.errors import optional
from beers_deploy.profiles.figures import Row
from beers_deploy.report.page import Picture, Report, Section, write_report
from beers_deploy.report.plots import LIGHT, SERIES, data_url, look, new_figure, set_ticks, svg_of
from beers_deploy.results import Table
from beers_deploy.studies.tradeoff.advice import PSNR, Measured, ends, placed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FILES = ("tradeoff.html", "tradeoff.svg")

SIZE_PX, TEXT_PX = (560, 520), 15
"""Of the plot: wide enough for a desk, and its words large enough on a telephone, where it is scaled down."""
FRONT_PX2, OTHERS_PX2 = 90, 34
"""Areas of marks."""
NEAR_PX = 16
"""Marks no farther apart share a label."""
PALE = 0.45
MARKERS = ("o", "s", "D", "^", "v", "P", "X")
CHAINS, LIBRARIES = "traditional pipelines", "other libraries"
SHOWN_WORDS = ("board", "configuration", "tile", "halo", "sensor")

FRONT_CAPTION = (
    "No point of the first board is both cheaper and better than one of these. A gain is the difference in PSNR on "
    "the same images from the next cheaper point, a ratio the cost over that of the same point."
)
POINTS_CAPTION = (
    "Press a heading to sort by it, again to reverse. A swath on a board is predicted; images and times on this "
    "machine are measured."
)
PLOT_CAPTION = (
    "Numbers are those of the front's table; the line is the front, small marks lie below it. Upright bars: 95 % "
    "interval of the difference in PSNR from the next cheaper point of the front. Bars across: interval of the cost."
)


@dataclass(frozen=True, repr=False, kw_only=True)
class Tradeoff(Table):
    """What accuracy costs in time: the recommended point, the Pareto front, and every point with its figures.

    Attributes:
        board: the first one, which the front and the recommendation are about.
        points: all of them, in the order networks, chains, other libraries, the paper's runs.
        front: those of the first board on the Pareto front, from cheap to dear.
        front_rows: the same by number, each with its difference from the next cheaper one.
        cost: the figure that the front is against.
        best: the recommended point; None where none keeps the budget and the need.
        line: that recommends it.
    """

    board: str
    points: Sequence[Measured]
    front: Sequence[Measured]
    front_rows: Sequence[Row]
    cost: str
    best: Measured | None
    line: str

    def plot(self, figure: str | None = None, ax: "Axes | None" = None) -> "Axes":
        """PSNR of every point of the first board against its cost, the front's numbered.

        Args:
            figure: given, bars of that figure instead, as of any table.
            ax: axes of matplotlib to draw on; new ones if None.
        """
        if figure is not None:
            return super().plot(figure, ax)
        axes = ax if ax is not None else optional("matplotlib.pyplot", "plot").subplots()[1]
        draw_study(axes, self)
        return cast("Axes", axes)

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write the page and its plot into a folder; returns the page's path."""
        svg = plot_svg(self)
        page, plot = (Path(folder) / name for name in FILES)
        write_text(plot, svg)
        write_report(report_of(self, svg), page)
        return page

    def __str__(self) -> str:
        return self.line


def report_of(study: Tradeoff, svg: str) -> Report:
    """The page in reading order."""
    picture = Picture(f"{PSNR} against {study.cost}", data_url(svg), PLOT_CAPTION)
    points = [
        Row("points", each.name, each.figures, {word: each.text.get(word, "") for word in SHOWN_WORDS})
        for each in study.points
    ]
    tables = [
        Section("The front, from cheap to dear", study.front_rows, FRONT_CAPTION),
        Section(f"All {len(points)} points", points, POINTS_CAPTION),
    ]
    headline = f"{study.line[0].upper()}{study.line[1:]}."
    return Report("What accuracy costs in time", headline, tables, [picture], study.notes, sorts=True)


def plot_svg(study: Tradeoff) -> Markup:
    """Every point of the first board that has a cost and a PSNR; those of the front large, with their numbers."""
    from matplotlib import rc_context

    with look(), rc_context({"font.size": TEXT_PX}):
        figure = new_figure(*SIZE_PX)
        axes = figure.add_subplot()
        draw_study(axes, study)
        names = axes.get_legend_handles_labels()[1]
        if names:
            figure.legend(loc="lower center", ncols=2)
        figure.subplots_adjust(left=0.13, right=0.97, top=0.97, bottom=0.13 + 0.045 * -(-len(names) // 2))
        _draw_numbers(axes, study)
        return svg_of(figure, f"{PSNR} against {study.cost}; numbers as in the table of the front")


def draw_study(axes: "Axes", study: Tradeoff) -> None:
    """Draw the points of the first board and their front on axes; their numbers are left to whoever sizes these."""
    boards = (study.board, "this machine")
    points = [point for point in placed(study.points, study.cost) if point.text["board"] in boards]
    axes.set(xscale="log", xlabel=_label(study, study.cost), ylabel=_label(study, PSNR))
    for name, colour, marker, members in series(points):
        for large in (False, True):  # the front's last, so that they lie on top
            x, y = _places([point for point in members if (point in study.front) == large], study.cost)
            size, alpha, label = (FRONT_PX2, 1.0, name) if large else (OTHERS_PX2, PALE, None)
            style: dict[str, Any] = {"c": colour, "marker": marker, "alpha": alpha, "zorder": 2 + large}
            axes.scatter(x, y, s=size, label=label, linewidths=0, **style)
    _draw_front(axes, study)
    axes.margins(0.1)
    if points:
        set_ticks(axes.xaxis, 6)
        set_ticks(axes.yaxis, 8)


def _places(points: Sequence[Measured], cost: str) -> tuple[list[float], list[float]]:
    return [point.value(cost) for point in points], [point.value(PSNR) for point in points]


def series(points: Sequence[Measured]) -> Iterator[tuple[str, str, str, list[Measured]]]:
    """Points that look alike: name, colour and marker of each network, of the chains, and of other libraries."""
    groups: dict[str, list[Measured]] = {}
    for point in points:
        network = point.point is not None and point.point.variant.file is not None
        others = LIBRARIES if point.text["method"] in PEERS else CHAINS
        groups.setdefault(point.text["method"] if network else others, []).append(point)
    for number, (name, members) in enumerate(groups.items()):
        yield name, LIGHT[SERIES[number % len(SERIES)]], MARKERS[number % len(MARKERS)], members


def _draw_front(axes: "Axes", study: Tradeoff) -> None:
    axes.step(*_places(study.front, study.cost), where="post", color=LIGHT["soft"], lw=1, zorder=1)
    for point, row in zip(study.front, study.front_rows, strict=True):
        x, y = point.value(study.cost), point.value(PSNR)
        axes.plot(ends(point.figures[study.cost]), [y, y], color=LIGHT["line"], lw=2, zorder=0)
        gain = row.figures.get("PSNR gain")
        if gain is not None and gain.interval is not None:
            before = y - (gain.value or 0.0)
            axes.plot([x, x], [before + end for end in gain.interval], color=LIGHT["soft"], lw=1.5, zorder=1)


def _draw_numbers(axes: "Axes", study: Tradeoff) -> None:
    """The members' numbers beside their marks; one label for neighbours whose marks lie on one another."""
    groups: list[tuple[int, int, np.ndarray]] = []
    for number, point in enumerate(study.front, 1):
        at = axes.transData.transform((point.value(study.cost), point.value(PSNR)))
        if groups and np.hypot(*(at - groups[-1][2])) < NEAR_PX:
            groups[-1] = (groups[-1][0], number, groups[-1][2])
        else:
            groups.append((number, number, at))
    for first, last, at in groups:
        words = str(first) if first == last else f"{first}\u2013{last}"
        axes.annotate(words, (at[0], at[1]), (-4, 7), "figure pixels", "offset points", ha="right", weight="bold")


def _label(study: Tradeoff, key: str) -> str:
    figure = next((point.figures[key] for point in study.points if key in point.figures), None)
    where = f" on {study.board}" if key.startswith("board") else ""
    return f"{key}{where}, {figure.unit}" if figure else key
