"""The checker's findings as rows of results and as a few lines."""

from collections.abc import Mapping, Sequence

from deploy.dpu.board import Dpu
from deploy.dpu.operators import Broken
from deploy.dpu.placement import Cut, PlacedNode, Placement
from deploy.dpu.remarks import remarks_on
from deploy.dpu.traditional import Step
from deploy.results import Figure, Row, predicted, unavailable
from quant.checks import Check

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
