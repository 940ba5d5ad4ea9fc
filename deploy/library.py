"""For notebooks: `from beers_deploy.library import restore`, on arrays of numpy, Dask and xarray.

The pixels are those that the command `restore` writes of the same image.
"""

import warnings
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from beers_deploy.model.io.images import settled_scale
from beers_deploy.networks import network_file
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.profiles.sensor_file import BLIND, load_sensor
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.tiling.walk import Tiling
from beers_deploy.restoration.engine import NAME, Restorer, checked_strip, restore_array
from beers_deploy.restoration.options import TILE_PX, Options, Runtime
from beers_deploy.restoration.plan import Plan, Span, plan_for
from beers_deploy.restoration.run import scale_of
from beers_deploy.restoration.runtime import Packed, open_packed, open_runtime, pack, tiles_at_once
from beers_deploy.restoration.source import ArraySource, Raster, require_numbers, usable_nodata

Image = TypeVar("Image")
"""numpy.ndarray, dask.array.Array or xarray.DataArray."""


def restore(
    image: Image,
    model: Path | str | None = None,
    *,
    tile_px: int = TILE_PX,
    halo: int | str = "exact",
    full_scale: float | None = None,
    runtime: str = "onnxruntime",
    threads: int = 0,
    nodata: float | None = None,
    sensor: str = BLIND,
) -> Image:
    """Restore an image of raw digital numbers, (H, W) or (bands, H, W).

    A network of one band restores bands one by one, another one those that it takes together.

    Args:
        image: of numpy it is restored at once; of Dask the result is lazy, a chunk for each tile and band, and may be
            computed on a cluster that has this package; an xarray.DataArray keeps coordinates and attributes.
        model: ONNX file, float or INT8, or the name of a shipped network, in INT8 with -int8 behind it;
            convbeers-s-int8 if None.
        tile_px: longest side of a tile.
        halo: 'exact', or pixels of context around a tile.
        full_scale: the pixel value that is 1.0 to the network. None is 4095 (12 bits) for integers of more than 8
            bits and for floats of digital numbers; 8-bit pixels, and floats that all lie in about 0..1, are refused
            without it. Floats of Dask are judged tile by tile when they are computed.
        runtime: 'onnxruntime' or 'openvino'.
        threads: of the runtime; 0 takes every core, or one for each of Dask's own threads.
        nodata: the value of missing pixels, besides NaN; a DataArray's own `_FillValue` if None.
        sensor: that a shipped network is told: a profile's name, a .toml file, or 'blind' where it is not
            known. INT8 for a sensor of your own takes minutes once, and is kept.

    Returns:
        The same kind and scale, uint8 of uint8, uint16 of other integers, float32 of floats; of the same shape,
        unless the network makes more pixels or other bands. Missing pixels stay as they are.

    Raises:
        ImageError: no such array, pixels that leave the full scale open, or values outside 0 to full scale; of
            Dask when it is computed.
        ModelError: a network that cannot be tiled or run.
        OptionError: options that do not go together.
        ProfileError: no such sensor.
        MachineError: a missing package, or a cache that cannot be written.
    """
    network = network_file(Path(model) if model else None, load_sensor(sensor), warnings.warn)
    options = Options(network, tile_px, str(halo), full_scale, _runtime(runtime), threads)
    if hasattr(image, "coords") and hasattr(image, "dims"):  # an xarray.DataArray, without importing it
        labelled: Any = image
        missing = labelled.attrs.get("_FillValue") if nodata is None else nodata
        restored: Image = _labelled(labelled, _restore(labelled.data, options, missing))
        return restored
    plain: Image = _restore(image, options, nodata)
    return plain


def _restore(image: Any, options: Options, nodata: float | None) -> Any:
    bands = _bands_first(image)
    raster = _raster(bands, nodata)
    if hasattr(image, "__dask_graph__"):
        restored = restore_lazily(bands, raster, options)
    else:
        restored = _restore_now(bands, raster, options)
    return restored[0] if image.ndim == 2 and len(restored) == 1 else restored


def _labelled(image: Any, pixels: Any) -> Any:
    """Restored pixels with an xarray.DataArray's labels; where they are more than it had, those of their places."""
    if pixels.shape == image.shape:
        return image.copy(data=pixels)
    dims = image.dims if pixels.ndim == image.ndim else ("band", *image.dims)
    sizes = dict(zip(dims, pixels.shape, strict=True))
    changed = {dim for dim in image.dims if sizes[dim] != image.sizes[dim]}
    coordinates = {name: each.copy() for name, each in image.coords.items() if not changed.intersection(each.dims)}
    for each in coordinates.values():
        each.attrs.pop("GeoTransform", None)  # of the pixels before; what lies where is told by the places
    for dim in changed.intersection(image.dims[-2:], image.coords):
        places = _between(image.coords[dim].values, sizes[dim])
        coordinates |= {dim: (dim, places, image.coords[dim].attrs)} if places is not None else {}
    return type(image)(pixels, coordinates, dims, image.name, image.attrs)


def _between(places: np.ndarray, count: int) -> np.ndarray | None:
    """The middles of `count` pixels over those at `places`, evenly between; None where these are no two numbers."""
    if len(places) < 2 or places.dtype.kind not in "iuf":
        return None
    at = (np.arange(count) + 0.5) * (len(places) / count) - 0.5
    left = np.clip(np.floor(at).astype(int), 0, len(places) - 2)
    return np.asarray(places[left] + (at - left) * (places[left + 1] - places[left]))


def _restore_now(bands: np.ndarray, raster: Raster, options: Options) -> np.ndarray:
    network, source = load_onnx(options.model), ArraySource(bands, raster)
    plan = plan_for(network, raster.shape, options)
    at_once = tiles_at_once(options.threads, plan.tiles)
    infer, _ = open_runtime(options.runtime, network, options.threads, at_once)
    full_scale = scale_of(source, plan, options, NAME).value
    restorer = Restorer(raster, infer, full_scale, plan.tiling, NAME)
    return restore_array(source, plan, restorer, at_once)


def _bands_first(image: Any) -> Any:
    shape = getattr(image, "shape", ())
    if len(shape) not in (2, 3) or 0 in shape or any(side != side for side in shape) or np.ma.isMaskedArray(image):
        got = "a masked array" if np.ma.isMaskedArray(image) else f"{type(image).__name__} of shape {shape}"
        remedy = "give pixels as an array, missing ones as NaN or as nodata, sizes known"
        raise ImageError(NAME, expected="an array (H, W) or (bands, H, W)", got=got, remedy=remedy)
    return image if len(shape) == 3 else image[None]


def _raster(bands: Any, nodata: float | None) -> Raster:
    count, height_px, width_px = bands.shape
    dtype = require_numbers(NAME, bands.dtype)
    missing = None if nodata is None else float(nodata)
    return Raster(count, height_px, width_px, dtype, usable_nodata(NAME, missing, dtype))


def _runtime(name: str) -> Runtime:
    try:
        return Runtime(name)
    except ValueError as error:
        expected = " or ".join(Runtime)
        raise OptionError("runtime", expected=expected, got=repr(name), remedy="choose one") from error


@dataclass(frozen=True)
class Task:
    """What all tiles of a lazy array share: facts of the image and a network, as they are sent to Dask's workers."""

    raster: Raster
    network: Packed
    full_scale: float | None
    tiling: Tiling

    def restorer(self, window: np.ndarray) -> Restorer:
        """For this process, at the full scale that was asked for or that the window's pixels tell.

        Raises:
            ImageError: they leave it open.
        """
        largest = (self.raster.largest(part) for part in (window,))
        full_scale = settled_scale(NAME, self.raster.dtype, largest, self.full_scale)
        return Restorer(self.raster, open_packed(self.network), full_scale, self.tiling, NAME)


def restore_lazily(bands: Any, raster: Raster, options: Options) -> Any:
    """A lazy (bands, H, W) array of Dask; errors in options and model come at once, in pixels when it is computed."""
    da: Any = import_module("dask.array")
    delayed: Any = import_module("dask").delayed
    network = load_onnx(options.model)
    plan = plan_for(network, raster.shape, options)
    settled_scale(NAME, raster.dtype, (), options.full_scale)  # what the type alone decides comes at once
    packed = pack(network, options.runtime, options.threads or 1)
    task = delayed(Task(raster, packed, options.full_scale, plan.tiling))
    tile = delayed(restore_tile)

    def block(group: int, row: Span, column: Span) -> Any:
        rows, columns = (_around(span, raster, plan) for span in (row, column))
        window = bands[group * count : (group + 1) * count, rows, columns]
        sides = ((span.keep_stop - span.keep_start) * plan.scale for span in (row, column))
        restored = tile(task, window, rows.start, columns.start, row, column)
        return da.from_delayed(restored, (plan.tiling.channels_out, *sides), raster.out_dtype)

    count, groups = plan.tiling.channels_in, range(plan.groups)
    return da.block([[[block(g, row, column) for column in plan.columns] for row in plan.rows] for g in groups])


def restore_tile(task: Task, window: np.ndarray, top: int, left: int, row: Span, column: Span) -> np.ndarray:
    """The kept pixels (bands, h, w) of one tile, from a window (bands, ., .) whose first pixel is at (top, left).

    Raises:
        ImageError: values outside 0 to full scale, or a full scale left open.
    """
    restorer = task.restorer(window)
    here = Span(*(side - left for side in (column.start, column.stop, column.keep_start, column.keep_stop)))
    strip = checked_strip(task.raster, top, window, restorer.full_scale, NAME)
    return restorer.tile(strip, 0, row, here).pixels


def _around(span: Span, raster: Raster, plan: Plan) -> slice:
    """What a tile reads along one side: its window, and what missing pixels may be filled from."""
    margin_px = raster.fill_margin_px(plan.radius_px)
    return slice(max(span.start - margin_px, 0), span.stop + margin_px)
