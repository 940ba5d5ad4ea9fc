"""Restore arrays of NumPy, torch, Dask and xarray in memory.

The pixels are the same as those that `restore` writes for the same image in a file.
"""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np

from beers_deploy.model.levels import Level
from beers_deploy.model.progress import steps
from beers_deploy.model.raster.facts import (
    MaskKind,
    Raster,
    is_restored,
    require_pixel_type,
    require_raw,
    usable_nodata,
)
from beers_deploy.model.raster.source import ArraySource
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.profiles.user_files.arrays import array_of
from beers_deploy.restoration.interval import HalfWidths, half_widths_of
from beers_deploy.restoration.prepare import NetworkPipeline, Pipeline
from beers_deploy.restoration.radiometry import Reading
from beers_deploy.restoration.tiles.engine import NAME
from beers_deploy.restoration.tiles.lazy import restore_lazily
from beers_deploy.restoration.tiles.rows import gathered


def restore_array(
    image: Any, reading: Reading, load: Callable[[], Pipeline], level: Level | None = None
) -> Any:
    """Restore an array of NumPy, torch, Dask or xarray in memory.

    Args:
        image: the raw pixels, (H, W) or (bands, H, W). Arrays of NumPy (masked or not) and torch
            are restored at once; for Dask the result is lazy. An xarray.DataArray retains
            coordinates and attributes.
        reading: how the pixels are interpreted.
        load: returns the pipeline that restores the image, a network or the traditional one. It is
            called once the image is accepted.
        level: the level, in percent, of an interval of each restored pixel; None for no interval.

    Returns:
        The restored pixels, in an array of the same kind. With a level, the pair of these and the
        half-widths of the intervals, float32.

    Raises:
        ImageError: the array has another shape or type, was restored before, or has an implausible
            result.
        OptionError: an option does not fit the image, or the array is lazy and the options need its
            pixels.
    """
    # Arrays of xarray and torch are recognised by their attributes, so that neither is imported.
    if hasattr(image, "coords") and hasattr(image, "dims"):
        results = _restore_labelled(image, reading, load, level)
    elif hasattr(image, "detach") and hasattr(image, "device"):
        torch = import_module("torch")
        arrays = _restore(array_of(image, "image"), reading, load, level)
        results = [torch.from_numpy(pixels).to(image.device) for pixels in arrays]
    else:
        results = _restore(image, reading, load, level)
        if np.ma.isMaskedArray(image):
            mask = np.ma.getmaskarray(image)
            # Masked pixels stay masked, so the mask is enlarged with the image.
            scale = results[0].shape[-1] // mask.shape[-1]
            mask = mask.repeat(scale, axis=-2).repeat(scale, axis=-1)
            # A network that returns other bands computes each of them from all bands of the image.
            if mask.shape != results[0].shape:
                planes = mask if mask.ndim == 2 else mask.any(axis=0)
                mask = np.broadcast_to(planes, results[0].shape)
            results = [np.ma.array(pixels, mask=mask) for pixels in results]
    return results[0] if level is None else tuple(results)


def _restore_labelled(
    image: Any, reading: Reading, load: Callable[[], Pipeline], level: Level | None
) -> list[Any]:
    """Restore an xarray.DataArray, whose dimensions may have any order if their names identify
    them.
    """
    if hasattr(image, "data_vars"):
        names = ", ".join(map(str, image.data_vars)) or "none"
        raise ImageError(
            f"`image` is an xarray.Dataset of {names}. Choose one of its variables, which is a "
            "DataArray."
        )
    own = image.attrs
    require_raw(NAME, is_restored(str(own.get("TIFFTAG_SOFTWARE", "")), own), reading.force)
    full_scale = own.get("full_scale") if reading.full_scale is None else reading.full_scale
    nodata = own.get("_FillValue") if reading.nodata is None else reading.nodata
    dims = image.dims
    ordered = image.transpose(*sorted(dims, key=lambda dim: PLACES.get(dim, UNKNOWN)))
    if image.ndim == 3 and ordered.shape[-1] <= FEW < min(ordered.shape[:-1]):
        raise _bands_last(ordered.shape, "Name the dimension of the bands 'band'")
    reading = replace(reading, full_scale=full_scale, nodata=nodata)
    labelled = [
        _labelled(ordered, pixels) for pixels in _restore(ordered.data, reading, load, level)
    ]
    return [each if each.ndim != len(dims) else each.transpose(*dims) for each in labelled]


def _restore(
    image: Any, reading: Reading, load: Callable[[], Pipeline], level: Level | None
) -> list[Any]:
    bands = _bands_first(image)
    dtype = require_pixel_type(NAME, bands.dtype)
    value = None if reading.nodata is None else float(reading.nodata)
    mask_kind: MaskKind = "mask" if np.ma.isMaskedArray(bands) else ""
    count, height_px, width_px = bands.shape
    nodata = usable_nodata(value, dtype)
    raster = Raster(count, height_px, width_px, dtype, nodata, mask_kind=mask_kind)
    if hasattr(image, "__dask_graph__"):
        if np.ma.isMaskedArray(getattr(image, "_meta", None)):
            raise ImageError(
                "`image` is a masked Dask array, which is not supported. Fill it with "
                "dask.array.ma.filled(image, 0) and give that value as `nodata`, or compute it "
                "first."
            )
        if level is not None:
            raise OptionError("`interval` needs pixels in memory. Compute the Dask array first.")
        pipeline = load()
        if not isinstance(pipeline, NetworkPipeline):
            raise OptionError(
                "`method` must be 'network' for a Dask array. Compute the array first, or use a "
                "network."
            )
        results = [restore_lazily(bands, raster, pipeline, reading)]
    else:
        work = load().prepare(ArraySource(bands, raster), reading, NAME)
        widths = () if level is None else half_widths_of(work, level)
        with steps("restoring", work.ticks(0)) as bar:
            pixels, tally = gathered(work.rows(0, bar.advance), work.out_shape, raster.out_dtype)
        if not reading.force:
            tally.require(name=NAME)
        results = [pixels]
        if widths:
            half = HalfWidths(work.source, lambda band, top, stop: pixels[band, top:stop], widths)
            results.append(np.stack([half.read(band, 0, height_px) for band in range(count)]))
    return [each[0] if image.ndim == 2 and len(each) == 1 else each for each in results]


def _labelled(image: Any, pixels: Any) -> Any:
    """Return restored pixels with the labels of an xarray.DataArray. If the number of pixels
    changed, the coordinates are interpolated.
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
        places = image.coords[dim].values
        if len(places) < 2 or places.dtype.kind not in "iuf":
            continue
        # Pixels of both sizes share the image's borders, not their middles.
        at = (np.arange(sizes[dim]) + 0.5) * (len(places) / sizes[dim]) - 0.5
        left = np.clip(np.floor(at).astype(int), 0, len(places) - 2)
        between = places[left] + (at - left) * (places[left + 1] - places[left])
        coordinates[dim] = (dim, between, image.coords[dim].attrs)
    return type(image)(pixels, coordinates, dims, image.name, image.attrs)


UNKNOWN = 1
"""The place of a dimension of another name than in PLACES. Next to rows and columns it has the
bands, for example points of time; next to bands, unknown dimensions keep their order.
"""
PLACES = {
    **dict.fromkeys(("band", "bands", "channel", "wavelength"), 0),
    **dict.fromkeys(("y", "lat", "latitude"), 2),
    **dict.fromkeys(("x", "lon", "longitude"), 3),
}
"""The places of an image's dimensions by their names in xarray."""
FEW = 4
"""The largest number of bands of a photograph. A last axis of at most this length after two longer
ones holds bands, not columns.
"""


def _bands_first(image: Any) -> Any:
    """Return an image as (bands, H, W)."""
    shape: tuple[int, ...] = getattr(image, "shape", ())
    if len(shape) not in (2, 3) or 0 in shape or any(side != side for side in shape):
        kind = type(image).__name__
        raise ImageError(
            f"`image` must be an array (H, W) or (bands, H, W) of known size, but it is "
            f"{kind} of shape {shape}. Give pixels as an array, missing ones as NaN or as "
            "`nodata`."
        )
    if len(shape) == 3 and shape[2] <= FEW < min(shape[:2]):
        raise _bands_last(shape, "Put them first with numpy.moveaxis(image, -1, 0)")
    if not isinstance(image, np.ndarray) and not hasattr(image, "__dask_graph__"):
        # Arrays of HDF5, Zarr or pandas are not indexed as those of NumPy.
        image = np.asarray(image)
    return image if len(shape) == 3 else image[None]


def _bands_last(shape: tuple[int, ...], remedy: str) -> ImageError:
    return ImageError(
        f"`image` must be (bands, H, W), but the bands are last in its shape {tuple(shape)}. "
        f"{remedy}."
    )
