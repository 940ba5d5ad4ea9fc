"""Read the properties that GDAL states of an open image, and reject pixels that
cannot be restored.
"""

from pathlib import Path
from typing import Any

import numpy as np

from beers_deploy.model.raster.facts import (
    RGB_BANDS,
    BandInfo,
    Georeference,
    MaskKind,
    Raster,
    is_restored,
    require_pixel_type,
    require_size,
    require_small_offset,
    usable_nodata,
)
from beers_deploy.model.raster.index import dimap_bits
from beers_deploy.profiles.errors import ImageError, printable

DARK = {"palette", "hue", "saturation", "lightness", "cyan", "magenta", "yellow", "black"}
"""GDAL's interpretations of bands whose pixels are not brighter where they are larger."""
NOT_COPIED = ("STATISTICS_", "TIFFTAG_", "NITF_", "AREA_OR_POINT", "METADATATYPE")
"""Prefixes of metadata items that are not copied to a restored image: they describe the raw pixels
or the raw file, or are written from other facts.
"""
UNWRITABLE = ("bidx", "ns")
"""Metadata items that rasterio cannot write, because options of its function have these names."""


def mask_file(path: Path) -> Path:
    """Return the path at which GDAL stores the validity mask of an image whose format has none."""
    return path.with_name(f"{path.name}.msk")


def raster_of(path: Path, dataset: Any) -> Raster:
    """Return the properties that GDAL states of an open image.

    Args:
        path: the path of the image, for messages and for facts that GDAL does not read.
        dataset: the image as rasterio has opened it.

    Raises:
        ImageError: the image cannot be restored: it has complex or inverted pixels, unlike bands,
            several pages, or is too large.
    """
    name = str(path)
    # The pages of a TIFF are several images.
    count = len(dataset.subdatasets)
    if dataset.count == 0 or count > 1:
        how = f" with 'gdal_translate {dataset.subdatasets[0]} one.tif'" if count else ""
        raise ImageError(
            f"{name} must hold one image, got {count}. Save the one that you mean as a file of its "
            f"own{how}."
        )
    mask_kind = _mask_kind(name, dataset)
    bands = dataset.count - (mask_kind == "alpha")
    for kind, values in (
        ("types", dataset.dtypes),
        ("nodata values", dataset.nodatavals[:bands]),
    ):
        texts = [str(value) for value in values]
        if len(set(texts)) > 1:
            stated = printable(", ".join(texts))
            raise ImageError(f"{name} has bands of different {kind}: {stated}. Split the bands.")
    dtype = require_pixel_type(name, np.dtype(dataset.dtypes[0]))
    require_size(name, bands, dataset.height, dataset.width)
    _require_light(name, dataset)
    for offset, scale in zip(dataset.offsets[:bands], dataset.scales[:bands], strict=True):
        require_small_offset(name, offset, scale)
    colours = [values.name for values in dataset.colorinterp]
    tags = dataset.tags()
    points, points_crs = dataset.gcps
    return Raster(
        bands,
        dataset.height,
        dataset.width,
        dtype,
        nodata=usable_nodata(dataset.nodatavals[0], dtype),
        bits=_bits(path, dataset),
        mask_kind=mask_kind,
        colour=colours[:bands] == list(RGB_BANDS),
        restored=is_restored(tags.get("TIFFTAG_SOFTWARE", ""), tags),
        # A transform, or ground control points.
        georeference=Georeference(
            crs=points_crs if points else dataset.crs,
            transform=None if points or dataset.transform.is_identity else dataset.transform,
            gcps=tuple((at.row, at.col, at.x, at.y, at.z or 0.0) for at in points),
            rpcs=_retained_tags(dataset.tags(ns="RPC")),
            area_or_point=tags.get("AREA_OR_POINT", ""),
        ),
        band_info=tuple(
            BandInfo(
                dataset.descriptions[band] or "",
                dataset.units[band] or "",
                dataset.scales[band],
                dataset.offsets[band],
                _retained_tags(dataset.tags(band + 1)),
            )
            for band in range(bands)
        ),
        tags=_retained_tags(tags),
    )


def _mask_kind(name: str, dataset: Any) -> MaskKind:
    """Return what marks missing pixels in addition to the nodata value."""
    is_alpha = [values.name == "alpha" for values in dataset.colorinterp]
    flags = {flag.name for flag in dataset.mask_flag_enums[0]}
    if any(is_alpha[:-1]) or is_alpha == [True]:
        raise ImageError(
            f"{name} must have alpha as the last band, after at least one other. Move it there."
        )
    # Where each band of a picture has its own nodata value, GDAL makes one mask of them.
    has_mask = "per_dataset" in flags and "alpha" not in flags
    mask = mask_file(Path(name))
    if mask.is_file() and (is_alpha[-1] or not has_mask):
        raise ImageError(
            f"The mask {mask} has no INTERNAL_MASK_FLAGS, so that GDAL does not read it, or its "
            "image has alpha as well. Write the mask with GDAL, or remove it."
        )
    if is_alpha[-1]:
        return "alpha"
    return "mask" if has_mask else ""


def _require_light(name: str, dataset: Any) -> None:
    """Raise ImageError if larger pixel values are not brighter."""
    structure = dataset.tags(ns="IMAGE_STRUCTURE")
    dark = sorted({values.name for values in dataset.colorinterp} & DARK)
    if structure.get("MINISWHITE") == "YES":
        dark = ["white as zero (MINISWHITE)"]
    elif structure.get("SOURCE_COLOR_SPACE") in ("CMYK", "CIELab"):
        dark = [structure["SOURCE_COLOR_SPACE"]]
    if dark:
        raise ImageError(
            f"{name} has pixels whose larger values are not brighter: {', '.join(dark)}. Convert "
            "it to grey or RGB; 'gdal_translate -expand' does it for palettes."
        )


def _bits(path: Path, dataset: Any) -> int | None:
    """Return the number of bits per pixel that the file states, the largest of its bands; None if a
    band states none.

    An image with a DIMAP index has the bits that the index states for the whole product.
    """
    if (product_bits := dimap_bits(path)) is not None:
        return product_bits
    band_bits = [
        str(dataset.tags(band, ns="IMAGE_STRUCTURE").get("NBITS", "")) for band in dataset.indexes
    ]
    texts = band_bits if all(band_bits) else [str(dataset.tags().get("NITF_ABPP", "")).strip()]
    most = max((int(text) for text in texts if text.isdecimal()), default=0)
    # Bits that fill the type describe the container, not the sensor.
    return most if 0 < most < 8 * np.dtype(dataset.dtypes[0]).itemsize else None


def _retained_tags(tags: dict[str, str]) -> tuple[tuple[str, str], ...]:
    """Return the metadata items that are copied to a restored image."""
    return tuple(
        (key, text)
        for key, text in sorted(tags.items())
        if not key.startswith(NOT_COPIED) and key not in UNWRITABLE
    )
