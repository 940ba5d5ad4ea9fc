"""`restore` on arrays of NumPy, torch, Dask and xarray, and on files.

The pixels are those that the command `restore` writes of the same image.
"""

import os
import warnings
from dataclasses import dataclass, replace
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

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
from beers_deploy.network import Network, NetworkLike, SensorLike
from beers_deploy.network_files import other_sensor
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import BLIND
from beers_deploy.profiles.target import TILE_PX
from beers_deploy.restoration.options import Method, Options, Runtime
from beers_deploy.restoration.prepare import prepare
from beers_deploy.restoration.run import restore_file
from beers_deploy.restoration.tiles.engine import NAME
from beers_deploy.restoration.tiles.lazy import restore_lazily
from beers_deploy.restoration.tiles.rows import gathered
from beers_deploy.results import Table

PLAN = "plan: "
"""How the sentence begins that says how an image is cut."""


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
    force: bool = False,
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
        force: take an image that was restored already, follow an index to tiles outside its folder
            and at URLs, and give a result even if it is clipped, constant or far from the image's
            mean.
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
    chosen = _choice(Method, "method", method)
    if chosen is Method.traditional:
        changed = {"network": network is not None, "tile": tile != TILE_PX, "halo": halo != "exact"}
        changed |= {"runtime": runtime != Runtime.onnxruntime, "threads": threads != 0}
        changed |= {"resume": resume}
        name = next((option for option, is_changed in changed.items() if is_changed), None)
        if name is not None:
            raise OptionError(
                name, expected="none with method traditional", got="one", remedy="leave it out"
            )
    profile = Sensor.load(sensor)
    named = {} if profile.name == BLIND else {"": profile}
    options = Options(
        None if chosen is Method.traditional else _network(network, profile),
        tile,
        str(halo),
        full_scale,
        _choice(Runtime, "runtime", runtime),
        threads,
        # The pipeline needs a sensor, and takes the middle of all where none is named.
        sensors={"": profile} if chosen is Method.traditional else named,
        force=force,
        strict=strict,
        consistency=consistency,
        exposure=exposure,
        method=chosen,
        quality=quality,
    )
    job = Job(nodata, options)
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


def _network(network: NetworkLike | None, sensor: Sensor) -> Network:
    """Return the network that is meant, and warn if it was made for another sensor."""
    chosen = Network.load(network, sensor=sensor)
    named = sensor.name != BLIND and chosen.weights is None
    if named and (doubt := other_sensor(chosen.model, sensor)):
        # The warning points at the line that calls `restore`.
        warnings.warn(doubt, stacklevel=3)
    return chosen


Choice = TypeVar("Choice", bound=StrEnum)


def _choice(choices: type[Choice], option: str, name: str) -> Choice:
    """Return the choice of that name; refuse any other."""
    try:
        return choices(name)
    except ValueError as error:
        expected = " or ".join(choices)
        raise OptionError(option, expected=expected, got=repr(name), remedy="choose one") from error


@dataclass(frozen=True)
class Job:
    """How an array is restored, and the value of its missing pixels."""

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
    row = restore_file(image, path, options, no_log)
    arguments = {
        "method": options.method.value,
        "sensor": next((sensor.name for sensor in options.sensors.values()), BLIND),
        "tile": options.tile_px,
        "halo": options.halo,
    }
    network = options.network
    inputs = (network.input, image) if isinstance(network, Network) else (image,)
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
    require_raw(NAME, is_restored(str(own.get("TIFFTAG_SOFTWARE", "")), own), options.force)
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
    method = job.options.method
    if lazy and method is not Method.network:
        remedy = "compute it first, or take a network"
        raise OptionError(
            "method", expected="network for a Dask array", got=method.value, remedy=remedy
        )
    restored = (restore_lazily if lazy else _restore_now)(bands, raster, job.options)
    return restored[0] if image.ndim == 2 and len(restored) == 1 else restored


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
    work = prepare(ArraySource(bands, raster), options, NAME, _warn)
    pixels, tally = gathered(work.rows(0, lambda _: None), work.out_shape, raster.out_dtype)
    if not options.force:
        tally.require(name=NAME)
    return pixels


def _warn(sentence: str) -> None:
    """Warn of what a run logs, except how the image is cut."""
    if not sentence.startswith(PLAN):
        warnings.warn(sentence, stacklevel=2)


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
