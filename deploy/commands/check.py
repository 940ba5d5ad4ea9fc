"""`beers-deploy check`: can the DPU run this network? Each node, the rules it breaks, and what to change."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deploy.commands.shared import BOARDS, refuse, say
from profiles.target import DEFAULT_TARGET

if TYPE_CHECKING:
    from deploy.dpu.board import Dpu

EXAMPLE = "check network.onnx --target zcu102 --config B4096"
TRADITIONAL = Path("traditional")
TILE_PX = 640


def check(
    context: typer.Context,
    model: Annotated[
        Path | None,
        typer.Argument(
            metavar="[MODEL]",
            help="ONNX network: float, INT8 or board core, anyone's; 'traditional' for the operators of that chain; "
            "the shipped INT8 one if none.",
        ),
    ] = None,
    target: Annotated[str, typer.Option(help=f"Profile of a board with a DPU: {BOARDS}.")] = DEFAULT_TARGET,
    config: Annotated[
        str | None, typer.Option(help="DPU configuration that the profile lists; the target's own if none.")
    ] = None,
    tile: Annotated[
        int | None,
        typer.Option(min=1, max=8192, help="Tile side in pixels; the network's own if it has one, else 640."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Draw the graph here, coloured by device: a .svg or .html file.")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write the findings here.")] = None,
) -> None:
    """Place every node of a network on the host, the DPU or the CPU; exit code 1 if the DPU cannot run its part."""
    from deploy.dpu.board import load_dpu
    from deploy.dpu.checker.picture import require_picture
    from deploy.networks import int8_file
    from model.io.files import require_writable
    from model.shipped import SENSOR
    from profiles import load_sensor

    if model == TRADITIONAL:
        remedy = "leave the option out, or give a network"
        refuse(context, ["picture", "tile"], expected="none with 'traditional'", got="one", remedy=remedy)
    require_picture(picture)
    chain = model == TRADITIONAL
    path = None if chain else int8_file(model, load_sensor(SENSOR), partial(say, err=True))
    require_writable(picture, json, inputs=(path, Path(target)))
    dpu = load_dpu(target, config)
    if not (_traditional(dpu, json) if path is None else _network(path, dpu, tile, picture, json)):
        raise typer.Exit(1)


def _network(path: Path, dpu: "Dpu", tile: int | None, picture: Path | None, json: Path | None) -> bool:
    """Judge a file; whether its core runs whole on the DPU."""
    from deploy.dpu.checker.picture import write_picture
    from deploy.dpu.checker.placement import place
    from deploy.dpu.checker.table import legality, network_rows, summary
    from deploy.dpu.reading import network_of, own_tile_px
    from deploy.results import Document, print_rows
    from quant.graph import refusal
    from quant.onnx_file import load_onnx

    model = load_onnx(path, to_run=False)
    tile_px = tile or own_tile_px(model) or TILE_PX
    placement = place(network_of(model, tile_px, str(path)), dpu)
    title = f"{path.name} on {dpu.target.name} {dpu.name}, tile {tile_px}"
    rows = network_rows(placement, dpu, tile_px)
    print_rows(title, [row for row in rows if row.table == "nodes"])
    if picture is not None:
        write_picture(placement, title, picture)
    arguments = {"target": dpu.target.name, "config": dpu.name, "tile": tile_px}
    Document("check", arguments, (path,), tuple(rows), (legality(placement),)).write(json)
    for line in summary(placement, dpu, tile_px, refusal(model) if placement.note else ""):
        say(line)
    return not placement.failed


def _traditional(dpu: "Dpu", json: Path | None) -> bool:
    """Judge the operators of the traditional chain; whether the DPU could run them all."""
    from deploy.dpu.checker.table import step_legality, step_rows
    from deploy.dpu.checker.traditional import judge_traditional, verdict
    from deploy.results import Document, print_rows

    steps = judge_traditional(dpu)
    rows = [row for step in steps for row in step_rows(step)]
    print_rows(f"the traditional chain on {dpu.target.name} {dpu.name}", rows)
    arguments, checks = {"target": dpu.target.name, "config": dpu.name}, (step_legality(steps),)
    Document("check", arguments, (), tuple(rows), checks).write(json)
    say(verdict(steps))
    return not any(step.broken for step in steps)
