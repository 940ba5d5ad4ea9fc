"""Where labels of marks stand so that none hides another or a mark: greedy, the most important first.

matplotlib places no labels; a search by forces (adjustText) leaves some on each other where marks are dense. Places
are pixels from the canvas' upper left corner.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from deploy.report.plots import text_width

LINE_PX, PAD_PX = 15, 3
NEAR_PX, FAR_PX = (11, 16, 24), (11, 16, 24, 38, 56, 80, 110, 150, 200)
DIRECTIONS = 24
LEADER_PX = 20
"""From here on a line leads from the label to its mark."""

BEHIND = 3
"""What it costs to lie on a line, in steps of distance."""

Place = tuple[float, float]
Box = tuple[float, float, float, float]
"""Left, top, right, bottom, in pixels."""


@dataclass(frozen=True)
class Wish:
    """A label that is wanted.

    Attributes:
        x: of its mark, in pixels.
        y: of its mark, in pixels.
        lines: of its text.
        far: whether it may stand away from its mark, with a line that leads there.
    """

    x: float
    y: float
    lines: tuple[str, ...]
    far: bool


@dataclass(frozen=True)
class Label:
    """Lines of text within a box; the end of the line that leads to the mark, where there is one."""

    wish: Wish
    box: Box
    leader: Place | None

    @property
    def alignment(self) -> Literal["left", "center", "right"]:
        """Which end of the text stands towards the mark."""
        left, _, right, _ = self.box
        return "left" if left > self.wish.x else "right" if right < self.wish.x else "center"

    @property
    def text_x(self) -> float:
        """Where that end stands, in pixels."""
        left, _, right, _ = self.box
        return {"left": left + PAD_PX, "right": right - PAD_PX, "center": (left + right) / 2}[self.alignment]

    @property
    def baselines(self) -> list[float]:
        """Where each line of text stands, in pixels from the top."""
        return [self.box[1] + PAD_PX + LINE_PX * (k + 0.75) for k in range(len(self.wish.lines))]


def place(
    wishes: Sequence[Wish], marks: Sequence[Box], lines: Sequence[Box], canvas: Box, size_px: int
) -> list[Label]:
    """Labels that hide neither each other nor a mark, and lines only where nothing else is left.

    Args:
        wishes: the most important first; one that finds no room is left out.
        marks: what must not be hidden.
        lines: what had better not be hidden.
        canvas: what labels must not leave.
        size_px: of the font.
    """
    taken, crossed = list(marks), list(lines)
    found = []
    for wish in wishes:
        label = _best(wish, np.array(taken).reshape(-1, 4), np.array(crossed).reshape(-1, 4), canvas, size_px)
        if label is not None:
            found.append(label)
            taken.append(label.box)
            crossed += _leader_boxes(wish, label.leader)
    return found


def _best(wish: Wish, taken: np.ndarray, crossed: np.ndarray, canvas: Box, size_px: int) -> Label | None:
    """The cheapest free place: near, off the lines, its leader off everything."""
    best, label = math.inf, None
    boxes, steps = _candidates(wish, size_px)
    inside = (boxes[:, :2] >= canvas[:2]).all(1) & (boxes[:, 2:] <= canvas[2:]).all(1)
    free = inside & ~overlaps(boxes, taken).any(1)
    costs = steps + BEHIND * np.minimum(overlaps(boxes, crossed).sum(1), 3)
    for k in sorted(np.flatnonzero(free), key=lambda k: float(costs[k])):
        if costs[k] >= best:
            break
        box: Box = tuple(boxes[k].tolist())
        leader = _leader(wish, box)
        hidden = np.array(_leader_boxes(wish, leader)).reshape(-1, 4)
        cost = costs[k] + 2 * BEHIND * overlaps(hidden, taken).any(0).sum()
        cost += overlaps(hidden, crossed).any(1).sum() / 2  # a leader along a line is hard to see
        if cost < best:
            best, label = cost, Label(wish, box, leader)
    return label


def _candidates(wish: Wish, size_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (n, 4) around a mark, and how many steps away each is; upwards and to the left a little cheaper."""
    width = max(text_width(line, size_px) for line in wish.lines) + 2 * PAD_PX
    height = LINE_PX * len(wish.lines) + 2 * PAD_PX
    angles = 2 * math.pi * np.arange(DIRECTIONS) / DIRECTIONS
    dx, dy = np.cos(angles), -np.sin(angles)
    boxes, costs = [], []
    for step, distance in enumerate(FAR_PX if wish.far else NEAR_PX):
        x, y = wish.x + dx * (width / 2 + distance), wish.y + dy * (height / 2 + distance)
        boxes.append(np.stack([x - width / 2, y - height / 2, x + width / 2, y + height / 2], 1))
        costs.append(step + 0.4 * (1 - np.cos(angles - 0.7 * math.pi)))
    return np.round(np.concatenate(boxes), 1), np.concatenate(costs)


def overlaps(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n, 4) and (m, 4) boxes: which of the first overlap which of the second, (n, m)."""
    apart = (a[:, None, 2:] <= b[None, :, :2]) | (b[None, :, 2:] <= a[:, None, :2])
    return np.asarray(~apart.any(2))


def _leader(wish: Wish, box: Box) -> Place | None:
    """The point of the box nearest to the mark, unless it is so near that no line is needed."""
    x, y = min(max(wish.x, box[0]), box[2]), min(max(wish.y, box[1]), box[3])
    return (x, y) if math.hypot(x - wish.x, y - wish.y) > LEADER_PX else None


def _leader_boxes(wish: Wish, leader: Place | None) -> list[Box]:
    """A leader as small boxes, from a little off its mark on."""
    if leader is None:
        return []
    shares = np.linspace(0.1, 1, 12)
    points = [(wish.x + (leader[0] - wish.x) * s, wish.y + (leader[1] - wish.y) * s) for s in shares]
    return [(x - 1, y - 1, x + 1, y + 1) for x, y in points]
