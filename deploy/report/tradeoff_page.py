"""The report of a trade-off: one HTML file that asks the network for nothing, its plot as SVG and PNG, points as CSV.

Every plot is laid out twice, for a wide screen and for a phone; the page's style sheet shows one of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from markupsafe import Markup

from deploy import __version__
from deploy.report.layer_bars import layer_bars
from deploy.report.marks import marks_of
from deploy.report.pictures import picture_url, stretch_of
from deploy.report.plot_png import write_png
from deploy.report.plot_svg import plot_style, plot_svg
from deploy.report.provenance import Grid, Provenance, grid_of
from deploy.report.templates import templates
from deploy.report.tradeoff_csv import write_points
from deploy.report.tradeoff_names import NARROW, WIDE
from deploy.report.tradeoff_plot import plot_of
from deploy.report.tradeoff_points import Points, drawn, method_of, state_of
from deploy.results import Row, by_table
from deploy.tradeoff.study import Crop, Front, Study
from model.files import write_text

FIRST = ("board latency", "PSNR")
"""The axes of the plot that is shown first, and written as SVG and PNG."""

STATES = {"front": "on the front", "even": "not told apart from the front", "beaten": "beaten by {}"}


FILES = ("tradeoff.html", "tradeoff.svg", "tradeoff.png", "points.csv")


def write_study(study: Study, out: Path) -> None:
    """Write each of FILES into a folder, whole or not at all.

    Raises:
        MachineError: a file cannot be written.
    """
    fronts = ordered(study.fronts)
    first = plot_of(fronts[0] if fronts else Front(*FIRST, (), (), {}, ()), points_of(study), WIDE)
    write_text(out / "tradeoff.svg", plot_svg(first, alone=True))
    write_png(first, out / "tradeoff.png")
    write_points(study.points, out / "points.csv")
    write_text(out / "tradeoff.html", render_study(study))


def ordered(fronts: Sequence[Front]) -> list[Front]:
    """The fronts, that of quality against board latency first."""
    return sorted(fronts, key=lambda front: (front.x, front.y) != FIRST)


def points_of(study: Study) -> Points:
    """The study's points, a look for each method."""
    return Points(study.points, marks_of(map(method_of, study.points)))


def render_study(study: Study) -> str:
    """The page as HTML."""
    provenance, points, fronts = Provenance(), points_of(study), ordered(study.fronts)
    script = Markup((Path(__file__).parent / "tradeoff.js").read_text(encoding="utf-8"))  # noqa: S704 - our own file
    shown = {
        "study": study,
        "plots": [_shown(front, points) for front in fronts],
        "costs": list(dict.fromkeys(front.x for front in fronts)),
        "qualities": list(dict.fromkeys(front.y for front in fronts)),
        "points": grid_of([_with_place(row, fronts) for row in study.points], provenance),
        "marks": [points.mark(row) for row in study.points],
        "crops": crop_urls(study.crops),
        "layers": {name: (layer_bars(rows), grid_of(rows, provenance)) for name, rows in study.layers.items()},
        "placement": {name: _grids(rows, provenance) for name, rows in study.placement.items()},
        "provenance": provenance,
    }
    template = templates().get_template("tradeoff.html")
    return template.render(shown, plot_style=plot_style(), script=script, version=__version__).lstrip()


@dataclass(frozen=True)
class Shown:
    """A front with its plot, for a wide screen and for a narrow one."""

    front: Front
    wide: Markup
    narrow: Markup


def _shown(front: Front, points: Points) -> Shown:
    return Shown(front, *(plot_svg(plot_of(front, points, canvas)) for canvas in (WIDE, NARROW)))


def _with_place(row: Row, fronts: Sequence[Front]) -> Row:
    """The row, with where it lies beside the first front as its first word."""
    if not fronts:
        return row
    front = fronts[0]
    state = STATES[state_of(front, row.name)].format(front.beaten.get(row.name, "")) if drawn(row, front) else ""
    return replace(row, text={f"{front.y} against {front.x}": state, **row.text})


def _grids(rows: Sequence[Row], provenance: Provenance) -> dict[str, Grid]:
    return {name: grid_of(found, provenance) for name, found in by_table(rows).items()}


def crop_urls(crops: Sequence[Crop]) -> list[str]:
    """Pictures of crops, all with the reference's grey scale, or the first one's where there is none."""
    if not crops:
        return []
    stretch = stretch_of(next((crop.dn for crop in crops if crop.point == "reference"), crops[0].dn))
    return [picture_url(stretch.to_bytes(crop.dn)) for crop in crops]
