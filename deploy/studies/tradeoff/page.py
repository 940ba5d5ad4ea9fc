"""The result of a study, and its page: the recommended line, the plot with its front, boards, and
all points.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from beers_deploy.model.io.files import write_text
from beers_deploy.profiles.errors import optional
from beers_deploy.profiles.figures import Row
from beers_deploy.report.page import Picture, Report, Section, write_report
from beers_deploy.report.plots import data_url
from beers_deploy.results import Table
from beers_deploy.studies.tradeoff.advice import Constraint
from beers_deploy.studies.tradeoff.front import BOARDS, FRONT, PSNR, Measured
from beers_deploy.studies.tradeoff.plot import CAPTION, draw, plot_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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


@dataclass(frozen=True, repr=False, kw_only=True)
class Tradeoff(Table):
    """Accuracy compared with time: the recommended point, the Pareto front, and every point with
    its figures. It is true if a point complies with the budget and the need.

    Attributes:
        boards: the names of all boards that were compared.
        points: all of them, in the order networks, chains, other libraries, the paper's runs.
        front: those on the Pareto front over all boards, sorted by increasing cost.
        constraints: budget and need.
        cost: the figure that the front is against.
        best: the recommended point; None if none complies with the budget and the need.
        line: the sentence that recommends it.
        remarks: how the figures were measured.
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
        """The front by number, each point with its difference from the next cheaper one."""
        return [row for row in self.rows if row.table.startswith(FRONT)]

    @property
    def board_rows(self) -> list[Row]:
        """For each board its best point within the limits, or the reason why it has none."""
        return [row for row in self.rows if row.table == BOARDS]

    @property
    def board(self) -> str:
        """The board of the recommended point; the first board if there is none."""
        # A point of this machine alone has no board among those that were compared.
        name = self.best.text["board"] if self.best else ""
        return name if name in self.boards else self.boards[0]

    def plot(self, figure: str | None = None, ax: "Axes | None" = None) -> "Axes":
        """Plot PSNR of every point against its cost, with the front, the recommended point and the
        budget.

        Args:
            figure: if given, draw bars of that figure instead, as for any table.
            ax: axes of matplotlib to draw on; new ones if None.
        """
        if figure is not None:
            return super().plot(figure, ax)
        axes = ax if ax is not None else optional("matplotlib.pyplot", "plot").subplots()[1]
        draw(axes, self)
        return cast("Axes", axes)

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write the page and its plot into a folder, and return the page's path."""
        svg = plot_svg(self)
        page, plot = (Path(folder) / name for name in FILES)
        write_text(plot, svg)
        write_report(report_of(self, svg), page)
        return page


def report_of(study: Tradeoff, svg: str) -> Report:
    """Compose the page in reading order."""
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
