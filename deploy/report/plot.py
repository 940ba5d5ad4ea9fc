"""A plot as it stands on its canvas: every line, mark and label in pixels, for an SVG or a PNG to draw."""

from dataclasses import dataclass
from typing import Literal

from deploy.report.labels import Box, Label
from deploy.report.marks import Mark

FONT_PX, LABEL_PX, TITLE_PX = 13, 12, 15

State = Literal["front", "even", "beaten"]
RADIUS_PX: dict[State, float] = {"front": 7.0, "even": 5.5, "beaten": 4.5}
"""A point on the front, one not told apart from it, one beaten beyond the intervals."""


@dataclass(frozen=True)
class Dot:
    """A point: its mark and where it stands, the ends of its intervals as thin boxes, and what to say of it.

    Attributes:
        anchor: id of the point's row in the page's table.
        title: what appears when the pointer rests on it.
    """

    name: str
    x: float
    y: float
    mark: Mark
    state: State
    bars: tuple[Box, ...]
    anchor: str
    title: str

    @property
    def radius(self) -> float:
        """In pixels."""
        return RADIUS_PX[self.state]

    @property
    def box(self) -> Box:
        """What it covers."""
        reach = 1.3 * self.radius + 1
        return self.x - reach, self.y - reach, self.x + reach, self.y + reach


@dataclass(frozen=True)
class Entry:
    """A line of the legend: a mark in the colour of its method, or in ink where it stands for a precision."""

    x: float
    y: float
    mark: Mark
    text: str
    state: State = "front"
    inked: bool = False

    @property
    def radius(self) -> float:
        """In pixels."""
        return RADIUS_PX[self.state]


@dataclass(frozen=True)
class Plot:
    """Everything that is drawn.

    Attributes:
        size: width and height of the canvas, in pixels.
        frame: where values stand.
        x_ticks: place and text.
        front: corners of the front's line.
        better: what to write in the corner where points are best.
    """

    title: str
    size: tuple[int, int]
    frame: Box
    x_title: str
    y_title: str
    x_ticks: tuple[tuple[float, str], ...]
    y_ticks: tuple[tuple[float, str], ...]
    front: tuple[tuple[float, float], ...]
    dots: tuple[Dot, ...]
    labels: tuple[Label, ...]
    legend: tuple[Entry, ...]
    better: str
