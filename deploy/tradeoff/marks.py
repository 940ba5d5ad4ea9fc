"""How points look: a marker and a colour for each method, a filling for each precision, a size for each state.

Also the legend that says so.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle

from deploy.report.plots import LIGHT, SERIES, text_width
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


LABEL_PX, EDGE_PX = 12, 18
ROW_PX, WORDS_PX, GAP_PX = 20, 13, 22
"""In the legend: between lines, from a mark to its words, and from them to the next mark."""


@dataclass(frozen=True)
class Entry:
    """A part of the legend: a mark at (x, y) in pixels from the legend's upper left corner, and its words."""

    mark: Mark
    text: str
    state: State = "front"
    x: float = 0.0
    y: float = 0.0


def legend_of(points: Points, rows: Sequence[Row], width_px: float) -> list[Entry]:
    """Which marker is which method, which filling which precision, which size which state, in lines so wide."""
    methods = dict.fromkeys(map(method_of, rows))
    precisions = filter(None, dict.fromkeys(row.text.get("precision", "") for row in rows))
    groups = [
        [Entry(points.marks[method], _short(method)) for method in methods],
        [Entry(Mark("o", "ink", FILLINGS.get(name, "none")), name) for name in precisions],
        [Entry(Mark("o", "ink"), text, state) for state, text in STATES.items()],
    ]
    return list(_flow(groups, width_px))


def _flow(groups: Iterable[Sequence[Entry]], width_px: float) -> Iterator[Entry]:
    """From left to right, each group from a new line on."""
    y = ROW_PX / 2
    for group in groups:
        x = float(EDGE_PX)
        for entry in group:
            reach = x + WORDS_PX + text_width(entry.text, LABEL_PX)
            if reach > width_px and x > EDGE_PX:
                x, y, reach = float(EDGE_PX), y + ROW_PX, reach - x + EDGE_PX
            yield replace(entry, x=x, y=y)
            x = reach + GAP_PX
        y += ROW_PX if group else 0


LETTERS = 40


def _short(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= LETTERS else f"{line[: LETTERS - 1]}\u2026"
