"""`beers-deploy bench`: time, throughput, power and efficiency; predicted, measured and published side by side."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from deploy.bench import Swath
    from deploy.results import Row

EXAMPLE = "bench --target vck190-model --size 13600x9016 --config C32B3"

PAPER_SIZE = "13600x9016"
PREDICTED = "No board was used: the DPU's figures come from a cost model, its power from an assumption."
NO_PROXY = "Time on this CPU is no proxy for the DPU: here INT8 may even run slower than float."


class Target(StrEnum):
    """What the figures are about."""

    vck190_model = "vck190-model"
    host = "host"


def bench(
    model: Annotated[
        Path | None, typer.Argument(metavar="[MODEL]", help="ONNX network; the shipped INT8 one if none.")
    ] = None,
    target: Annotated[Target, typer.Option(help="The modelled board, or this machine.")] = Target.vck190_model,
    image: Annotated[Path | None, typer.Option(help="Mono image of at most 12 bits: the swath.")] = None,
    size: Annotated[str | None, typer.Option(help=f"Size of the swath in pixels; {PAPER_SIZE} if none.")] = None,
    tile: Annotated[int, typer.Option(min=16, help="Tile side in pixels.")] = 640,
    halo: Annotated[str, typer.Option(help="Context around a tile: 'exact' (no seams) or pixels.")] = "exact",
    config: Annotated[str | None, typer.Option(help="DPU configuration, C32B1 to C64B5.")] = None,
    budget: Annotated[
        float, typer.Option(min=0, help="Seconds that the traditional pipeline may take to be run on a whole image.")
    ] = 60.0,
    threads: Annotated[int, typer.Option(min=0, help="Threads of the host's runtime; 0 takes every core.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Compare a network on the DPU with the traditional pipeline on this CPU and with the paper's figures."""
    from deploy.defaults import default_int8
    from deploy.measure import host_rows
    from deploy.results import Document
    from deploy.tables import print_rows
    from model.files import require_writable
    from profiles import load_target

    require_writable(json)
    path = model or default_int8()
    if target is Target.host:
        rows = host_rows(path, load_target("host-cpu"), tile, threads)
        print_rows(f"{path.name} on this machine", rows)
        typer.echo(NO_PROXY)
    else:
        rows = _on_the_board(path, image, size, tile, halo, config, budget)
        typer.echo(PREDICTED)
    arguments = {"target": target.value, "size": size, "tile": tile, "halo": halo, "config": config}
    inputs = (path, image) if image else (path,)
    Document("bench", arguments, inputs, tuple(rows)).write(json)


def _on_the_board(
    path: Path, image: Path | None, size: str | None, tile: int, halo: str, config: str | None, budget_s: float
) -> "list[Row]":
    from deploy.bench import layer_rows, predict_file, predicted_rows, published_rows
    from deploy.dpu.board import load_dpu
    from deploy.measure import Sensors, drawn_acquisition, traditional_rows
    from deploy.restore import read_acquisition
    from deploy.tables import print_rows
    from profiles import load_sensor

    dpu, sensors = (
        load_dpu("vck190", config),
        Sensors(load_sensor("pleiades-degraded"), load_sensor("pleiades-reference")),
    )
    dn = read_acquisition(image) if image else None
    swath = _swath(path, dn.shape if dn is not None else None, size, tile, halo)
    prediction = predict_file(path, dpu, tile)
    layers = layer_rows(prediction)
    print_rows(f"{path.name}, one batch on {dpu.name}", layers)
    rows = predicted_rows(path.stem, prediction, swath, dpu)
    rows += traditional_rows(dn if dn is not None else drawn_acquisition(swath, sensors), swath, sensors, budget_s)
    rows += published_rows()
    if prediction.note:
        typer.echo(prediction.note)
    print_rows(f"{swath.width_px} x {swath.height_px} pixels in tiles of {tile}", rows)
    return [*rows, *layers]


def _swath(path: Path, shape: tuple[int, ...] | None, size: str | None, tile: int, halo: str) -> "Swath":
    from deploy.bench import Swath
    from deploy.restore import parse_halo
    from profiles.errors import OptionError
    from quant.onnx_file import load_onnx
    from quant.radius import receptive_radius_px

    if shape is not None and size is not None:
        raise OptionError("--size", expected="none with --image", got=size, remedy="give one of the two")
    width_px, height_px = (shape[1], shape[0]) if shape else parse_size(size or PAPER_SIZE)
    halo_px = parse_halo(halo, receptive_radius_px(load_onnx(path))) if halo == "exact" else parse_halo(halo, 0)
    return Swath(width_px, height_px, tile, halo_px)


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
