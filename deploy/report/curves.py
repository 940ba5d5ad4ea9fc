"""Curves side by side: panels that share the axis upwards, each with a logarithmic axis of its own to the right."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from deploy.report.axes import Axis, padded
from deploy.report.labels import text_width
from deploy.report.page import templates
from deploy.report.plot import FONT_PX
from deploy.report.plot_svg import plot_style
from profiles.figures import number

Points = tuple[tuple[float, float], ...]

WIDTH_PX, TOP_PX, PANEL_PX, BELOW_PX = 960, 40, 250, 80
LEFT_PX, GAP_PX, RIGHT_PX, LEGEND_GAP_PX = 62, 26, 14, 58
MARGIN = 0.06


@dataclass(frozen=True)
class Curve:
    """Points (x, y) with x above 0; curves of one name look alike in all panels."""

    name: str
    colour: int
    dashed: bool
    points: Points


@dataclass(frozen=True)
class Panel:
    """Some curves under a title."""

    title: str
    curves: Sequence[Curve]


@dataclass(frozen=True)
class _Placed:
    """A panel in pixels."""

    title: str
    left: float
    right: float
    x_ticks: Sequence[tuple[float, str]]
    lines: Sequence[Curve]


def curves_svg(panels: Sequence[Panel], x_title: str, y_title: str) -> str:
    """A picture of its own, light or dark as its reader's screen is."""
    heights = [y for panel in panels for curve in panel.curves for _, y in curve.points]
    bottom = TOP_PX + PANEL_PX
    y_axis = Axis(*padded(min(heights), max(heights), MARGIN, logarithmic=False), bottom, TOP_PX, logarithmic=False)
    return (
        templates()
        .get_template("curves.svg")
        .render(
            size=(WIDTH_PX, bottom + BELOW_PX),
            top=TOP_PX,
            bottom=bottom,
            x_title=x_title,
            y_title=y_title,
            y_ticks=_ticks(y_axis, 8),
            panels=list(_placed(panels, y_axis)),
            legend=list(_legend(panels)),
            style=plot_style(),
        )
    )


def _placed(panels: Sequence[Panel], y_axis: Axis) -> Iterator[_Placed]:
    wide = (WIDTH_PX - LEFT_PX - RIGHT_PX - GAP_PX * (len(panels) - 1)) / len(panels)
    for number_, panel in enumerate(panels):
        left = LEFT_PX + number_ * (wide + GAP_PX)
        places = [x for curve in panel.curves for x, _ in curve.points]
        ends = padded(min(places), max(places), MARGIN, logarithmic=True)
        x_axis = Axis(*ends, left, left + wide, logarithmic=True)
        lines = [
            replace(curve, points=tuple((x_axis.place(x), y_axis.place(y)) for x, y in curve.points))
            for curve in panel.curves
        ]
        yield _Placed(panel.title, left, left + wide, _ticks(x_axis, 5), lines)


def _ticks(axis: Axis, most: int) -> list[tuple[float, str]]:
    return [(axis.place(tick), number(tick, 12)) for tick in axis.ticks(most)]


def _legend(panels: Sequence[Panel]) -> Iterator[tuple[float, Curve]]:
    """Each name once, from left to right."""
    x = float(LEFT_PX)
    for name, curve in {curve.name: curve for panel in panels for curve in panel.curves}.items():
        yield x, curve
        x += text_width(name, FONT_PX) + LEGEND_GAP_PX
