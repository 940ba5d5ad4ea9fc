"""`beers-deploy restore`: a raw image in, the restored one out, of any size."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beers_deploy.commands.shared import (
    Json,
    Restoring,
    Tile,
    arguments,
    refuse,
    save,
    say,
)
from beers_deploy.model.raster.compression import Compression
from beers_deploy.profiles import load_sensor, load_target
from beers_deploy.profiles.errors import OptionError, optional
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import BLIND
from beers_deploy.profiles.target import DEFAULT_TARGET, TILE_PX
from beers_deploy.restoration.options import Method, Options, Runtime

if TYPE_CHECKING:
    from beers_deploy.network import Network

NETWORK_ONLY = (
    "network",
    "tile",
    "halo",
    "resume",
    "runtime",
    "threads",
    "scheduler",
    "consistency",
    "exposure",
    "dry_run",
)
"""Options of which the traditional pipeline takes none."""


def restore(
    context: typer.Context,
    image: Annotated[
        Path,
        typer.Argument(metavar="IN", help="Image: TIFF or what GDAL reads, of any size, or PNG."),
    ],
    out: Annotated[
        Path | None, typer.Argument(metavar="OUT", help="TIFF to write, of the type of IN.")
    ] = None,
    network: Restoring = None,
    method: Annotated[
        Method, typer.Option(help="A network, or the traditional pipeline of --sensor.")
    ] = Method.network,
    sensor: Annotated[
        str | None,
        typer.Option(
            help="The sensor of IN, a profile's name or your .toml file: shipped networks and "
            "the consistency step "
            "use it; B0=a.toml,B1=b.toml for each band; blind if none."
        ),
    ] = None,
    tile: Tile = TILE_PX,
    halo: Annotated[
        str, typer.Option(help="Context around a tile: 'exact' (no seams) or pixels.")
    ] = "exact",
    full_scale: Annotated[
        float | None,
        typer.Option(
            help="Pixel value that is full scale; else what IN states, the bits of --sensor, or "
            "12 bits. "
            "8-bit and 0..1 pixels need it."
        ),
    ] = None,
    runtime: Annotated[
        Runtime,
        typer.Option(help="What runs the network; openvino is 1.0 to 1.9 times as fast."),
    ] = Runtime.onnxruntime,
    threads: Annotated[
        int,
        typer.Option(
            min=0,
            help="Threads; 0 takes every core, or one for each thread of a scheduler's workers.",
        ),
    ] = 0,
    compression: Annotated[
        Compression, typer.Option(help="Of the output, lossless.")
    ] = Compression.zlib,
    memory: Annotated[
        float | None,
        typer.Option(min=0, help="Budget of this process in GB; what is free if none."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Dask scheduler whose workers run the network, such as tcp://host:8786."),
    ] = None,
    cog: Annotated[
        bool,
        typer.Option(
            "--cog", help="Write OUT as a Cloud-Optimised GeoTIFF: tiles, overviews, what was done."
        ),
    ] = False,
    stac: Annotated[
        Path | None, typer.Option(help="Write a STAC item of OUT here; with --cog.")
    ] = None,
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="Restore a restored IN, follow an index out of its folder, write any result.",
        ),
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace OUT if it exists.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show IN, the plan and the time instead; no OUT.")
    ] = False,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict", help="Refuse IN whose pixels contradict --sensor, instead of saying so."
        ),
    ] = False,
    consistency: Annotated[
        bool,
        typer.Option(
            "--consistency/--no-consistency",
            help="Make OUT agree with IN at low spatial frequencies, where --sensor is given.",
        ),
    ] = True,
    exposure: Annotated[
        bool,
        typer.Option(
            "--exposure/--no-exposure",
            help="Restore dark parts at a higher exposure (shipped networks).",
        ),
    ] = True,
    fix_detectors: Annotated[
        str | None,
        typer.Option(
            help="Interpolate faulty pixels before restoration: 'found', which writes their "
            "list beside OUT as "
            "NAME.detectors.csv, or such a list: lines column,row, with * as the row for a "
            "whole column."
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a run that was stopped or killed.")
    ] = False,
    json: Json = None,
) -> None:
    """Restore an image tile by tile, bit for bit as if it were restored whole.

    The image is read and written by rows, so memory does not grow with its height. OUT has the
    scale of IN. Bands are restored one by one. Georeference, RPCs, missing pixels (NaN, the nodata
    value, or a mask) and alpha are kept. A shipped network, in float32 (NAME) or INT8 (NAME-int8),
    is conditioned on --sensor, and without it on the middle of its range. IN's own noise and edges
    are compared with --sensor, and stripes, dead and hot columns and pixels are warned of. The
    consistency step keeps the mean and the flux of points; exposure lets INT8 restore dark parts as
    well as bright ones. --method traditional takes about a minute a megapixel and band on two
    cores, and is not resumable. Until OUT is finished its rows lie in .OUT.part.
    """
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.model.raster.reader import require_image_file
    from beers_deploy.network import Network
    from beers_deploy.restoration.bands import parse_sensors
    from beers_deploy.restoration.detectors.fault_list import FOUND, list_beside
    from beers_deploy.restoration.run import restore_file
    from beers_deploy.restoration.stac import write_item
    from beers_deploy.results import Input, Table, print_rows

    # A budget of 0 bytes would count as none.
    budget_bytes = None if memory is None else max(int(memory * 1e9), 1)
    sensors = parse_sensors(sensor or BLIND)
    profiles = (Path(text) for text in sensors.values()) if sensor else ()
    listed = Path(fix_detectors) if fix_detectors and fix_detectors != FOUND else None
    lists = [] if listed is None else [listed]
    # The list of faults is an output of its own where they are searched for.
    found_list = list_beside(out, fix_detectors or "") if out else None
    require_writable(out, json, stac, found_list, inputs=(image, network, listed, *profiles))
    sensor_profiles = {band: load_sensor(text) for band, text in sensors.items()}
    how = Options(
        tile_px=tile,
        halo=halo,
        full_scale=full_scale,
        runtime=runtime,
        threads=threads,
        compression=compression,
        memory_bytes=budget_bytes,
        resume=resume,
        scheduler=scheduler,
        strict=strict,
        cog=cog,
        force=force,
        consistency=consistency,
        fix_detectors=fix_detectors or "",
        sensors=sensor_profiles if sensor else {},
        exposure=exposure,
        method=method,
    )
    _require_item(stac, cog)
    inputs = list[Input]()
    if method is Method.traditional:
        refuse(context, NETWORK_ONLY, expected="none with --method traditional", got="one")
        _require_sensor(sensor)
    target = None if dry_run else _required_out(out, overwrite or resume)
    if method is Method.network:
        require_image_file(image)
        networks = {
            band: Network.load(network, sensor=profile) for band, profile in sensor_profiles.items()
        }
        _say_network(next(iter(networks.values())), sensor, sensor_profiles)
        _require_equal_bits(sensor_profiles, full_scale)
        how = replace(
            how,
            network=next(iter(networks.values())),
            bands={} if "" in networks else networks,
        )
        inputs = [
            each.input._replace(name=f"{each.input.name}, {band}") if band else each.input
            for band, each in networks.items()
        ]
    if target is None:
        _preview(image, how, json, arguments(sensor=sensor or BLIND, image=image.name))
        return
    row = restore_file(image, target, how, say, (json, stac, found_list))
    if stac is not None:
        write_item(target, stac)
    print_rows(f"wrote {target}", [row])
    table = Table("restore", arguments(sensor=sensor or BLIND), (*inputs, image, *lists), (row,))
    save(table, json)


def _required_out(out: Path | None, may_exist: bool) -> Path:
    """Return the output; refuse none, and one that exists."""
    if out is None:
        remedy = "name the file to write, or add --dry-run"
        raise OptionError("OUT", expected="a TIFF's name", got="none", remedy=remedy)
    if out.exists() and not may_exist:
        remedy = "add --overwrite to replace it, or choose another name"
        raise OptionError("OUT", expected="a new file", got=f"{out}, which exists", remedy=remedy)
    return out


def _preview(image: Path, how: Options, json: Path | None, given: dict[str, object]) -> None:
    """Show what an image is, how it would be cut and how long that would take."""
    from beers_deploy.dry_run import preview_row
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.model.raster.index import index_files
    from beers_deploy.network import Network
    from beers_deploy.results import Table, print_rows

    require_writable(json, inputs=index_files(image, how.force))
    row = preview_row(image, how, load_target(DEFAULT_TARGET), log=say)
    print_rows(str(image), [row])
    # The image has no digest here, because the whole file would be read for it.
    save(Table("restore", given, (Network.load(how.network).input,), (row,)), json)


def _require_item(stac: Path | None, cog: bool) -> None:
    """Refuse a STAC item of what is no Cloud-Optimised GeoTIFF, or without its package."""
    if stac is None:
        return
    if not cog:
        raise OptionError(
            "--stac", expected="--cog beside it", got="none", remedy="add it, or leave --stac out"
        )
    optional("pystac", "--stac")


def _say_network(
    network: "Network", sensor: str | None, sensor_profiles: Mapping[str, Sensor]
) -> None:
    """Say which network restores, and for which sensor it was made."""
    if network.weights is not None:
        words = (
            f"told {sensor}"
            if sensor
            else "told no sensor (blind): --sensor tells it yours, and restores better"
        )
        say(f"network: {network.name}, {words}")
    # Only a conditioned network can be given the sensor; any other one was made for its own.
    elif sensor:
        _look_at_network(network, sensor_profiles)


def _require_equal_bits(sensor_profiles: Mapping[str, Sensor], full_scale: float | None) -> None:
    """Refuse sensors of different bits: they decide full scale, one number for all bands."""
    bits = {int(profile.bits.low) for profile in sensor_profiles.values()}
    if len(bits) > 1 and full_scale is None:
        remedy = "give --full-scale, or restore such bands apart"
        raise OptionError(
            "--sensor", expected="sensors of equal bits", got=f"{sorted(bits)}", remedy=remedy
        )


def _look_at_network(network: "Network", sensor_profiles: Mapping[str, Sensor]) -> None:
    """Refuse sensors by band for a network that is for one; say where it was made for another
    sensor.
    """
    from beers_deploy.network_files import other_sensor

    if len(sensor_profiles) > 1:
        expected = "a shipped network, or weights of 'train --conditioned'"
        remedy = "give one sensor for all bands"
        raise OptionError(
            "--sensor",
            expected=expected,
            got=f"{network.label} with a sensor for each band",
            remedy=remedy,
        )
    if doubt := other_sensor(network.model, sensor_profiles[""]):
        say(doubt, err=True)


def _require_sensor(sensor: str | None) -> None:
    if sensor is None:
        remedy = "name a profile ('beers-deploy profiles' lists them) or give your .toml file"
        raise OptionError(
            "--sensor", expected="the sensor that acquired IN", got="none", remedy=remedy
        )
