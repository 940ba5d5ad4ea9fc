"""`beers-deploy bench`: time, throughput, power and efficiency; predicted, measured and published side by side."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from deploy.commands.shared import refuse, say
from model.shipped import SENSOR

EXAMPLE = "bench --target vck190-model --size 13600x9016 --config C32B3"

PAPER_SIZE = "13600x9016"  # as in deploy.bench.tables, which is imported late
BOARD_ONLY = ("image", "full_scale", "size", "halo", "config", "measured", "budget")
HOST_ONLY = ("threads",)
BOARD, HOSTS = "vck190-model", ("host", "host-cpu")
PREDICTED = "No board was used: the DPU's figures come from a cost model, its power from an assumption."
NO_PROXY = "Time on this CPU is no proxy for the DPU: here INT8 may even run slower than float."


def bench(
    context: typer.Context,
    model: Annotated[
        Path | None, typer.Argument(metavar="[MODEL]", help="ONNX network; the shipped INT8 one if none.")
    ] = None,
    target: Annotated[
        str, typer.Option(help="The modelled board, with or without -model behind its name; or host, this machine.")
    ] = BOARD,
    sensor: Annotated[
        str, typer.Option(help="What a shipped network is specialised to: a profile, your .toml file, or blind.")
    ] = SENSOR,
    image: Annotated[Path | None, typer.Option(help="Mono image of at most 12 bits: the swath.")] = None,
    full_scale: Annotated[
        float | None, typer.Option(help="Pixel value of --image that is full scale; 4095 if none.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(help=f"Width x height of the swath in pixels; {PAPER_SIZE} if none.")
    ] = None,
    tile: Annotated[str, typer.Option(help="Tile side in pixels; several with commas are swept.")] = "640",
    halo: Annotated[str, typer.Option(help="Context around a tile: 'exact' (no seams) or pixels.")] = "exact",
    config: Annotated[str | None, typer.Option(help="DPU configuration, C32B1 to C64B5; 'all' sweeps them.")] = None,
    measured: Annotated[
        Path | None, typer.Option(help="JSON list of your board's runs: the cost model is refitted to them first.")
    ] = None,
    budget: Annotated[
        float, typer.Option(min=0, help="Seconds that the traditional pipeline may take to be run on a whole image.")
    ] = 60.0,
    threads: Annotated[int, typer.Option(min=0, help="Threads of the host's runtime; 0 takes every core.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Compare a network on the DPU with the traditional pipeline on this CPU and with the paper's figures."""
    from deploy.bench.board import BoardRequest, bench_board
    from deploy.bench.host import host_rows
    from deploy.bench.tables import parse_tiles
    from deploy.networks import int8_file
    from deploy.results import Document, print_rows
    from model.io.files import require_writable
    from profiles import load_sensor, load_target
    from profiles.figures import by_table

    tiles, here = parse_tiles(tile), _is_host(target)
    _refuse_unused(context, here)
    path = int8_file(model, load_sensor(sensor), partial(say, err=True))
    require_writable(json, inputs=(path, image, measured))
    if here:
        rows = host_rows(path, load_target("host-cpu"), _single(tiles), threads)
        for table, part in by_table(rows).items():
            print_rows(f"{path.name} on this machine: {table}", part)
        say(NO_PROXY)
    else:
        found = bench_board(path, BoardRequest(image, full_scale, size, tiles, halo, config, measured), budget)
        rows = found.rows
        for title, part in found.shown:
            print_rows(title, part)
        for note in (*found.notes, PREDICTED):
            say(note)
    arguments = {
        "target": target,
        "sensor": sensor,
        "full_scale": full_scale,
        "size": size,
        "tile": tile,
        "halo": halo,
        "config": config,
        "measured": measured.name if measured else None,
    }
    inputs = tuple(file for file in (path, image, measured) if file)
    Document("bench", arguments, inputs, tuple(rows)).write(json)


def _refuse_unused(context: typer.Context, here: bool) -> None:
    """Refuse the options of the other target, and a size or a scale that no image asks for."""
    wanted = "the modelled board" if here else "--target host"
    expected, remedy = f"{wanted} beside it", f"leave it out, or take {wanted}"
    refuse(context, BOARD_ONLY if here else HOST_ONLY, expected=expected, got="the other target", remedy=remedy)
    if context.params["image"] is None:
        refuse(context, ["full_scale"], expected="--image beside it", got="none", remedy="leave it out")
    else:
        refuse(context, ["size"], expected="none with --image", got="both", remedy="give one of the two")


def _single(tiles: list[int]) -> int:
    from profiles.errors import OptionError

    if len(tiles) > 1:
        raise OptionError(
            "--tile", expected="one size with --target host", got=str(tiles), remedy="run it once a size"
        )
    return tiles[0]


def _is_host(target: str) -> bool:
    """Whether this machine is meant, by the name of its profile or as `host`; else the one board that is modelled.

    Raises:
        OptionError: another target.
    """
    from profiles.errors import OptionError
    from profiles.target import MODEL_SUFFIX

    if target.removesuffix(MODEL_SUFFIX) not in (*HOSTS, BOARD.removesuffix(MODEL_SUFFIX)):
        raise OptionError("--target", expected=f"{BOARD} or host", got=repr(target), remedy="pick one")
    return target in HOSTS
