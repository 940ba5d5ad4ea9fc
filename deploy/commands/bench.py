"""`beers-deploy bench`: time, throughput, power and efficiency; predicted, measured and published side by side."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deploy.commands.shared import refuse, say

if TYPE_CHECKING:
    from deploy.bench.tables import Swath
    from deploy.dpu.board import Dpu
    from profiles.figures import Row

EXAMPLE = "bench --target vck190-model --size 13600x9016 --config C32B3"

PAPER_SIZE = "13600x9016"
BOARD_ONLY = ("image", "full_scale", "size", "halo", "config", "measured", "budget")
HOST_ONLY = ("threads",)
BOARD, HOSTS = "vck190-model", ("host", "host-cpu")
PREDICTED = "No board was used: the DPU's figures come from a cost model, its power from an assumption."
TRAFFIC = "LdFM, StFM: feature maps loaded and stored, an image; LdWB: weights and biases loaded, a batch."
NO_PROXY = "Time on this CPU is no proxy for the DPU: here INT8 may even run slower than float."


def bench(
    context: typer.Context,
    model: Annotated[
        Path | None, typer.Argument(metavar="[MODEL]", help="ONNX network; the shipped INT8 one if none.")
    ] = None,
    target: Annotated[
        str, typer.Option(help="The modelled board, with or without -model behind its name; or host, this machine.")
    ] = BOARD,
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
    from deploy.bench.host import host_rows
    from deploy.bench.tables import parse_tiles
    from deploy.results import Document, print_rows
    from model.io.files import require_writable
    from model.shipped import int8_file
    from profiles import load_target
    from profiles.figures import by_table

    path, tiles, here = int8_file(model), parse_tiles(tile), _is_host(target)
    _refuse_unused(context, here)
    require_writable(json, inputs=(path, image, measured))
    if here:
        rows = host_rows(path, load_target("host-cpu"), _single(tiles), threads)
        for table, part in by_table(rows).items():
            print_rows(f"{path.name} on this machine: {table}", part)
        say(NO_PROXY)
    else:
        rows = _on_the_board(path, _Request(image, full_scale, size, tiles, halo, config, measured), budget)
        say(PREDICTED)
    arguments = {
        "target": target,
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


@dataclass(frozen=True)
class _Request:
    """What the user wants to know of the board."""

    image: Path | None
    full_scale: float | None
    size: str | None
    tiles_px: list[int]
    halo: str
    config: str | None
    measured: Path | None


def _on_the_board(path: Path, request: _Request, budget_s: float) -> "list[Row]":
    from deploy.bench.host import Sensors, drawn_acquisition, traditional_rows
    from deploy.bench.tables import published_rows
    from deploy.results import print_rows
    from model.io.images import read_acquisition
    from model.shipped import SENSOR
    from profiles.sensor import REFERENCE, load_sensor

    sensors = Sensors(load_sensor(SENSOR), load_sensor(REFERENCE))
    dn = read_acquisition(request.image, request.full_scale, None) if request.image else None
    swath = _swath(path, dn.shape if dn is not None else None, request)
    boards, refitted = _boards(request)
    single = len(boards) == len(request.tiles_px) == 1
    rows, layers = _single_rows(path, boards[0], swath) if single else _sweep(path, boards, request.tiles_px, swath)
    rows += traditional_rows(dn if dn is not None else drawn_acquisition(swath, sensors), swath, sensors, budget_s)
    rows += published_rows()
    print_rows(f"{swath.width_px} x {swath.height_px} pixels in tiles of {swath.tile_px}", rows)
    return [*rows, *layers, *refitted]


def _single_rows(path: Path, dpu: "Dpu", swath: "Swath") -> "tuple[list[Row], list[Row]]":
    """The rows of the swath and of the layers, these printed."""
    from deploy.bench.tables import layer_rows, predict_file, predicted_rows
    from deploy.results import print_rows

    prediction = predict_file(path, dpu, swath.tile_px)
    layers = layer_rows(prediction, dpu)
    print_rows(f"{path.name}, one batch on {dpu.name}", layers)
    say(TRAFFIC)
    if prediction.note:
        say(prediction.note)
    return predicted_rows(path.stem, prediction, swath, dpu), layers


def _sweep(path: Path, boards: "list[Dpu]", tiles_px: list[int], swath: "Swath") -> "tuple[list[Row], list[Row]]":
    """No rows of one swath, but those of the sweep, printed."""
    from deploy.bench.tables import sweep_rows
    from deploy.results import print_rows

    rows = sweep_rows(path, swath, boards, tiles_px)
    size = f"{swath.width_px} x {swath.height_px} pixels"
    print_rows(f"{path.name}, {size} in whole tiles, halo {swath.halo_px} px", rows)
    return [], rows


def _boards(request: _Request) -> "tuple[list[Dpu], list[Row]]":
    """The configurations asked for; their constants refitted where runs are given, and the rows that say so."""
    from deploy.dpu.board import load_dpu
    from deploy.dpu.cost.validation import refit
    from deploy.results import print_rows
    from profiles import load_target

    names = list(load_target("vck190").configurations) if request.config == "all" else [request.config]
    boards = [load_dpu("vck190", name) for name in names]
    if request.measured is None:
        return boards, []
    found = refit(request.measured, boards[0])
    constants, runs = found.constant_rows(), found.run_rows()
    print_rows(found.source, constants)
    print_rows("your runs", runs)
    return [found.applied(dpu) for dpu in boards], [*constants, *runs]


def _single(tiles: list[int]) -> int:
    from profiles.errors import OptionError

    if len(tiles) > 1:
        raise OptionError(
            "--tile", expected="one size with --target host", got=str(tiles), remedy="run it once a size"
        )
    return tiles[0]


def _swath(path: Path, shape: tuple[int, ...] | None, request: _Request) -> "Swath":
    from deploy.bench.tables import Swath
    from deploy.restoration.options import parse_halo
    from quant.onnx_file import load_onnx, receptive_radius_px

    halo, tile = request.halo, request.tiles_px[0]
    width_px, height_px = (shape[1], shape[0]) if shape else parse_size(request.size or PAPER_SIZE)
    halo_px = parse_halo(halo, receptive_radius_px(load_onnx(path))) if halo == "exact" else parse_halo(halo, 0)
    return Swath(width_px, height_px, tile, halo_px)


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


def parse_size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT in pixels as (width, height).

    Raises:
        OptionError: another text.
    """
    from profiles.errors import OptionError

    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() and int(part) > 0 for part in parts):
        remedy = f"write it as {PAPER_SIZE}"
        raise OptionError("--size", expected="WIDTHxHEIGHT in pixels", got=repr(text), remedy=remedy)
    return int(parts[0]), int(parts[1])
