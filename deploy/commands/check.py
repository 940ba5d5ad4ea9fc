"""`beers-deploy check`: can the DPU run this network?

Each node, the rules it breaks, and what to change.
"""

from pathlib import Path
from typing import Annotated

import typer

from beers_deploy.commands.shared import RULED, Json, save, say
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.target import DEFAULT_TARGET, load_target


def check(
    model: Annotated[
        Path | None,
        typer.Argument(
            metavar="[MODEL]",
            help="ONNX network: float, INT8 or board core, anyone's; the shipped INT8 one if none.",
        ),
    ] = None,
    target: Annotated[
        str, typer.Option(help=f"Profile of a board with a DPU or NPU: {RULED}.")
    ] = DEFAULT_TARGET,
    dpu: Annotated[
        str | None,
        typer.Option(help="DPU configuration that the profile lists; the target's own if none."),
    ] = None,
    tile: Annotated[
        int | None,
        typer.Option(
            min=1, max=8192, help="Tile side in pixels; the network's own if it has one, else 640."
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(help="Draw the graph here, coloured by device: a .svg or .html file."),
    ] = None,
    json: Json = None,
) -> None:
    """Place every node on the host, the DPU or the CPU; exit code 1 if the DPU cannot run its part.

    Of an NPU, whose limits nobody publishes, nodes are placed by AMD's table of operators alone.
    """
    from beers_deploy.dpu.checker.picture import require_picture, write_picture
    from beers_deploy.dpu.checker.table import check as placed
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.model.shipped import VARIANT
    from beers_deploy.network_files import in_int8
    from beers_deploy.results import print_rows

    require_picture(picture)
    require_writable(picture, json, inputs=(model, Path(target)))
    if picture and load_target(target).npu:
        remedy = "leave it out: where a node of this board goes is not known"
        raise OptionError("--picture", expected="a board with a DPU", got=target, remedy=remedy)
    table = placed(in_int8(model or Path(VARIANT)), target, dpu=dpu, tile=tile)
    print_rows(table.title, [row for row in table.rows if row.table == "nodes"])
    if picture is not None:
        write_picture(table.placement, table.title, picture)
    save(table, json)
    for line in table.lines:
        say(line)
    if not table:
        raise typer.Exit(1)
