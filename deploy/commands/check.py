"""`beers-deploy check`: can the DPU run this network? Each node, the rules it breaks, and what to change."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from deploy.dpu.placement import PlacedNode, Placement
    from deploy.results import Row

EXAMPLE = "check network.onnx --target vck190 --config C32B3"


def check(
    model: Annotated[
        Path | None,
        typer.Argument(
            metavar="[MODEL]", help="ONNX network, float, INT8 or board core; the shipped INT8 one if none."
        ),
    ] = None,
    target: Annotated[str, typer.Option(help="Profile of a board with a DPU.")] = "vck190",
    config: Annotated[
        str | None, typer.Option(help="DPU configuration, C32B1 to C64B5; the target's own if none.")
    ] = None,
    tile: Annotated[int, typer.Option(min=1, help="Tile side in pixels.")] = 640,
    json: Annotated[Path | None, typer.Option(help="Write the findings here.")] = None,
) -> None:
    """Place every node of a network on the host, the DPU or the CPU; exit code 1 if the DPU cannot run its part."""
    from deploy.defaults import default_int8
    from deploy.dpu.board import load_dpu
    from deploy.dpu.placement import place
    from deploy.dpu.reading import read_network
    from deploy.results import Document
    from deploy.tables import print_rows

    path, dpu = model or default_int8(), load_dpu(target, config)
    placement = place(read_network(path, tile), dpu)
    rows = [row for node in placement.nodes for row in node_rows(node)]
    print_rows(f"{path.name} on {dpu.target.name} {dpu.name}, tile {tile}", rows)
    arguments = {"target": target, "config": dpu.name, "tile": tile}
    Document("check", arguments, (path,), (*rows, *summary_rows(placement))).write(json)
    for line in summary(placement):
        typer.echo(line)
    if placement.failed:
        raise typer.Exit(1)


def node_rows(node: "PlacedNode") -> "list[Row]":
    """One row for a node that keeps the rules, one for each rule that another breaks."""
    from deploy.results import Row

    words = {"operator": node.op.op_type, "part": node.part, "device": node.device}
    if not node.broken:
        return [Row("nodes", node.op.name, {}, words)]
    return [
        Row(
            "nodes",
            node.op.name,
            {},
            {**words, "rule": broken.text, "reason": broken.finding.reason, "remedy": broken.finding.remedy},
        )
        for broken in node.broken
    ]


def summary_rows(placement: "Placement") -> "list[Row]":
    """The number of DPU subgraphs, and the tensors that cross to and from it."""
    from deploy.results import Row, predicted

    source = "operator rules of the target profile"
    count = len(placement.failed)
    figures = {
        "DPU subgraphs": predicted(n := placement.dpu_subgraphs, "subgraph", (n, n), source),
        "nodes refused": predicted(count, "node", (count, count), source),
    }
    cuts = [
        Row(
            "cuts",
            cut.tensor,
            {"size": predicted(cut.size_bytes, "byte/image", (cut.size_bytes, cut.size_bytes), source)},
            {"direction": "onto the DPU" if cut.onto_dpu else "off the DPU"},
        )
        for cut in placement.cuts
    ]
    return [Row("summary", "placement", figures), *cuts]


def summary(placement: "Placement") -> list[str]:
    """What a person wants to know, in a few lines."""
    lines = [f"DPU subgraphs: {placement.dpu_subgraphs}"]
    lines += [
        f"{'to' if cut.onto_dpu else 'from'} the DPU: {cut.tensor}, {cut.size_bytes / 1e6:.2f} MB an image as int8"
        for cut in placement.cuts
    ]
    if placement.note:
        lines.append(placement.note)
    if placement.failed:
        lines.append(f"check FAILED: {len(placement.failed)} nodes of the core cannot run on the DPU")
    else:
        lines.append("check passed: the core runs whole on the DPU")
    return lines
