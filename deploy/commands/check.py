"""`beers-deploy check`: can the DPU run this network? Each node, the rules it breaks, and what to change."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beers_deploy.commands.shared import BOARDS, say
from beers_deploy.profiles import load_sensor
from beers_deploy.profiles.target import DEFAULT_TARGET

if TYPE_CHECKING:
    from beers_deploy.dpu.board import Dpu

EXAMPLE = "check network.onnx --target zcu102 --config B4096"
TILE_PX = 640


def check(
    model: Annotated[
        Path | None,
        typer.Argument(
            metavar="[MODEL]",
            help="ONNX network: float, INT8 or board core, anyone's; the shipped INT8 one if none.",
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
    from beers_deploy.dpu.board import load_dpu
    from beers_deploy.dpu.checker.picture import require_picture
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.model.shipped import SENSOR
    from beers_deploy.networks import int8_file

    require_picture(picture)
    path = int8_file(model, load_sensor(SENSOR), partial(say, err=True))
    require_writable(picture, json, inputs=(path, Path(target)))
    if not _network(path, load_dpu(target, config), tile, picture, json):
        raise typer.Exit(1)


def _network(path: Path, dpu: "Dpu", tile: int | None, picture: Path | None, json: Path | None) -> bool:
    """Judge a file; whether its core runs whole on the DPU."""
    from beers_deploy.dpu.checker.picture import write_picture
    from beers_deploy.dpu.checker.placement import place
    from beers_deploy.dpu.checker.table import legality, network_rows, summary
    from beers_deploy.dpu.reading import network_of, own_tile_px
    from beers_deploy.quant.graph import refusal
    from beers_deploy.quant.onnx_file import load_onnx
    from beers_deploy.results import Document, print_rows

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
