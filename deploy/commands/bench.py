"""`beers-deploy bench`: time, throughput, power and efficiency; predicted, measured and published
side by side.
"""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beers_deploy.commands.shared import Json, arguments, refuse, save, say
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles import load_sensor, load_target
from beers_deploy.profiles.errors import OptionError, missing_extra
from beers_deploy.profiles.figures import Row, by_table
from beers_deploy.profiles.sensor_file import REFERENCE
from beers_deploy.profiles.target import DEFAULT_TARGET, MODEL_SUFFIX, board_names, npu_names

if TYPE_CHECKING:
    import numpy as np

    from beers_deploy.bench.board import BoardBench, Tables
    from beers_deploy.bench.swath import Swath


# The same as in deploy.bench.swath, which is imported late.
PAPER_SIZE = "13600x9016"
BOARD_ONLY = (
    "image",
    "full_scale",
    "size",
    "halo",
    "dpu",
    "host_task",
    "measured",
    "no_traditional",
    "within",
    "consistency",
    "layers",
)
HOST_ONLY = ("threads",)
BOARD = f"{DEFAULT_TARGET}{MODEL_SUFFIX}"
HOSTS = ("host", "host-cpu")
BOARDS = ", ".join(board_names())
PREDICTED = (
    "No board was used: the DPU's figures come from a cost model, its power from an assumption."
)
LAYERS = "--layers shows where the time goes, layer by layer; --json holds it always."
NO_PROXY = "Time on this CPU is no proxy for the DPU: here INT8 may even run slower than float."


class HostTask(StrEnum):
    """What the host does with a network's results; the names are those of
    `deploy.dpu.cost.model`.
    """

    copy = "copy"
    argmax = "argmax"
    softmax = "softmax"
    sort = "sort"
    image = "image"


def bench(
    context: typer.Context,
    model: Annotated[
        Path | None,
        typer.Argument(metavar="[MODEL]", help="ONNX network; the shipped INT8 one if none."),
    ] = None,
    target: Annotated[
        str,
        typer.Option(
            help=f"The modelled board ({BOARDS}, or your .toml file), with or without -model "
            "behind its name; "
            f"'all' of them; host, this machine; or {', '.join(npu_names())}, of which figures "
            "are quoted alone."
        ),
    ] = BOARD,
    sensor: Annotated[
        str, typer.Option(help="Sensor of a shipped network: a profile, your .toml file, or blind.")
    ] = SENSOR,
    image: Annotated[
        Path | None, typer.Option(help="Mono image of at most 12 bits: the swath.")
    ] = None,
    full_scale: Annotated[
        float | None, typer.Option(help="Pixel value of --image that is full scale; 4095 if none.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(help=f"Width x height of the swath in pixels; {PAPER_SIZE} if none."),
    ] = None,
    tile: Annotated[
        str, typer.Option(help="Tile side in pixels; several with commas are swept.")
    ] = "640",
    halo: Annotated[
        str, typer.Option(help="Context around a tile: 'exact' (no seams) or pixels.")
    ] = "exact",
    dpu: Annotated[
        str | None, typer.Option(help="DPU configuration, such as C32B3; 'all' sweeps the board's.")
    ] = None,
    host_task: Annotated[
        HostTask | None,
        typer.Option(
            help="What the host does with the results where the file does not tell: read them "
            "(copy), the best of "
            "classes (argmax, softmax), boxes (sort), an image."
        ),
    ] = None,
    measured: Annotated[
        Path | None,
        typer.Option(
            help="JSON list of your board's runs: the cost model is corrected by them first."
        ),
    ] = None,
    no_traditional: Annotated[
        bool,
        typer.Option(
            "--no-traditional", help="Do not measure the traditional pipeline on this processor."
        ),
    ] = False,
    within: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Seconds that the swath may take: which is the smallest DPU that meets them?",
        ),
    ] = None,
    consistency: Annotated[
        bool,
        typer.Option(
            "--consistency/--no-consistency",
            help="Count the consistency step on the board's processor.",
        ),
    ] = True,
    layers: Annotated[
        bool, typer.Option("--layers", help="Show where the time goes, layer by layer.")
    ] = False,
    threads: Annotated[
        int, typer.Option(min=0, help="Threads of the host's runtime; 0 takes every core.")
    ] = 0,
    json: Json = None,
) -> None:
    """Compare a network on the DPU with the traditional pipeline and with the paper's figures."""
    from beers_deploy.bench.board import bench_board
    from beers_deploy.bench.tables import parse_tiles, quoted_rows
    from beers_deploy.dpu.board import ALL
    from beers_deploy.dpu.cost.model import TASKS
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.network import Network
    from beers_deploy.results import Table, inputs_of, print_rows, require_same

    tiles = parse_tiles(tile)
    here = target in HOSTS
    board = target.removesuffix(MODEL_SUFFIX)
    _refuse_unused(context, here)
    require_writable(json, inputs=(model, image, measured, Path(target), Path(sensor)))
    sensor_profile = load_sensor(sensor)
    network = Network.load(model, sensor=sensor_profile, int8=True)
    # The digests are those of the files that are read from here on.
    inputs = inputs_of(image, measured) if json else ()
    if here:
        from beers_deploy.bench.host import host_rows

        rows = host_rows(network, load_target("host-cpu"), _single(tiles), threads, sensor_profile)
        for table, part in by_table(rows).items():
            print_rows(f"{network.input.name} on this machine: {table}", part)
        say(NO_PROXY)
    elif board != ALL and (profile := load_target(board)).npu:
        refuse(
            context,
            BOARD_ONLY,
            expected=f"none with {profile.name}, for which nothing is predicted",
            got="one",
        )
        rows = quoted_rows(network.name, profile)
        print_rows(
            f"{network.input.name} on {profile.name}: nothing is predicted; published are other "
            "networks",
            rows,
        )
    else:
        task = next((name for name in TASKS if name == host_task), None)
        prediction = bench_board(
            network,
            board,
            image=image,
            full_scale=full_scale,
            size=size,
            tiles_px=tiles,
            halo=halo,
            config=dpu,
            measured=measured,
            within_s=within,
            host_task=task,
            sensor=sensor_profile if network.weights is not None else None,
            consistency=consistency,
        )
        for title, part in (*(_required_layers(prediction) if layers else []), *prediction.shown):
            print_rows(title, part)
        for note in (
            *prediction.notes,
            PREDICTED,
            *([LAYERS] if prediction.layers and not layers else []),
        ):
            say(note)
        rows = prediction.rows
        # This takes seconds and loads torch, so all predictions are shown first.
        if not no_traditional and prediction.swath is not None:
            try:
                rows = [*rows, _traditional_row(prediction.dn, prediction.swath)]
                print_rows("the traditional pipeline, measured on crops here", rows[-1:])
            except ImportError as error:
                say(
                    "The traditional pipeline is not measured here: "
                    f"{missing_extra(error, 'bench')}"
                )
    require_same(inputs, image, measured)
    save(Table("bench", arguments(), (network.input, *inputs), tuple(rows)), json)


def _required_layers(prediction: "BoardBench") -> "Tables":
    if not prediction.layers:
        expected = "one --target, --tile and --dpu, and no --within"
        raise OptionError("--layers", expected=expected, got="a comparison", remedy="choose one")
    return prediction.layers


def _traditional_row(dn: "np.ndarray | None", swath: "Swath") -> "Row":
    """Measured here: seconds, and torch is loaded for it; so it comes when all predictions have
    been shown.
    """
    from beers_deploy.bench.traditional import drawn_acquisition, measure_chain

    sensors = load_sensor(SENSOR), load_sensor(REFERENCE)
    acquisition = drawn_acquisition(swath, *sensors) if dn is None else dn
    return measure_chain(acquisition, *sensors).row(swath)


def _refuse_unused(context: typer.Context, here: bool) -> None:
    """Refuse the options of the other target, and a size or a scale that no image asks for."""
    other_target = "the modelled board" if here else "--target host"
    expected = f"{other_target} beside it"
    remedy = f"leave it out, or take {other_target}"
    refuse(
        context,
        BOARD_ONLY if here else HOST_ONLY,
        expected=expected,
        got="the other target",
        remedy=remedy,
    )
    if context.params["image"] is None:
        refuse(context, ["full_scale"], expected="--image beside it")
    else:
        refuse(
            context,
            ["size"],
            expected="none with --image",
            got="both",
            remedy="give one of the two",
        )


def _single(tiles: list[int]) -> int:
    if len(tiles) > 1:
        expected = "one size with --target host"
        remedy = "run it once a size"
        raise OptionError("--tile", expected=expected, got=str(tiles), remedy=remedy)
    return tiles[0]
