"""`beers-deploy info`: what the tool makes of an image, before it is restored."""

from pathlib import Path
from typing import Annotated

import typer

from beers_deploy.commands.shared import Json, Restoring, Tile, TrustIndex, arguments, save, say
from beers_deploy.profiles import load_sensor, load_target
from beers_deploy.profiles.sensor_file import BLIND
from beers_deploy.profiles.target import DEFAULT_TARGET, TILE_PX
from beers_deploy.restoration.options import Options


def info(
    image: Annotated[
        Path, typer.Argument(metavar="FILE", help="Image, or the index of its tiles.")
    ],
    network: Restoring = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            help="The sensor of FILE, a profile's name or your .toml file; blind if none."
        ),
    ] = None,
    full_scale: Annotated[
        float | None,
        typer.Option(help="Pixel value that is full scale; else what FILE or --sensor states."),
    ] = None,
    tile: Tile = TILE_PX,
    target: Annotated[
        str, typer.Option(help="The modelled board whose time is predicted, or your .toml file.")
    ] = DEFAULT_TARGET,
    trust_index: TrustIndex = False,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict", help="Refuse FILE whose pixels contradict --sensor, instead of saying so."
        ),
    ] = False,
    measure: Annotated[
        bool, typer.Option("--measure", help="Time some tiles here, and predict the whole.")
    ] = False,
    json: Json = None,
) -> None:
    """Say what an image is, how it would be cut and how long that would take.

    Shows size, type, full scale and who states it, place on Earth, missing pixels, and the plan of
    `restore`. Strips of FILE are searched for stripes, dead and hot columns and pixels. --sensor
    reads windows of FILE and holds their noise and edges against what the sensor states. No other
    pixel is read, but of PNG, JPEG and TIFFs of several pages.
    """
    from beers_deploy.info import info_row
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.model.raster.index import index_files
    from beers_deploy.network import Network
    from beers_deploy.results import Table, print_rows

    tiles = index_files(image, trust_index)
    require_writable(
        json, inputs=(image, *tiles, network, Path(sensor) if sensor else None, Path(target))
    )
    profile = load_sensor(sensor or BLIND)
    chosen = Network.load(network, sensor=profile)
    sensors = {"": profile} if sensor else {}
    options = Options(
        chosen, tile, full_scale=full_scale, trust_index=trust_index, sensors=sensors, strict=strict
    )
    row = info_row(image, options, load_target(target), measure, say)
    print_rows(str(image), [row])
    # FILE has no digest here, because the whole file would be read for it.
    given = arguments(sensor=sensor or BLIND, image=image.name)
    save(Table("info", given, (chosen.input,), (row,)), json)
