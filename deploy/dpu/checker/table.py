"""The checker's findings as rows of results and as a few lines."""

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from html import escape
from itertools import accumulate
from pathlib import Path

from deploy.dpu.board import Dpu
from deploy.dpu.checker.operators import Broken
from deploy.dpu.checker.placement import Cut, PlacedNode, Placement
from deploy.dpu.checker.traditional import Step
from model.io.files import write_text
from profiles.errors import OptionError
from profiles.figures import Figure, Row, predicted, unavailable
from quant.checks import Check

Remark = Callable[[Placement, Dpu, int], str | None]
"""Looks at a placed network, the DPU and the tile's side; None where there is nothing to say."""


def fix2float(placement: Placement, dpu: Dpu, tile_px: int) -> str | None:  # noqa: ARG001 - every remark takes all three
    """The DPU's results are int8: the last conversion, fix2float, runs on the CPU (Vitis-AI 3.0, xcompiler)."""
    leaving = [cut.tensor for cut in placement.cuts if not cut.onto_dpu]
    if not leaving:
        return None
    return f"what leaves the DPU is int8 ({', '.join(leaving)}); making it float runs on the CPU, for every tile"


def pieces(placement: Placement, dpu: Dpu, tile_px: int) -> str | None:  # noqa: ARG001
    """Every DPU subgraph is started by the CPU, and its maps cross memory both ways (Vitis-AI 3.0, xcompiler)."""
    count = placement.dpu_subgraphs
    return None if count < 2 else f"{count} DPU subgraphs: the CPU starts each, and carries maps between them"


def streaming(placement: Placement, dpu: Dpu, tile_px: int) -> str | None:
    """A map above {memory[feature_map_bytes].low:.0f} bytes streams through memory, at every layer (PG389 1.3)."""
    room = dpu.whole("memory", "feature_map_bytes")
    sizes = [op.out_bytes for op in placement.core if op.out_shape is not None]
    large = [size for size in sizes if size > room]
    if not large:
        return None
    kept_px = math.isqrt(room * tile_px * tile_px // max(large))
    return (
        f"{len(large)} of {len(sizes)} maps exceed {room / 2**20:g} MiB, the largest has {max(large) / 1e6:.1f} MB: "
        f"they stream through memory; tiles of {kept_px} px and less would keep every map on chip"
    )


REMARKS: tuple[Remark, ...] = (fix2float, pieces, streaming)


def remarks_on(placement: Placement, dpu: Dpu, tile_px: int) -> dict[str, str]:
    """Every remark that a placed network calls for, by name."""
    found = {remark.__name__: remark(placement, dpu, tile_px) for remark in REMARKS}
    return {name: text for name, text in found.items() if text is not None}


SOURCE = "operator rules of the target profile"


def network_rows(placement: Placement, dpu: Dpu, tile_px: int) -> list[Row]:
    """Every node, then the subgraphs, the tensors that cross, what else to know, and the counts."""
    nodes = [row for node in placement.nodes for row in _node_rows(node)]
    remarks = [
        Row("remarks", name, {}, {"remark": text}) for name, text in remarks_on(placement, dpu, tile_px).items()
    ]
    counts = {
        "DPU subgraphs": _count(placement.dpu_subgraphs, "subgraph"),
        "nodes refused": _count(len(placement.failed), "node"),
    }
    summary = Row("summary", "placement", counts)
    return [*nodes, *_subgraph_rows(placement), *map(_cut_row, placement.cuts), *remarks, summary]


def legality(placement: Placement) -> Check:
    """The verdict on a network: no node of its core may break a rule."""
    failed = placement.failed
    first = f"{failed[0].op.name}: {failed[0].broken[0].finding.reason}" if failed else ""
    return Check("nodes the DPU refuses", len(failed), 0, "node", detail=first)


def summary(placement: Placement, dpu: Dpu, tile_px: int, refusal: str = "") -> list[str]:
    """What a person wants to know, in a few lines.

    Args:
        placement: every node on its device.
        dpu: the DPU that was asked.
        tile_px: side of a tile.
        refusal: why `quantize` does not take a float file; empty where it does.
    """
    lines = [f"device subgraphs: {len(_pieces(placement))}, DPU subgraphs: {placement.dpu_subgraphs}"]
    lines += [
        f"{'to' if cut.onto_dpu else 'from'} the DPU: {cut.tensor}, {_megabytes(cut)} an image as int8"
        for cut in placement.cuts
    ]
    lines += [f"{name}: {text}" for name, text in remarks_on(placement, dpu, tile_px).items()]
    if placement.note:
        lines.append(placement.note)
        lines.append(f"'quantize' does not take it: {refusal}" if refusal else "'quantize' takes it")
    if placement.failed:
        lines.append(f"check FAILED: {legality(placement)}")
    else:
        lines.append("check passed: the core runs whole on the DPU")
    return lines


def step_legality(steps: Sequence[Step]) -> Check:
    """The verdict on the traditional chain: how many of its steps the DPU refuses."""
    broken = [step for step in steps if step.broken]
    first = f"{broken[0].purpose}: {broken[0].broken[0].finding.reason}" if broken else ""
    return Check("steps the DPU refuses", len(broken), 0, "step", detail=first)


def step_rows(step: Step) -> list[Row]:
    """One row for a step of the traditional chain that keeps the rules, one for each rule that another breaks."""
    words = {"operator": step.op.op_type, "device": "CPU" if step.broken else "DPU"}
    return _rows(step.purpose, words, step.broken)


def _node_rows(node: PlacedNode) -> list[Row]:
    words = {"operator": node.op.op_type, "part": node.part, "device": node.device}
    return _rows(node.op.name, words, node.broken)


def _rows(name: str, words: Mapping[str, str], broken: tuple[Broken, ...]) -> list[Row]:
    if not broken:
        return [Row("nodes", name, {}, words)]
    return [
        Row("nodes", name, {}, {**words, "rule": b.text, "reason": b.finding.reason, "remedy": b.finding.remedy})
        for b in broken
    ]


def _subgraph_rows(placement: Placement) -> list[Row]:
    rows = []
    for number, members in _pieces(placement).items():
        words = {"device": members[0].device, "first": members[0].op.name, "last": members[-1].op.name}
        rows.append(Row("subgraphs", f"subgraph {number}", {"nodes": _count(len(members), "node")}, words))
    return rows


def _pieces(placement: Placement) -> dict[int, list[PlacedNode]]:
    """The nodes of each subgraph."""
    members: dict[int, list[PlacedNode]] = {}
    for node in placement.nodes:
        members.setdefault(node.subgraph, []).append(node)
    return members


def _cut_row(cut: Cut) -> Row:
    unit = "byte/image"
    size = unavailable(unit, "its shape is unknown") if cut.size_bytes is None else _count(cut.size_bytes, unit)
    return Row("cuts", cut.tensor, {"size": size}, {"direction": "onto the DPU" if cut.onto_dpu else "off the DPU"})


def _megabytes(cut: Cut) -> str:
    return "a size unknown" if cut.size_bytes is None else f"{cut.size_bytes / 1e6:.2f} MB"


def _count(value: int, unit: str) -> Figure:
    return predicted(value, unit, (value, value), SOURCE)


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
