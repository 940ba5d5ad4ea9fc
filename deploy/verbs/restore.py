"""`restore`: a raw image in, the restored one out, of any size."""

import os
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from beers_deploy.model.levels import Level
from beers_deploy.model.raster.compression import Compression
from beers_deploy.profiles.errors import OptionError, optional
from beers_deploy.profiles.shipped import DEFAULT_TARGET, TILE_PX
from beers_deploy.verbs.parameters import (
    BandSensors,
    Halo,
    Image,
    Interval,
    NetworkLike,
    OutputFile,
    Progress,
    PythonOnly,
)
from beers_deploy.verbs.verb import changed, path_or_none, refuse_with, refuse_without, verb

if TYPE_CHECKING:
    from beers_deploy.restoration.output import Output
    from beers_deploy.restoration.prepare import NetworkPipeline, Pipeline
    from beers_deploy.restoration.radiometry import Reading
    from beers_deploy.restoration.run import Run
    from beers_deploy.results import Table


@verb
def restore(
    image: Image,
    out: OutputFile | None = None,
    *,
    network: NetworkLike | None = None,
    method: Literal["network", "traditional"] = "network",
    quality: Literal["fast", "standard", "best"] = "standard",
    sensor: BandSensors = "blind",
    tile: Annotated[int, Interval(ge=16)] = TILE_PX,
    halo: Halo = "exact",
    full_scale: float | None = None,
    nodata: Annotated[float, PythonOnly()] | None = None,
    runtime: Literal["onnxruntime", "openvino"] = "onnxruntime",
    threads: Annotated[int, Interval(ge=0)] = 0,
    compression: Compression = "zlib",
    memory: Annotated[float, Interval(ge=0)] | None = None,
    scheduler: str | None = None,
    cog: bool = False,
    stac: OutputFile | None = None,
    self_check: OutputFile | None = None,
    interval: Level | None = None,
    view: OutputFile | None = None,
    strict: bool = False,
    consistency: bool = True,
    exposure: bool = True,
    fix_detectors: str | None = None,
    force: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    dry_run: bool = False,
    progress: Progress = None,
) -> Any:
    """Restore an image of raw digital numbers tile by tile, as if it were restored whole.

    A file is read and written by rows, so memory does not grow with its height. OUT has the scale
    and the pixel type of IMAGE (float32 for floats), and keeps its georeference, RPCs, missing
    pixels and alpha. Bands are restored one by one. A warning says where noise, edges or detectors
    contradict the sensor.

    Args:
        image: image file of any size: TIFF, or what GDAL reads. In Python also an array (H, W) or
            (bands, H, W) of NumPy, torch, Dask or xarray, or a dataset of rasterio.
        out: TIFF to write.
        network: ONNX network, or a shipped name (NAME in float32, NAME-int8 in INT8);
            convbeers-s-int8 by default.
        method: a network, or the traditional pipeline, which takes about a minute for a megapixel
            and cannot be resumed.
        quality: quality of the traditional pipeline.
        sensor: sensor that acquired the image, which shipped networks and the consistency step use:
            name or .toml file; B0=a.toml,B1=b.toml for each band; blind if unknown.
        tile: longest side of a tile in pixels.
        halo: context around each tile in pixels, or 'exact' (no seams).
        full_scale: pixel value at full scale; by default from the image, the bits of the sensor,
            or 12 bits. Needed for 8-bit and 0..1 pixels.
        nodata: value of missing pixels of an array; a file states its own.
        runtime: library that runs the network; openvino is 1.0 to 1.9 times as fast.
        threads: threads of the runtime; 0 uses all cores, or one for each thread of a scheduler's
            workers.
        compression: lossless compression of the output.
        memory: budget of this process in GB; the free memory by default.
        scheduler: address of a Dask scheduler whose workers run the network, such as
            tcp://host:8786.
        cog: write a Cloud-Optimised GeoTIFF, with overviews and a record of the processing.
        stac: STAC item of the output to write; needs `cog`.
        self_check: TIFF to write: for each block of 64 x 64 pixels, whether the result, blurred as
            the sensor blurs, agrees with the image.
        interval: also write OUT-interval.tif: for each pixel the half-width of an interval that
            contains the error of this percentage of pixels. Needs the sensor, and a network with
            such an interval, as shipped ones have. In Python an array returns (restored,
            half_width).
        view: HTML file to write, which compares raw and restored in a browser.
        strict: fail instead of warning if the image contradicts the sensor or fails the self-check.
        consistency: if the sensor is named, make the result agree with the image at low spatial
            frequencies, and smooth dark parts.
        exposure: restore dark parts and strong edges at other exposures (shipped networks).
        fix_detectors: interpolate faulty pixels first: 'found' searches for them and lists them
            next to the output; or a file that lists column,row by lines, with * for a whole column.
        force: accept an image that was restored before, follow an index out of its folder, and
            write even implausible results.
        overwrite: replace the output if it exists.
        resume: continue a run that was stopped or killed.
        dry_run: print facts of the image, the plan of tiles and the expected time, and write no
            image.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Returns:
        For an array the restored one, of the same kind, type and scale. For a file a table of the
        run, with the `path` and the `time_s`.

    Raises:
        ImageError: no such image, an unknown full scale, or pixels outside 0 to full scale.
        ModelError: a network that cannot be tiled or run.
        OptionError: options that do not go together, or an output that exists.
        ProfileError: no such sensor.
        MachineError: a missing package, memory, or a disk that cannot be written.

    Examples:
        >>> pair = bd.simulate(size=96)
        >>> restored = bd.restore(pair.degraded, network="convbeers-xs", sensor=pair.profiles[0])
        >>> bool(pair.psnr(restored) > pair.psnr(pair.degraded))
        True
    """
    options = partial(changed, restore, locals())

    from beers_deploy.model.raster.reader import require_image_file
    from beers_deploy.restoration.arrays import restore_array
    from beers_deploy.restoration.bands import is_unknown, networks_of, sensors_of
    from beers_deploy.restoration.interval import require_sensors
    from beers_deploy.restoration.plan import Tiles
    from beers_deploy.restoration.prepare import NetworkPipeline
    from beers_deploy.restoration.radiometry import Reading
    from beers_deploy.restoration.run import restore_file
    from beers_deploy.restoration.runtime import Engine
    from beers_deploy.restoration.steps import Around

    path = _file_of(image)
    writes_none = dry_run and out is None
    _refuse_without_effect(options, method, path, writes_none)
    if path is not None:
        require_image_file(path)
    sensors = sensors_of(sensor)
    output = None
    # A dry run refuses the outputs that the run would refuse.
    if path is not None and not writes_none:
        output = _output(
            out,
            (stac, view),
            len(sensors),
            overwrite,
            fix_detectors or "",
            compression=compression,
            cog=cog,
            resume=resume,
            interval=interval,
            self_check=path_or_none(self_check),
        )
    unknown = is_unknown(sensors)
    if interval is not None:
        require_sensors(sensors)
    reading = Reading(
        sensors={} if unknown else sensors,
        full_scale=full_scale,
        nodata=nodata,
        strict=strict,
        force=force,
        # A budget of 0 bytes would count as none.
        memory_bytes=None if memory is None else int(min(memory * 1e9, sys.maxsize)),
        fix_detectors=fix_detectors or "",
    )
    engine = Engine(runtime, threads, scheduler)

    def network_pipeline() -> NetworkPipeline:
        return NetworkPipeline(
            networks_of(network, sensors, full_scale),
            Tiles(tile, str(halo)),
            engine,
            Around(consistency, exposure),
        )

    load = _traditional(quality, unknown) if method == "traditional" else network_pipeline
    if path is None:
        return restore_array(image, reading, load, interval)
    if output is None or dry_run:
        return _preview(path, network_pipeline(), reading)
    run = restore_file(path, output, reading, load)
    _write_documents(path, run, output, stac, view, force)
    return run


def _file_of(image: Any) -> Path | None:
    """Return the path of an image; None for an array."""
    if isinstance(image, str | os.PathLike):
        return Path(image)
    # A dataset of rasterio has a coordinate system and the name of its file. A DataArray may have
    # the attribute `crs` too, but it has no method `read`.
    return Path(image.name) if hasattr(image, "crs") and hasattr(image, "read") else None


def _refuse_without_effect(
    options: Callable[..., dict[str, bool]], method: str, path: Path | None, writes_none: bool
) -> None:
    """Raise OptionError if an option is given that has no effect.

    Args:
        options: returns True for each named parameter that has another value than its default.
        method: the parameter `method`.
        path: the path of the image; None for an array.
        writes_none: True for a dry run that names no output.
    """
    if method == "traditional":
        refuse_with(
            "`method` traditional",
            **options("network", "tile", "halo", "resume", "runtime", "threads", "scheduler"),
            **options("consistency", "exposure", "dry_run", "interval"),
        )
    else:
        refuse_without("`method` traditional", **options("quality"))
    if path is None:
        refuse_with(
            "an array",
            **options("out", "compression", "cog", "stac", "self_check", "view", "resume"),
            **options("overwrite", "dry_run", "fix_detectors", "scheduler"),
        )
        return
    refuse_with("an image file, which states its own", **options("nodata"))
    if not options("cog")["cog"]:
        refuse_without("`cog`", **options("stac"))
    if writes_none:
        refuse_without(
            "`out`",
            **options("compression", "cog", "stac", "self_check", "interval", "view"),
            **options("resume", "overwrite"),
        )


def _traditional(quality: str, unknown: bool) -> "Callable[[], Pipeline]":
    """Return the maker of the traditional pipeline; raise OptionError if the sensor is unknown."""
    if unknown:
        raise OptionError(
            "`method` traditional needs `sensor`, the sensor that acquired the image. Name a "
            "profile ('beers-deploy profiles' lists them), or give your .toml file."
        )
    # This loads torch, which is optional.
    from beers_deploy.restoration.traditional import TraditionalMethod

    return partial(TraditionalMethod, quality)


def _output(
    out: OutputFile | None,
    documents: tuple[OutputFile | None, OutputFile | None],
    networks: int,
    overwrite: bool,
    fix_detectors: str,
    **how: Any,
) -> "Output":
    """Return the output of a run; raise OptionError if it has no name, or a file of it exists.

    Args:
        out: the TIFF.
        documents: the STAC item and the view.
        networks: the largest number of networks that restore the bands.
        overwrite: True if these files may exist. They may too if a stopped run can be resumed.
        fix_detectors: the parameter of this name; "" if it is not given.
        how: the other fields of `Output`.
    """
    from beers_deploy.model.io.lock import part_folder
    from beers_deploy.restoration.detectors.fault_list import found_list_path
    from beers_deploy.restoration.output import Output, require_no_sidecar, require_tiff_name
    from beers_deploy.restoration.stac import network_paths

    if out is None:
        raise OptionError(
            "`out` is missing. Name the TIFF to write, or add `dry_run` to see the plan only."
        )
    path = Path(out)
    require_tiff_name(path)
    output = Output(path, **how)
    named = [path_or_none(document) for document in documents]
    if named[0] is not None:
        optional("pystac", "stac")
        # Bands of one sensor share a network, whose item has no number if it is the only one.
        items = sorted({*network_paths(named[0], 1), *network_paths(named[0], networks)})
        named += chain(items, (item.with_suffix(".onnx") for item in items))
    # The list of faults is an output of its own where they are searched for.
    listed = found_list_path(path, fix_detectors)
    others = (*named, listed, output.self_check, output.interval_path)
    may_exist = overwrite or (output.resume and part_folder(path).exists())
    for each in filter(None, (path, *others)):
        if each.exists() and not may_exist:
            raise OptionError(
                f"{each} exists already. Add `overwrite` to replace it, or choose another name."
            )
        require_no_sidecar(each)
    return replace(output, others=others)


def _write_documents(
    image: Path,
    run: "Run",
    output: "Output",
    stac: OutputFile | None,
    view: OutputFile | None,
    force: bool,
) -> None:
    """Write the STAC item and the view of a run, where they are asked for."""
    from beers_deploy.report.view import write_view
    from beers_deploy.restoration.stac import write_item

    # Rasters over the same place as the output, by the name of their layer and asset.
    written = {"self-check": output.self_check, "interval": output.interval_path}
    maps = {name: raster for name, raster in written.items() if raster is not None}
    if stac is not None:
        write_item(run, Path(stac), maps)
    if view is not None:
        write_view(Path(view), image, run.path, maps, force)


def _preview(image: Path, pipeline: "NetworkPipeline", reading: "Reading") -> "Table":
    """Return a table of the properties of an image, its tiles and the predicted time."""
    from beers_deploy.performance.dry_run import preview_row
    from beers_deploy.profiles.target import TargetProfile
    from beers_deploy.results import Table

    row = preview_row(image, pipeline, reading, TargetProfile.load(DEFAULT_TARGET))
    # The image has no digest here, because the whole file would be read for it.
    networks = tuple(network.input for network in pipeline.networks.values())
    return Table(title=str(image), inputs=networks, rows=(row,), headings={"restore": ""})
