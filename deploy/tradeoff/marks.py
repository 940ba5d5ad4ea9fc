"""How points look: a marker and a colour for each method, a filling for each precision, a size for each state."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle

from deploy.report.plots import LIGHT, SERIES
from deploy.tradeoff.study import Front
from profiles.figures import Row

Filling = Literal["full", "left", "bottom", "none"]
FILLINGS: dict[str, Filling] = {"INT8 legal": "full", "INT8 free": "left", "bf16": "bottom", "float32": "none"}
"""How matplotlib fills a marker, by precision."""

MARKERS = ("o", "s", "^", "D", "*", "P", "v", "p", "X", "<", "d", ">", "h")
"""matplotlib's markers that can be filled and distinguished without colour."""

SIDES = {"s": 0.85, "D": 0.8, "*": 1.25}
"""How much smaller or larger than others some of them have to be to look as large."""

Polygon = list[tuple[float, float]]


@dataclass(frozen=True)
class Mark:
    """How a point looks: matplotlib's marker, the name of a colour, and a filling."""

    marker: str
    colour: str
    filling: Filling = "full"

    @property
    def outer(self) -> Polygon:
        """Its outline in a square of side 1 about (0, 0), y downwards."""
        return _polygon(self.marker, "full")

    @property
    def inner(self) -> Polygon:
        """What is painted inside the outline; nothing of a hollow mark."""
        return _polygon(self.marker, self.filling) if self.filling != "none" else []

    def line(self, state: "State", x: float = 0, y: float = 0) -> Line2D:
        """For matplotlib to draw at (x, y), as large as its state asks for."""
        colour = LIGHT[self.colour]
        return Line2D(
            [x],
            [y],
            linestyle="",
            marker=self.marker,
            markersize=2 * RADIUS_PX[state] * SIDES.get(self.marker, 1),
            fillstyle="full"
            if self.filling == "none"
            else self.filling,  # matplotlib's own "none" can be seen through
            markerfacecolor=LIGHT["page"] if self.filling == "none" else colour,
            markerfacecoloralt=LIGHT["page"],
            markeredgecolor=colour,
            markeredgewidth=EDGE * RADIUS_PX[state],
            alpha=FADED if state == "dominated" else None,
        )


def _polygon(marker: str, filling: Filling) -> Polygon:
    style = MarkerStyle(marker, filling)
    corners = np.asarray(style.get_path().transformed(style.get_transform()).to_polygons()[0])
    return [(x, -y) for x, y in corners.tolist()]


def marks_of(methods: Iterable[str]) -> dict[str, Mark]:
    """A mark for each method: no marker twice before all are used, no pair with a colour twice long after."""
    count, colours = len(MARKERS), len(SERIES)
    names = dict.fromkeys(methods)
    return {
        name: Mark(MARKERS[k % count], SERIES[(k % count + k // count) % colours]) for k, name in enumerate(names)
    }


State = Literal["front", "open", "dominated"]
RADIUS_PX: dict[State, float] = {"front": 7.0, "open": 5.5, "dominated": 4.5}
STATES: dict[State, str] = {
    "front": "on the front",
    "open": "not distinguished from it",
    "dominated": "dominated beyond the intervals",
}
EDGE = 0.26
"""Width of an outline, for a mark of radius 1."""

FADED = 0.6
"""Opacity of a dominated mark."""


@dataclass(frozen=True)
class Points:
    """The rows of a study, and how their methods look; a row's number is its place in the table.

    `against` names the point that all are held against, and `differences` holds theirs from it by name.
    """

    rows: Sequence[Row]
    marks: Mapping[str, Mark]
    against: str = ""
    differences: Mapping[str, Row] = field(default_factory=dict)

    @classmethod
    def of(cls, rows: Sequence[Row], against: str = "", differences: Sequence[Row] = ()) -> "Points":
        """Rows with a look for each of their methods."""
        return cls(rows, marks_of(map(method_of, rows)), against, {row.name: row for row in differences})

    def mark(self, row: Row) -> Mark:
        """The marker and colour of its method, filled as its precision; an unknown precision is left hollow."""
        return replace(self.marks[method_of(row)], filling=FILLINGS.get(row.text.get("precision", ""), "none"))

    def on(self, front: Front) -> list[tuple[str, Row]]:
        """The points that can be drawn, each with the id of its row in the page's table."""
        return [(f"point-{k}", row) for k, row in enumerate(self.rows, 1) if drawn(row, front)]


def method_of(row: Row) -> str:
    """The name of the method that the row's point runs."""
    return row.text.get("method", row.name)


def drawn(row: Row, front: Front) -> bool:
    """Whether it has both figures, a cost above zero, and neither published: those were found on other images."""
    found = [row.figures.get(key) for key in (front.x, front.y)]
    if any(figure is None or figure.value is None or figure.mode == "published" for figure in found):
        return False
    return value_of(row, front.x) > 0


def value_of(row: Row, key: str) -> float:
    """A figure of a row; 0 where there is none."""
    return row.figures[key].value or 0.0


def state_of(front: Front, name: str) -> State:
    """Where a point lies beside the front."""
    return "front" if name in front.members else "dominated" if name in front.dominated else "open"
