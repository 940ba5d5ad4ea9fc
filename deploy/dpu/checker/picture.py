"""The picture of a placed network: its nodes from top to bottom, each in the
colour of its device.
"""

import textwrap
from html import escape
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING

from markupsafe import Markup

from beers_deploy.dpu.checker.placement import PlacedNode, Placement
from beers_deploy.model.io.files import write_text
from beers_deploy.profiles.errors import OptionError, visible
from beers_deploy.report.plots import look, new_figure, svg_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.path import Path as Outline

FILLS = {"DPU": "#56b4e9", "CPU": "#e69f00", "host": "#cccccc"}
"""Okabe and Ito's colours, distinct to any colour vision, and light enough for black text."""

INK = "#111111"
EDGE = "#777777"
"""Of words in a box and of lines, on light and on dark screens."""

LINE_PX = 18
BOX_PX = 28
GAP_PX = 12
LEFT_PX = 72
NAME_PX = 276
MARGIN_PX = 16
WIDTH_PX = LEFT_PX + NAME_PX + MARGIN_PX
"""Narrower than a phone's screen: a wider picture is cut off there, or its words scaled down."""
NAME_LETTERS = 29
LINE_LETTERS = 34
TITLE_LETTERS = 46
VIEWPORT = '<meta name="viewport" content="width=device-width"><style>body{margin:0}</style>'


def require_picture(path: Path | None) -> None:
    """Refuse a file name that is neither .svg nor .html."""
    if path is not None and path.suffix not in (".svg", ".html"):
        remedy = "name it so; every browser opens both"
        raise OptionError(
            "picture", expected="a file ending in .svg or .html", got=path.name, remedy=remedy
        )


def write_picture(placement: Placement, title: str, path: Path) -> None:
    """Write the picture, whole or not at all; as a page where the name ends in .html."""
    svg = draw(placement, title)
    head = (
        '<!doctype html><html lang="en"><meta '
        f'charset="utf-8"><title>{escape(visible(title))}</title>{VIEWPORT}'
    )
    write_text(path, f"{head}<body>{svg}</body></html>\n" if path.suffix == ".html" else svg)


def draw(placement: Placement, title: str) -> Markup:
    """The picture as an SVG file; a node's whole name appears when the pointer rests on its box."""
    nodes = placement.nodes
    heading = textwrap.wrap(title, TITLE_LETTERS)
    legend_y = 12 + LINE_PX * len(heading)
    heights = (BOX_PX + LINE_PX * len(_lines(node)) + GAP_PX for node in nodes)
    *tops, height = accumulate(heights, initial=legend_y + BOX_PX + GAP_PX)
    with look():
        figure = new_figure(WIDTH_PX, height)
        # The y axis points down, so that nodes follow one another from top to bottom.
        axes = figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH_PX), ylim=(height, 0))
        axes.set_axis_off()
        for k, line in enumerate(heading, 1):
            axes.text(MARGIN_PX, LINE_PX * k, line, gid="beside")
        for k, device in enumerate(FILLS):
            _box(axes, (MARGIN_PX + 70 * k, legend_y), 56, device, "key")
        _edges(axes, nodes, tops)
        for row, (y, node) in enumerate(zip(tops, nodes, strict=True)):
            _node(axes, y, node, f"node-{row}")
        return svg_of(figure, title, {f"node-{k}": _name(node) for k, node in enumerate(nodes)})


def _name(node: PlacedNode) -> str:
    return f"{node.op.op_type}  {node.op.name}"


def _lines(node: PlacedNode) -> list[str]:
    """Below a node's box: its result's shape, or what is wrong."""
    channels, height_px, width_px = node.op.out_shape or (0, 0, 0)
    maps = f"{channels} map{'s' if channels > 1 else ''} of {width_px} x {height_px}"
    shape = maps if node.op.out_shape else "shape unknown"
    return textwrap.wrap(
        "; ".join(f"{b.rule}: {b.finding.reason}" for b in node.broken) or shape, LINE_LETTERS
    )


def _node(axes: "Axes", y: int, node: PlacedNode, anchor: str) -> None:
    _box(axes, (LEFT_PX, y), NAME_PX, node.device, anchor)
    name = _name(node)
    short = name if len(name) <= NAME_LETTERS else f"{name[: NAME_LETTERS - 1]}\u2026"
    axes.text(LEFT_PX + 56, y + 19, short, color=INK, gid="name")
    for k, line in enumerate(_lines(node), 1):
        axes.text(LEFT_PX + 24, y + BOX_PX + LINE_PX * k - 3, line, gid="beside")


def _box(axes: "Axes", at: tuple[int, int], width: int, device: str, anchor: str) -> None:
    from matplotlib.patches import Rectangle

    axes.add_patch(Rectangle(at, width, BOX_PX, facecolor=FILLS[device], edgecolor=INK, gid=anchor))
    axes.text(at[0] + 8, at[1] + 19, device, color=INK, weight="bold", gid="device")


def _edges(axes: "Axes", nodes: tuple[PlacedNode, ...], tops: list[int]) -> None:
    """From the node that writes each tensor to those that read it."""
    from matplotlib.patches import PathPatch

    writer: dict[str, int] = {}
    for row, node in enumerate(nodes):
        writer |= dict.fromkeys(node.op.outputs, row)
    for row, node in enumerate(nodes):
        for start in (writer[name] for name in node.op.inputs if name in writer):
            path = _path(tops[start], tops[row], row - start)
            axes.add_patch(
                PathPatch(path, facecolor="none", edgecolor=EDGE, linewidth=1.5, gid="edge")
            )


def _path(start_y: int, end_y: int, rows: int) -> "Outline":
    """A line down the left side to the next node; around the left to one further down."""
    from matplotlib.path import Path as Outline

    if rows == 1:
        return Outline([(LEFT_PX + 12, start_y + BOX_PX), (LEFT_PX + 12, end_y)])
    reach = LEFT_PX - 5 * min(rows, 12)
    middle = start_y + BOX_PX // 2
    end = end_y + 14
    points = [(LEFT_PX, middle), (reach, middle), (reach, end), (LEFT_PX, end)]
    # A cubic Bezier curve has two control points and an end: one code for each.
    return Outline(points, [Outline.MOVETO, *[Outline.CURVE4] * 3])
