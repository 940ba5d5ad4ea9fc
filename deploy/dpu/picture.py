"""A placed network as a picture: nodes from top to bottom, coloured and labelled by device, as SVG or HTML."""

from html import escape
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
TOP_PX, STEP_PX, BOX_PX, LEFT_PX, NAME_PX, WIDTH_PX = 72, 44, 28, 130, 356, 1240
NAME_LETTERS, FAULT_LETTERS = 36, 105


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
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
    write_text(path, f"{head}<body>{svg}</body></html>\n" if path.suffix == ".html" else svg)


def draw(placement: Placement, title: str) -> str:
    """The picture as SVG."""
    nodes = placement.nodes
    height = TOP_PX + STEP_PX * len(nodes)
    writer = {name: row for row, node in enumerate(nodes) for name in node.op.outputs}
    edges = [_edge(writer[i], row) for row, node in enumerate(nodes) for i in node.op.inputs if i in writer]
    legend = [_label(16 + 70 * k, 32, 56, device) for k, device in enumerate(FILLS)]
    boxes = [_box(TOP_PX + STEP_PX * row, node) for row, node in enumerate(nodes)]
    size = f'width="{WIDTH_PX}" height="{height}" viewBox="0 0 {WIDTH_PX} {height}"'
    start = f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img"><title>{escape(title)}</title>'
    page = '<rect class="page" width="100%" height="100%"/>'
    heading = f'<text class="beside" x="16" y="20">{escape(title)}</text>'
    return "\n".join([start, f"<style>{STYLE}</style>", page, heading, *legend, *edges, *boxes, "</svg>\n"])


def _box(y: int, node: PlacedNode) -> str:
    """A node's device, operator and name; beside them the result's shape, or what is wrong."""
    shape = _maps(*node.op.out_shape) if node.op.out_shape else "shape unknown"
    faults = "; ".join(f"{b.rule}: {b.finding.reason}" for b in node.broken)
    name = _short(f"{node.op.op_type}  {node.op.name}", NAME_LETTERS)
    text = f'<text x="{LEFT_PX + 60}" y="{y + 19}">{name}</text>'
    words = _short(faults or shape, FAULT_LETTERS)
    beside = f'<text class="beside" x="{LEFT_PX + NAME_PX + 10}" y="{y + 19}">{words}</text>'
    return "".join((_label(LEFT_PX, y, NAME_PX, node.device), text, beside))


def _maps(channels: int, height_px: int, width_px: int) -> str:
    return f"{channels} map{'s' if channels > 1 else ''} of {width_px} x {height_px}"


def _label(x: int, y: int, width: int, device: str) -> str:
    box = f'<rect x="{x}" y="{y}" width="{width}" height="{BOX_PX}" fill="{FILLS[device]}" stroke="#111"/>'
    return f'{box}<text class="device" x="{x + 8}" y="{y + 19}">{device}</text>'


def _short(text: str, letters: int) -> str:
    return escape(text if len(text) <= letters else f"{text[: letters - 1]}…")


def _edge(start: int, end: int) -> str:
    """A straight line to the next node; around the left to one further down."""
    x, y1, y2 = LEFT_PX + 76, TOP_PX + STEP_PX * start + BOX_PX, TOP_PX + STEP_PX * end
    if end == start + 1:
        return f'<path class="edge" d="M{x} {y1}V{y2}"/>'
    reach = max(LEFT_PX - 10 * min(end - start, 11), 12)
    middle = y1 - BOX_PX // 2
    return f'<path class="edge" d="M{LEFT_PX} {middle}C{reach} {middle} {reach} {y2 + 14} {LEFT_PX} {y2 + 14}"/>'
