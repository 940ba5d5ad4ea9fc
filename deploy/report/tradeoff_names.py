"""Which points of a plot have their names beside them, and in how many lines."""

import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from deploy.report.labels import Wish
from deploy.report.plot import Dot
from deploy.report.tradeoff_points import RISING, method_of
from deploy.results import Row
from deploy.tradeoff.study import Front

LABEL_LINES = 3


@dataclass(frozen=True)
class Canvas:
    """A size in pixels; how many letters a line of a label has; whether labels end at the first comma."""

    width: int
    height: int
    letters: int
    brief: bool


WIDE, NARROW = Canvas(1080, 660, 30, brief=False), Canvas(400, 640, 24, brief=True)


def wishes_of(front: Front, rows: Sequence[Row], dots: Sequence[Dot], canvas: Canvas) -> list[Wish]:
    """Names of the front's steps, best first; then of the best point of each other method, where there is room."""
    sign = 1 if front.y in RISING else -1
    by_quality = sorted(
        zip(rows, dots, strict=True), key=lambda each: -sign * (each[0].figures[front.y].value or 0.0)
    )
    named = {method_of(row) for row in rows if row.name in front.members}
    best = {method_of(row): dot for row, dot in reversed(by_quality) if method_of(row) not in named}
    steps = [dot for _, dot in by_quality if dot.name in front.steps]
    wanted = [*steps, *sorted(best.values(), key=lambda dot: dot.y)]
    heads = Counter(_head(dot.name) for dot in wanted)
    return [
        Wish(dot.x, dot.y, _lines(dot.name, canvas, heads[_head(dot.name)] == 1), dot.state == "front")
        for dot in wanted
    ]


def _head(name: str) -> str:
    return name.partition(", ")[0]


def _lines(name: str, canvas: Canvas, alone: bool) -> tuple[str, ...]:
    """A name in a few lines, a new one after its first comma; brief where that is enough to tell it by."""
    parts = [_head(name)] if canvas.brief and alone else name.split(", ", 1)
    lines = [line for part in parts for line in textwrap.wrap(part, canvas.letters)] or [name]
    if len(lines) > LABEL_LINES:
        lines[LABEL_LINES - 1] = lines[LABEL_LINES - 1][: canvas.letters - 1] + "\u2026"
    return tuple(lines[:LABEL_LINES])
