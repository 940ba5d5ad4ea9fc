"""How points look: a marker and a colour for each method, a filling for each precision, a size for each state."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle

from deploy.report.plots import LIGHT, SERIES

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
