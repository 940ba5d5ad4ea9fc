"""The time of each layer of a network as bars, in the network's order."""

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from deploy.report.plots import LIGHT, look, new_figure, svg_of
from profiles.figures import Row, number

SIZE_PX = (1000, 90)
FILLED = 0.82
"""Share of a bar's place that it fills."""

COLOURS = {"compute": "mark0", "memory": "mark1"}
"""What bounds a layer's time; anything else is grey."""

HOLLOW = "memory"
"""What is drawn as an outline, to be distinguished without colour."""


@dataclass(frozen=True)
class LayerBars:
    """A picture with a bar for each layer, and a sentence about them.

    Attributes:
        svg: part of a page.
        bounds: names of the colours of the outline and of the inside, by what bounds a time.
        caption: the longest layer, and what bounds most of the time.
    """

    svg: Markup
    bounds: dict[str, tuple[str, str]]
    caption: str


def layer_bars(name: str, rows: Sequence[Row]) -> LayerBars:
    """Bars of a network's layers.

    Args:
        name: of the network.
        rows: of its layers; shown are those that have a time and say what bounds it, which a sum does not.
    """
    shown = [row for row in rows if "bound" in row.text and _time(row) is not None]
    bounds = {row.text["bound"]: COLOURS.get(row.text["bound"], "soft") for row in shown}
    titles = {f"layer-{k}": f"{row.name}: {_words(row)}, bound by {row.text['bound']}" for k, row in enumerate(shown)}
    with look():
        figure = new_figure(*SIZE_PX)
        axes = figure.add_axes((0, 0, 1, 1), frameon=False, xlim=(-0.5, max(len(shown), 1) - 0.5))
        axes.set_axis_off()
        for k, row in enumerate(shown):
            edge = LIGHT[bounds[row.text["bound"]]]
            fill = LIGHT["page"] if row.text["bound"] == HOLLOW else edge
            bar = axes.bar(k, _time(row) or 0.0, FILLED, color=fill, edgecolor=edge, linewidth=1.4)[0]
            bar.set_gid(f"layer-{k}")
        axes.set_ylim(bottom=0)
        svg = svg_of(figure, f"time of each layer of {name}: {_caption(shown)}", titles, stretched=True)
    keys = {bound: (edge, "page" if bound == HOLLOW else edge) for bound, edge in bounds.items()}
    return LayerBars(svg, keys, _caption(shown))


def _caption(rows: Sequence[Row]) -> str:
    """The longest layer, and what bounds most of the time."""
    total = sum(_time(row) or 0.0 for row in rows)
    if not total:
        return "No layer has a time."
    longest = max(rows, key=lambda row: _time(row) or 0.0)
    shares: dict[str, float] = {}
    for row in rows:
        shares[row.text["bound"]] = shares.get(row.text["bound"], 0.0) + (_time(row) or 0.0) / total
    said = ", ".join(f"{bound} {share:.0%}" for bound, share in sorted(shares.items(), key=lambda each: -each[1]))
    unit = longest.figures["time"].unit
    return (
        f"{number(total, 3)} {unit} in all; the highest bar is {longest.name}, {_words(longest)}. "
        f"What bounds the time: {said}."
    )


def _time(row: Row) -> float | None:
    return row.figures["time"].value if "time" in row.figures else None


def _words(row: Row) -> str:
    figure = row.figures["time"]
    return f"{figure} {figure.unit}"
