"""A placed network as a picture: nodes from top to bottom, coloured and labelled by device, as SVG or HTML."""

import textwrap
from html import escape
from itertools import accumulate
from pathlib import Path

from deploy.dpu.placement import PlacedNode, Placement
from model.files import write_text
from profiles.errors import OptionError

FILLS = {"DPU": "#56B4E9", "CPU": "#E69F00", "host": "#CCCCCC"}
"""Okabe and Ito's colours, told apart with any colour vision, and light enough for black text."""

STYLE = (
    "text{font:13px sans-serif;fill:#111}.device{font-weight:bold}.beside{fill:#222}.page{fill:#fff}"
    ".edge{fill:none;stroke:#777;stroke-width:1.5}@media(prefers-color-scheme:dark){.beside{fill:#eee}.page{fill:#161616}}"
)
LINE_PX, BOX_PX, GAP_PX, LEFT_PX, NAME_PX, MARGIN_PX = 18, 28, 12, 72, 276, 16
WIDTH_PX = LEFT_PX + NAME_PX + MARGIN_PX
"""Narrower than a phone's screen: a wider picture is cut off there, or its words scaled down."""
NAME_LETTERS, LINE_LETTERS, TITLE_LETTERS = 29, 34, 46
VIEWPORT = '<meta name="viewport" content="width=device-width"><style>body{margin:0}</style>'


def require_picture(path: Path | None) -> None:
    """Refuse a file name that is neither .svg nor .html.

    Raises:
        OptionError: another ending.
    """
    if path is not None and path.suffix not in (".svg", ".html"):
        remedy = "name it so; every browser opens both"
        raise OptionError("--picture", expected="a file ending in .svg or .html", got=path.name, remedy=remedy)


def write_picture(placement: Placement, title: str, path: Path) -> None:
    """Write the picture, whole or not at all; as a page where the name ends in .html."""
    svg = draw(placement, title)
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>{VIEWPORT}'
    write_text(path, f"{head}<body>{svg}</body></html>\n" if path.suffix == ".html" else svg)


def draw(placement: Placement, title: str) -> str:
    """The picture as SVG."""
    nodes, heading = placement.nodes, textwrap.wrap(title, TITLE_LETTERS)
    legend_y = 12 + LINE_PX * len(heading)
    *tops, height = accumulate(map(_height, nodes), initial=legend_y + BOX_PX + GAP_PX)
    writer = {name: row for row, node in enumerate(nodes) for name in node.op.outputs}
    edges = [
        _edge(tops[writer[i]], tops[row], row - writer[i])
        for row, node in enumerate(nodes)
        for i in node.op.inputs
        if i in writer
    ]
    legend = [_label(MARGIN_PX + 70 * k, legend_y, 56, device) for k, device in enumerate(FILLS)]
    boxes = [_box(y, node) for y, node in zip(tops, nodes, strict=True)]
    size = f'width="{WIDTH_PX}" height="{height}" viewBox="0 0 {WIDTH_PX} {height}"'
    start = f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img"><title>{escape(title)}</title>'
    page = '<rect class="page" width="100%" height="100%"/>'
    words = [_text(MARGIN_PX, LINE_PX * (k + 1), line, "beside") for k, line in enumerate(heading)]
    return "\n".join([start, f"<style>{STYLE}</style>", page, *words, *legend, *edges, *boxes, "</svg>\n"])


def _lines(node: PlacedNode) -> list[str]:
    """Below a node's box: its result's shape, or what is wrong."""
    shape = _maps(*node.op.out_shape) if node.op.out_shape else "shape unknown"
    return textwrap.wrap("; ".join(f"{b.rule}: {b.finding.reason}" for b in node.broken) or shape, LINE_LETTERS)


def _maps(channels: int, height_px: int, width_px: int) -> str:
    return f"{channels} map{'s' if channels > 1 else ''} of {width_px} x {height_px}"


def _height(node: PlacedNode) -> int:
    return BOX_PX + LINE_PX * len(_lines(node)) + GAP_PX


def _box(y: int, node: PlacedNode) -> str:
    """A node's device, operator and name, and the lines below."""
    name = f"{node.op.op_type}  {node.op.name}"
    short = name if len(name) <= NAME_LETTERS else f"{name[: NAME_LETTERS - 1]}…"
    whole = f"<title>{escape(name)}</title>"
    lines = [
        _text(LEFT_PX + 24, y + BOX_PX + LINE_PX * (k + 1) - 3, line, "beside") for k, line in enumerate(_lines(node))
    ]
    inside = (_label(LEFT_PX, y, NAME_PX, node.device), _text(LEFT_PX + 56, y + 19, short, "name"), *lines)
    return f"<g>{whole}{''.join(inside)}</g>"


def _text(x: int, y: int, text: str, kind: str) -> str:
    return f'<text class="{kind}" x="{x}" y="{y}">{escape(text)}</text>'


def _label(x: int, y: int, width: int, device: str) -> str:
    box = f'<rect x="{x}" y="{y}" width="{width}" height="{BOX_PX}" fill="{FILLS[device]}" stroke="#111"/>'
    return box + _text(x + 8, y + 19, device, "device")


def _edge(start_y: int, end_y: int, rows: int) -> str:
    """A line down the left side to the next node; around the left to one further down."""
    if rows == 1:
        return f'<path class="edge" d="M{LEFT_PX + 12} {start_y + BOX_PX}V{end_y}"/>'
    reach = LEFT_PX - 5 * min(rows, 12)
    middle = start_y + BOX_PX // 2
    return (
        f'<path class="edge" d="M{LEFT_PX} {middle}C{reach} {middle} {reach} {end_y + 14} {LEFT_PX} {end_y + 14}"/>'
    )
