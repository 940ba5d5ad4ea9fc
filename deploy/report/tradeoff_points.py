"""The points of a study as a plot shows them: which, and how they look."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from deploy.report.marks import Mark, filling_of
from deploy.report.plot import State
from deploy.results import Row
from deploy.tradeoff.study import Front

RISING = {"PSNR", "SSIM", "flat SNR", "board throughput", "board efficiency"}
"""Figures of which more is better."""


@dataclass(frozen=True)
class Points:
    """The rows of a study, and how their methods look; a row's number is its place in the table."""

    rows: Sequence[Row]
    marks: Mapping[str, Mark]

    def mark(self, row: Row) -> Mark:
        """The shape and colour of its method, filled as its precision."""
        return replace(self.marks[method_of(row)], filling=filling_of(row.text.get("precision", "")))

    def on(self, front: Front) -> list[tuple[int, Row]]:
        """Number and row of the points that can be drawn."""
        return [(k, row) for k, row in enumerate(self.rows) if drawn(row, front)]


def method_of(row: Row) -> str:
    """What the row's point runs."""
    return row.text.get("method", row.name)


def drawn(row: Row, front: Front) -> bool:
    """Whether it has both figures, a cost above zero, and neither published: those were found on other images."""
    found = [row.figures.get(key) for key in (front.x, front.y)]
    if any(figure is None or figure.value is None or figure.mode == "published" for figure in found):
        return False
    return (row.figures[front.x].value or 0.0) > 0


def state_of(front: Front, name: str) -> State:
    """Where a point lies beside the front."""
    return "front" if name in front.members else "beaten" if name in front.beaten else "even"
