"""The report of a trade-off: one HTML file that asks the network for nothing, its plot, and its points as CSV."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from markupsafe import Markup

from deploy import __version__
from deploy.report.layer_bars import layer_bars
from deploy.report.page import TEMPLATES, Grid, Provenance, figure_keys, grid_of, templates
from deploy.report.plots import plot_style
from deploy.results import unit_of, words_of
from deploy.tradeoff.marks import STATES, Points, drawn, state_of
from deploy.tradeoff.plot import NARROW, WIDE, plot_of
from deploy.tradeoff.study import Crop, Front, Study, front_rows
from model.io.files import write_text
from model.io.pictures import picture_url, stretch_of
from profiles.figures import Figure, Row, by_table

PARTS = ("low", "high", "mode", "source")
"""Columns after that of the value; the source of an unavailable figure is the reason."""


def write_points(rows: Sequence[Row], path: Path) -> None:
    """Write a line a point: its name, its words, and five columns a figure."""
    keys, words = figure_keys(rows), words_of(list(rows))
    header = ["point", *words]
    for key in keys:
        header += [f"{key} ({unit_of(key, list(rows))})", *(f"{key} {part}" for part in PARTS)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        figures = [part for key in keys for part in _parts(row.figures.get(key))]
        writer.writerow([row.name, *(row.text.get(word, "") for word in words), *figures])
    write_text(path, text.getvalue())


def _parts(figure: Figure | None) -> list[str]:
    if figure is None:
        return [""] * (1 + len(PARTS))
    if figure.value is None:
        return ["", "", "", figure.mode, figure.reason]
    low, high = (repr(end) for end in figure.interval) if figure.interval else ("", "")
    return [repr(figure.value), low, high, figure.mode, figure.source]


FIRST = ("board latency", "PSNR")
"""The axes of the plot that is shown first, and written as SVG and PNG."""

FILES = ("tradeoff.html", "tradeoff.svg", "tradeoff.png", "points.csv")


def write_study(study: Study, out: Path) -> None:
    """Write each of FILES into a folder, whole or not at all.

    Raises:
        MachineError: a file cannot be written.
    """
    fronts = ordered(study.fronts)
    first = plot_of(fronts[0] if fronts else Front(*FIRST, (), (), {}, ()), points_of(study), WIDE)
    write_text(out / "tradeoff.svg", first.svg(alone=True))
    first.write_png(out / "tradeoff.png")
    write_points(study.points, out / "points.csv")
    write_text(out / "tradeoff.html", render_study(study))


def ordered(fronts: Sequence[Front]) -> list[Front]:
    """The fronts, that of quality against board latency first."""
    return sorted(fronts, key=lambda front: (front.x, front.y) != FIRST)


def render_study(study: Study) -> str:
    """The study as one HTML page, with its plots, tables and pictures."""
    provenance, points, fronts = Provenance(), points_of(study), ordered(study.fronts)
    boards = Points(study.boards, points.marks)
    shown = {
        "study": study,
        "plots": [_shown(study, front, points, provenance) for front in fronts],
        "costs": list(dict.fromkeys(front.x for front in fronts)),
        "qualities": list(dict.fromkeys(front.y for front in fronts)),
        "points": grid_of([_with_differences(_with_place(row, fronts), points) for row in study.points], provenance),
        "marks": [points.mark(row) for row in study.points],
        "boards": grid_of(study.boards, provenance),
        "board_marks": [boards.mark(row) for row in study.boards],
        "crops": crop_urls(study.crops),
        "layers": {name: (layer_bars(name, rows), grid_of(rows, provenance)) for name, rows in study.layers.items()},
        "placement": {name: _grids(rows, provenance) for name, rows in study.placement.items()},
        "provenance": provenance,
    }
    template = templates().get_template("tradeoff/page.html")
    return template.render(shown, plot_style=plot_style(), script=_script(), version=__version__).lstrip()


def _script() -> Markup:
    """All that the page runs, in one piece."""
    files = (TEMPLATES / "tradeoff" / name for name in ("page.js", "boards.js"))
    return Markup("\n".join(file.read_text(encoding="utf-8") for file in files))  # noqa: S704 - our own files


@dataclass(frozen=True)
class Shown:
    """A front with its plot, for a wide screen and for a narrow one, and a table of its members."""

    front: Front
    wide: Markup
    narrow: Markup
    members: Grid


def _shown(study: Study, front: Front, points: Points, provenance: Provenance) -> Shown:
    wide, narrow = (plot_of(front, points, canvas).svg() for canvas in (WIDE, NARROW))
    return Shown(front, wide, narrow, grid_of(front_rows(study, front), provenance))


def points_of(study: Study) -> Points:
    """A study's points with their looks, and what they are held against."""
    return Points.of(study.points, study.against, study.differences)


def _with_differences(row: Row, points: Points) -> Row:
    """The row, with each difference behind its quality."""
    if row.name not in points.differences:
        return row
    beside, found = points.differences[row.name].figures, dict[str, Figure]()
    for key, figure in row.figures.items():
        found |= {
            name: each
            for name, each in ((key, figure), (f"{key} difference", beside.get(f"{key} difference")))
            if each
        }
    return replace(row, figures=found)


def _with_place(row: Row, fronts: Sequence[Front]) -> Row:
    """The row, with where it lies beside the first front as its first word."""
    if not fronts:
        return row
    front = fronts[0]
    words = (
        f"dominated by {front.dominated[row.name]}"
        if row.name in front.dominated
        else STATES[state_of(front, row.name)]
    )
    return replace(row, text={f"{front.y} against {front.x}": words if drawn(row, front) else "", **row.text})


def _grids(rows: Sequence[Row], provenance: Provenance) -> dict[str, Grid]:
    return {name: grid_of(found, provenance) for name, found in by_table(rows).items()}


def crop_urls(crops: Sequence[Crop]) -> list[str]:
    """Pictures of crops, all with the reference's grey scale, or the first one's where there is none."""
    if not crops:
        return []
    stretch = stretch_of(next((crop.dn for crop in crops if crop.point == "reference"), crops[0].dn))
    return [picture_url(stretch.to_bytes(crop.dn)) for crop in crops]
