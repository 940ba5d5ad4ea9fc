"""`restore` on arrays of NumPy, torch, Dask and xarray, and on files.

The pixels are those that the command `restore` writes of the same image.
"""

import os
import warnings
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnx

from beers_deploy.model.progress import Progress, no_log, reporting
from beers_deploy.model.raster.facts import (
    MaskKind,
    Raster,
    is_restored,
    require_numbers,
    require_raw,
    usable_nodata,
)
from beers_deploy.model.raster.source import ArraySource
from beers_deploy.model.shipped import INT8, VARIANT
from beers_deploy.network import Network, NetworkLike, SensorLike
from beers_deploy.network_files import brighter_files, conditioned, other_sensor
from beers_deploy.profiles.errors import ImageError, OptionError, optional
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import BLIND
from beers_deploy.profiles.target import TILE_PX
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.restoration.options import Options, Runtime
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.plan import plan_for
from beers_deploy.restoration.radiometry import full_scale_of
from beers_deploy.restoration.run import check_sensor, restore_file, scale_of
from beers_deploy.restoration.runtime import Packed, open_runtime, tiles_at_once
from beers_deploy.restoration.sensor_check import told_sensor
from beers_deploy.restoration.steps import consistency_steps, exposed_networks
from beers_deploy.restoration.tiles.engine import NAME, Restorer, as_stored, checked_strip
from beers_deploy.restoration.tiles.lazy import restore_lazily
from beers_deploy.restoration.tiles.rows import restore_array
from beers_deploy.results import Table

NETWORK = "network"
TRADITIONAL = "traditional"


def restore(
    image: Any,
    network: NetworkLike | None = None,
    *,
    sensor: SensorLike = BLIND,
    method: Literal["network", "traditional"] = "network",
    quality: str = "standard",
    full_scale: float | None = None,
    nodata: float | None = None,
    tile: int = TILE_PX,
    halo: int | str = "exact",
    runtime: str = "onnxruntime",
    threads: int = 0,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    cog: bool = False,
    again: bool = False,
    any_result: bool = False,
    strict: bool = False,
    consistency: bool = True,
    exposure: bool = True,
    progress: Progress = None,
) -> Any:
    """Restore an image of raw digital numbers: an array, or a file into another.

    A network of one band restores bands one by one, another one those that it takes together.

    Args:
        image: (H, W) or (bands, H, W). Of NumPy (masked or not) and torch it is restored at once;
            of Dask the result is lazy, a chunk for each tile and band, and may be computed on a
            cluster that has this package; an xarray.DataArray keeps coordinates and attributes, its
            bands in a dimension "band" wherever that stands. Or the path of an image file, restored
            into `out`.
        network: what `Network.load` takes; convbeers-s-int8 if None.
        sensor: that acquired the image: a `Sensor`, a name, a .toml file, or "blind" where it is
            not known. A shipped network is conditioned on it, and the consistency step and the
            traditional pipeline need it.
        method: "network", or "traditional" for the denoising and deconvolution that networks are
            compared with.
        quality: of the traditional pipeline on arrays: fast, standard or best.
        full_scale: the pixel value that is 1.0 to the network. None is a DataArray's attribute of
            that name, or 4095 (12 bits) for integers of more than 8 bits and for floats of digital
            numbers; without it 8-bit pixels, and floats that all lie in about 0..1, are refused.
            Floats of Dask are judged tile by tile when computed.
        nodata: the value of an array's missing pixels, besides NaN; a DataArray's own `_FillValue`
            if None.
        tile: longest side of a tile in pixels.
        halo: "exact", or pixels of context around a tile.
        runtime: "onnxruntime" or "openvino".
        threads: of the runtime; 0 takes every core, or one for each of Dask's own threads.
        out: the TIFF that a file is restored into; files alone.
        resume: go on with a run into `out` that was stopped.
        cog: write `out` as a Cloud-Optimised GeoTIFF.
        again: take an image that says it was restored already.
        any_result: give a result even if it is clipped, constant or far from the image's mean.
        strict: refuse an image, none of Dask, that contradicts its sensor; else warn, or say
            "sensor told" of a file.
        consistency: make the result agree with the raw image at low spatial frequencies, where the
            sensor is known.
        exposure: restore dark parts at a higher exposure, by a shipped network.
        progress: a function that is told each step, False for silence, None for a bar or lines on
            standard error.

    Returns:
        The same kind and scale, of the same type (float32 for float64); of the
            same shape,
        unless the network makes more pixels or other bands. Missing pixels stay as they are. Of a
            file a table of the
        run, with its `path` and `time_s`.

    Raises:
        ImageError: no such image, pixels that leave the full scale open, or values outside 0 to
            full scale; of Dask when it is computed.
        ModelError: a network that cannot be tiled or run.
        OptionError: options that do not go together.
        ProfileError: no such sensor.
        MachineError: a missing package, memory, or a disk that cannot be written.

    Examples:
        >>> pair = bd.simulate(size=96)
        >>> restored = bd.restore(pair.degraded, "convbeers-xs", sensor=pair.profiles[0])
        >>> bool(pair.psnr(restored) > pair.psnr(pair.degraded))
        True
    """
    if method not in (NETWORK, TRADITIONAL):
        raise OptionError(
            "method", expected=f"{NETWORK} or {TRADITIONAL}", got=repr(method), remedy="choose one"
        )
    if method == TRADITIONAL:
        changed = {"network": network is not None, "tile": tile != TILE_PX, "halo": halo != "exact"}
        changed |= {"runtime": runtime != Runtime.onnxruntime, "threads": threads != 0}
        changed |= {"resume": resume, "cog": cog}
        name = next((option for option, is_changed in changed.items() if is_changed), None)
        if name is not None:
            raise OptionError(
                name, expected="none with method traditional", got="one", remedy="leave it out"
            )
    profile = Sensor.load(sensor)
    chosen_network = Network.load(
        f"{VARIANT}{INT8}" if network is None else network, sensor=profile
    )
    sensors = {} if profile.name == BLIND else {"": profile}
    brighter = _brighter(network, chosen_network, profile) if exposure and method == NETWORK else {}
    options = Options(
        chosen_network.file,
        tile,
        str(halo),
        full_scale,
        _runtime(runtime),
        threads,
        sensors=sensors,
        again=again,
        any_result=any_result,
        strict=strict,
        consistency=consistency,
        brighter={"": brighter} if brighter else {},
    )
    job = Job(method, quality, profile, nodata, options)
    with reporting(progress):
        # A dataset of rasterio has a coordinate system and the name of its file.
        if isinstance(image, str | os.PathLike) or hasattr(image, "crs"):
            path = Path(image if isinstance(image, str | os.PathLike) else image.name)
            return _restore_path(path, replace(job.options, resume=resume, cog=cog), job, out)
        if out is not None or resume or cog:
            file_options = {"out": out is not None, "cog": cog, "resume": resume}
            name = next(option for option, is_given in file_options.items() if is_given)
            remedy = "save the result yourself"
            raise OptionError(name, expected="none beside an array", got="one", remedy=remedy)
        return _restore_any(image, job)


def _brighter(
    network: NetworkLike | None, chosen_network: Network, sensor: Sensor
) -> dict[int, Path]:
    """A conditioned network at higher exposures; of any other one none, and a warning if it is
    another sensor's.
    """
    if network is None or isinstance(network, str | os.PathLike):
        path = None if network is None else Path(network)
        if conditioned(path) is not None:
            return brighter_files(path, sensor)
    if sensor.name != BLIND and (doubt := other_sensor(chosen_network.model, sensor)):
        # The warning points at the line that calls `restore`.
        warnings.warn(doubt, stacklevel=3)
    return {}


@dataclass(frozen=True)
class Job:
    """How an array is restored, and the value of its missing pixels."""

    method: str
    quality: str
    sensor: Sensor
    nodata: float | None
    options: Options


@dataclass(frozen=True, repr=False, kw_only=True)
class Run(Table):
    """One file restored into another.

    Attributes:
        path: of the restored image.
        time_s: from opening the image to the finished file.
    """

    path: Path
    time_s: float


def _restore_path(
    image: Path, options: Options, job: Job, out: str | os.PathLike[str] | None
) -> Run:
    if out is None:
        remedy = "name the TIFF to write, or read the image into an array"
        raise OptionError("out", expected="a path beside an image file", got="none", remedy=remedy)
    if job.nodata is not None:
        remedy = "leave it out: the file says which value its missing pixels have"
        raise OptionError(
            "nodata", expected="none beside an image file", got=f"{job.nodata:g}", remedy=remedy
        )
    path = Path(out)
    if job.method == TRADITIONAL:
        # It loads torch, which is optional.
        from beers_deploy.restoration.traditional import restore_file_traditionally

        options_of_sensor = replace(options, sensors={"": job.sensor})
        row = restore_file_traditionally(image, path, options_of_sensor, no_log)
    else:
        row = restore_file(image, path, options, no_log)
    arguments = {
        "method": job.method,
        "sensor": job.sensor.name,
        "tile": options.tile_px,
        "halo": options.halo,
    }
    inputs = (image,) if job.method == TRADITIONAL else (options.model, image)
    time_s = row.figures["time"].value or 0.0
    return Run("restore", arguments, inputs, (row,), path=path, time_s=time_s)


def _restore_any(image: Any, job: Job) -> Any:
    """An array of any kind, to the same kind."""
    # Arrays of xarray and torch are told by their attributes, so that neither is imported.
    if hasattr(image, "coords") and hasattr(image, "dims"):
        return _restore_labelled(image, job)
    if hasattr(image, "detach"):
        restored = _restore(image.detach().cpu().numpy(), job)
        return import_module("torch").from_numpy(restored).to(image.device)
    if np.ma.isMaskedArray(image):
        return _restore_masked(image, job)
    return _restore(image, job)


def _restore_labelled(image: Any, job: Job) -> Any:
    """An xarray.DataArray; bands may stand behind the rows and columns where their dimension says
    so.
    """
    if hasattr(image, "data_vars"):
        names = ", ".join(map(str, image.data_vars)) or "none"
        remedy = "choose one of its variables"
        raise ImageError(
            NAME, expected="an xarray.DataArray", got=f"a Dataset of {names}", remedy=remedy
        )
    own = image.attrs
    options = job.options
    require_raw(NAME, is_restored(str(own.get("TIFFTAG_SOFTWARE", "")), own), options.again)
    full_scale = own.get("full_scale") if options.full_scale is None else options.full_scale
    nodata = own.get("_FillValue") if job.nodata is None else job.nodata
    dims = image.dims
    bands = next((dim for dim in image.dims if dim in BAND_DIMS), None)
    ordered = image if bands is None or image.ndim != 3 else image.transpose(bands, ...)
    if image.ndim == 3 and bands is None and ordered.shape[-1] <= FEW < min(ordered.shape[:-1]):
        raise _bands_last(ordered.shape, "name the dimension of the bands 'band'")
    pixels = _restore(
        ordered.data, replace(job, options=replace(options, full_scale=full_scale), nodata=nodata)
    )
    restored = _labelled(ordered, pixels)
    return restored if restored.ndim != len(dims) else restored.transpose(*dims)


def _restore_masked(image: Any, job: Job) -> Any:
    """A masked array, whose masked pixels are missing and stay masked, enlarged with the image."""
    restored = _restore(image, job)
    mask = np.ma.getmaskarray(image)
    scale = restored.shape[-1] // mask.shape[-1]
    mask = mask.repeat(scale, axis=-2).repeat(scale, axis=-1)
    # A network that makes other bands makes each of them of all bands of the image.
    if mask.shape != restored.shape:
        mask = np.broadcast_to(mask if mask.ndim == 2 else mask.any(axis=0), restored.shape)
    return np.ma.array(restored, mask=mask)


def _restore(image: Any, job: Job) -> Any:
    bands = _bands_first(image)
    raster = _raster(bands, job.nodata)
    lazy = hasattr(image, "__dask_graph__")
    if lazy and np.ma.isMaskedArray(getattr(image, "_meta", None)):
        remedy = (
            "fill it, dask.array.ma.filled(image, 0), and give that value as `nodata`; or "
            "compute it first"
        )
        raise ImageError(
            NAME, expected="a Dask array without a mask", got="a masked one", remedy=remedy
        )
    if job.method == NETWORK:
        restored = (restore_lazily if lazy else _restore_now)(bands, raster, job.options)
    elif lazy:
        remedy = "compute it first, or take a network"
        raise OptionError(
            "method", expected="network for a Dask array", got=job.method, remedy=remedy
        )
    else:
        restored = _restore_traditionally(bands, raster, job)
    return restored[0] if image.ndim == 2 and len(restored) == 1 else restored


def _restore_traditionally(bands: np.ndarray, raster: Raster, job: Job) -> np.ndarray:
    """Each band by the traditional pipeline; missing pixels stay as they are."""
    torch = optional("torch", "method")
    from beers_deploy.model.traditional.pipeline import Chain, restore_traditional

    chain = Chain(job.sensor.nominal(), job.sensor.reference.nominal(), job.quality)
    bits = int(chain.degraded.max_dn).bit_length()
    extents = (raster.extent(band) for band in bands)
    full_scale = full_scale_of(NAME, raster, extents, job.options.full_scale, bits).value
    to_dn = np.float32(chain.degraded.max_dn / full_scale)
    restored = []
    told_sensor(
        ArraySource(bands, raster),
        job.options.sensors,
        full_scale,
        NAME,
        job.options.strict,
        warnings.warn,
    )
    for band in bands:
        strip = checked_strip(raster, 0, band[None], full_scale, NAME)
        dn = np.ma.getdata(band).astype(np.float32) * to_dn
        missing = np.zeros(band.shape, bool) if strip.missing is None else strip.missing[0]
        dn[missing] = np.nan
        result = np.nan_to_num(restore_traditional(torch.from_numpy(dn), chain).numpy()) / to_dn
        stored = np.ma.getdata(band).astype(raster.out_dtype)
        restored.append(np.where(missing, stored, as_stored(raster, result, full_scale)))
    return np.stack(restored)


def _labelled(image: Any, pixels: Any) -> Any:
    """Restored pixels with an xarray.DataArray's labels; where they are more than it had, those of
    their places.
    """
    if pixels.shape == image.shape:
        return image.copy(data=pixels)
    dims = image.dims if pixels.ndim == image.ndim else ("band", *image.dims)
    sizes = dict(zip(dims, pixels.shape, strict=True))
    changed = {dim for dim in image.dims if sizes[dim] != image.sizes[dim]}
    coordinates = {
        name: coordinate.copy()
        for name, coordinate in image.coords.items()
        if not changed.intersection(coordinate.dims)
    }
    for coordinate in coordinates.values():
        # This transform is that of the original pixels; the coordinates have the new places.
        coordinate.attrs.pop("GeoTransform", None)
    for dim in changed.intersection(image.dims[-2:], image.coords):
        places = _between(image.coords[dim].values, sizes[dim])
        coordinates |= {dim: (dim, places, image.coords[dim].attrs)} if places is not None else {}
    return type(image)(pixels, coordinates, dims, image.name, image.attrs)


def _between(places: np.ndarray, count: int) -> np.ndarray | None:
    """The middles of `count` pixels over those at `places`, evenly between; None where these are no
    two numbers.
    """
    if len(places) < 2 or places.dtype.kind not in "iuf":
        return None
    # Pixels of both sizes share the image's borders, not their middles.
    at = (np.arange(count) + 0.5) * (len(places) / count) - 0.5
    left = np.clip(np.floor(at).astype(int), 0, len(places) - 2)
    return np.asarray(places[left] + (at - left) * (places[left + 1] - places[left]))


def _restore_now(bands: np.ndarray, raster: Raster, options: Options) -> np.ndarray:
    network = load_onnx(options.model)
    source = ArraySource(bands, raster)
    plan = plan_for(network, raster.shape, options)
    at_once = tiles_at_once(options.threads, plan.tiles)
    infer, _ = open_runtime(options.runtime, network, options.threads, at_once)
    full_scale = scale_of(source, plan, options, NAME).value
    check_sensor(source, [network], options, full_scale, NAME, warnings.warn)

    def at_first_call(brighter: onnx.ModelProto) -> Packed:
        return Packed(brighter.SerializeToString(), options.runtime, options.threads, at_once)

    exposed = exposed_networks([infer], options, raster, plan.tiling, full_scale, at_first_call)
    steps, _ = consistency_steps(options, raster, plan.tiling, full_scale)
    restorer = Restorer(raster, exposed, full_scale, plan.tiling, NAME, consistency=steps)
    look = None if options.any_result else partial(Tally.require, name=NAME)
    return restore_array(source, plan, restorer, at_once, look)


BAND_DIMS = ("band", "bands", "channel", "wavelength")
FEW = 4
"""Bands of a photograph: a last axis of no more, behind two longer ones, holds bands and no
columns.
"""


def _bands_first(image: Any) -> Any:
    shape: tuple[int, ...] = getattr(image, "shape", ())
    if len(shape) not in (2, 3) or 0 in shape or any(side != side for side in shape):
        got = f"{type(image).__name__} of shape {shape}" if shape else type(image).__name__
        remedy = "give pixels as an array, missing ones as NaN or as nodata, sizes known"
        raise ImageError(NAME, expected="an array (H, W) or (bands, H, W)", got=got, remedy=remedy)
    if len(shape) == 3 and shape[2] <= FEW < min(shape[:2]):
        raise _bands_last(shape, "numpy.moveaxis(image, -1, 0) puts them first")
    return image if len(shape) == 3 else image[None]


def _bands_last(shape: tuple[int, ...], remedy: str) -> ImageError:
    got = f"shape {tuple(shape)}, which ends in bands"
    return ImageError(NAME, expected="an array (bands, H, W)", got=got, remedy=remedy)


def _raster(bands: Any, nodata: float | None) -> Raster:
    count, height_px, width_px = bands.shape
    dtype = require_numbers(NAME, bands.dtype)
    value = None if nodata is None else float(nodata)
    mask_kind: MaskKind = "mask" if np.ma.isMaskedArray(bands) else ""
    nodata = usable_nodata(value, dtype)
    return Raster(count, height_px, width_px, dtype, nodata, mask_kind=mask_kind)


def _runtime(name: str) -> Runtime:
    try:
        return Runtime(name)
    except ValueError as error:
        expected = " or ".join(Runtime)
        raise OptionError(
            "runtime", expected=expected, got=repr(name), remedy="choose one"
        ) from error
