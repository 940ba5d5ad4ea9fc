"""Describe an image before its pixels are read: size, type, missing pixels, georeference."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from beers_deploy.profiles.errors import ImageError, counted

SIDE_PX = 1 << 22
BANDS = 1 << 12
"""The maximum size of an image. Its tiles are planned before any pixel is read, so a header alone
must not make that plan large.
"""

RESTORED = "beers-deploy restore"
"""The software that a restored image names."""
RESTORED_BY = "RESTORED_BY"
"""The metadata item that a Cloud-Optimised restored image has."""

OFFSET_DN = 40
"""Largest pixel value that may stand for no light: 1 % of 12 bits."""

RGB_BANDS = ("red", "green", "blue")

MaskKind = Literal["", "mask", "alpha"]
"""The kind of mask that marks missing pixels, in addition to NaN and the nodata value."""

ControlPoint = tuple[float, float, float, float, float]
"""A ground control point: row and column in pixels, then x, y and z in the reference system."""


class Extent(NamedTuple):
    """A summary of some pixels, by which their unit is guessed.

    Attributes:
        largest: the largest absolute value, 0 if there are no pixels.
        whole: True if all values are integers.
    """

    largest: float
    whole: bool


def extent_of(pixels: np.ndarray, valid: np.ndarray | bool = True) -> Extent:
    """Return the largest absolute value of some pixels, and whether all are integers.

    Args:
        pixels: values as stored in the file, of any shape.
        valid: bool of the same shape, True for the pixels to consider; by default all.
    """
    low, high = (float(extreme(pixels, where=valid, initial=0)) for extreme in (np.min, np.max))
    integers = pixels.dtype.kind != "f" or bool((np.rint(pixels) == pixels).all(where=valid))
    return Extent(max(-low, high), integers)


@dataclass(frozen=True)
class Georeference:
    """The position of an image on Earth, in GDAL's terms.

    Attributes:
        crs: the coordinate reference system of `transform` or of the ground control points.
        transform: the affine transform from pixel corners (column, row) to coordinates; None
            without one.
        gcps: ground control points; GDAL reads these or a transform.
        rpcs: rational polynomial coefficients, as pairs of GDAL's name and the text of the value.
        area_or_point: "Area" or "Point", GDAL's AREA_OR_POINT: what the value of a pixel stands
            for; empty if the file does not state it.
    """

    crs: Any = None
    transform: Any = None
    gcps: tuple[ControlPoint, ...] = ()
    rpcs: tuple[tuple[str, str], ...] = ()
    area_or_point: str = ""

    def enlarged(self, scale: float) -> "Georeference":
        """Return the georeference of the same image with `scale` times the pixels along either
        side; fewer of them if `scale` is below 1.

        A pixel's corner at (column, row) moves to `scale` times both. Rational polynomials count
        from the middle of the first pixel, so their offsets also move by half a pixel (NITF
        STDI-0002, RPC00B). Polynomials whose offsets or scales are no numbers are left out.
        """
        if scale == 1:
            return self
        coefficients = dict(self.rpcs)
        points = tuple((row * scale, column * scale, x, y, z) for row, column, x, y, z in self.gcps)
        try:
            for key in coefficients.keys() & {"LINE_OFF", "SAMP_OFF"}:
                coefficients[key] = repr((_number(coefficients[key]) + 0.5) * scale - 0.5)
            for key in coefficients.keys() & {"LINE_SCALE", "SAMP_SCALE"}:
                coefficients[key] = repr(_number(coefficients[key]) * scale)
        except (ValueError, IndexError):
            coefficients = {}
        transform = self.transform
        if transform is not None:
            a, b, c, d, e, f = transform[:6]
            transform = type(transform)(a / scale, b / scale, c, d / scale, e / scale, f)
        return replace(
            self,
            transform=transform,
            gcps=points,
            rpcs=tuple(coefficients.items()),
        )


def _number(text: str) -> float:
    """Return the number that a text begins with; some products add a unit."""
    return float(text.split()[0])


@dataclass(frozen=True)
class BandInfo:
    """The description of one band in a file.

    Attributes:
        name: the name of the band; empty without one.
        unit: the unit of the physical values; empty without one.
        scale: physical value = scale * pixel + offset.
        offset: see `scale`.
        tags: further metadata items of the band, as pairs of name and text.
    """

    name: str = ""
    unit: str = ""
    scale: float = 1.0
    offset: float = 0.0
    tags: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Raster:
    """The facts of an image file before its pixels are read: `bands` planes of (height_px,
    width_px).

    Attributes:
        bands: the number of planes of light; an alpha band is not counted.
        height_px: the number of rows.
        width_px: the number of columns.
        dtype: the dtype of the pixels.
        nodata: the value of missing pixels; None without one.
        bits: the number of bits of a pixel that the sensor uses; None if the file does not state
            it.
        mask_kind: what marks missing pixels in addition to NaN and `nodata`; empty if nothing does.
        colour: True if the bands are red, green and blue.
        restored: True if this project's `restore` has written the image.
        georeference: where the image lies on Earth.
        band_info: names, units and scales; empty, or one for each band.
        tags: the file's metadata items that a restored image keeps, as pairs of name and text.
    """

    bands: int
    height_px: int
    width_px: int
    dtype: np.dtype[Any]
    nodata: float | None = None
    bits: int | None = None
    mask_kind: MaskKind = ""
    colour: bool = False
    restored: bool = False
    georeference: Georeference = Georeference()
    band_info: tuple[BandInfo, ...] = ()
    tags: tuple[tuple[str, str], ...] = ()

    @property
    def shape(self) -> tuple[int, int, int]:
        """The number of bands, height and width, (bands, H, W) in pixels."""
        return self.bands, self.height_px, self.width_px

    @property
    def out_dtype(self) -> np.dtype[Any]:
        """The type of the restored image: float32 for floats, else the type of the pixels."""
        return np.dtype(np.float32) if self.dtype.kind == "f" else self.dtype

    def unrestored(self, pixels: np.ndarray) -> np.ndarray:
        """Return missing pixels, of any shape, in the type of the restored image; float64 values
        beyond float32 become infinite.
        """
        with np.errstate(over="ignore"):
            return pixels.astype(self.out_dtype)

    @property
    def band_names(self) -> tuple[str, ...]:
        """The names of the bands; empty if any band has none."""
        names = tuple(band.name for band in self.band_info)
        return names if all(names) else ()

    def missing(self, pixels: np.ndarray) -> np.ndarray:
        """Return which pixels hold no measurement, because they are NaN, have the nodata value, or
        are masked.

        Args:
            pixels: pixels of this image as stored, of any shape; a masked array if the image has a
                mask.

        Returns:
            Bool of the same shape, True for missing pixels.
        """
        flags = np.ma.getmaskarray(pixels).copy()
        values = np.ma.getdata(pixels)
        if self.dtype.kind == "f":
            flags |= np.isnan(values)
        if self.nodata is not None:
            flags |= values == values.dtype.type(self.nodata)
        return flags

    def extent(self, pixels: np.ndarray) -> Extent:
        """Return the largest absolute value of the pixels that are not missing, and whether all are
        integers.
        """
        return extent_of(np.ma.getdata(pixels), ~self.missing(pixels))

    @property
    def may_miss(self) -> bool:
        """True if the image can have missing pixels: if its pixels are floats, or it has a nodata
        value or a mask.
        """
        return self.dtype.kind == "f" or self.nodata is not None or bool(self.mask_kind)

    def enlarged(self, shape: Sequence[int]) -> "Raster":
        """Return the facts of the restored image, which may have more pixels and other bands.

        Args:
            shape: the shape (bands, H, W) of the restored image; H and W are multiples of the size
                of this image.
        """
        bands, height_px, width_px = shape
        alike = bands == self.bands
        nodata = None if self.nodata is None else float(self.unrestored(np.array(self.nodata)))
        return replace(
            self,
            bands=bands,
            height_px=height_px,
            width_px=width_px,
            dtype=self.out_dtype,
            nodata=nodata,
            colour=self.colour and alike,
            georeference=self.georeference.enlarged(width_px // self.width_px),
            band_info=self.band_info if alike else (),
        )


def require_size(name: str, bands: int, height_px: int, width_px: int) -> None:
    """Raise ImageError if an image is too large, so that even planning its tiles would take too
    much memory.
    """
    if max(height_px, width_px) > SIDE_PX or bands > BANDS:
        raise ImageError(
            f"{name} has {counted(bands, 'band')} of {width_px} x {height_px} pixels, but at most "
            f"{BANDS} bands of {SIDE_PX} pixels a side can be read. Cut it into pieces."
        )


def require_pixel_type(name: str, dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type of the pixels; raise ImageError if it is no integer or float type."""
    if dtype.kind not in "uif":
        raise ImageError(
            f"{name} must have integer or float pixels, got {dtype}. Convert it to uint16."
        )
    return dtype


def require_small_offset(name: str, offset: float, scale: float) -> None:
    """Raise ImageError if a pixel value of 0 does not mean, approximately, that there is no light.

    Physical value = scale x pixel + offset, so that no light has the pixel value -offset / scale.

    Args:
        name: the name of the image, for the message.
        offset: the offset that the file states for its band.
        scale: the scale that the file states for its band.
    """
    if abs(offset) > OFFSET_DN * abs(scale):
        dark = -offset / (scale or 1)
        raise ImageError(
            f"{name} must have pixels whose 0 is no light, but its offset of {offset:g} and scale "
            f"of {scale:g} put no light at {dark:g} DN. Subtract that from the pixels, or remove "
            "the offset with 'gdal_edit.py -offset 0' if the pixels do not include it."
        )


def usable_nodata(value: float | None, dtype: np.dtype[Any]) -> float | None:
    """Return the nodata value of an image, or None if the type of its pixels cannot hold it."""
    if value is None:
        return None
    # A nodata value that no pixel can have marks none, so it is ignored.
    if dtype.kind == "f":
        fits = not math.isfinite(value) or abs(value) <= float(np.finfo(dtype).max)
    else:
        limits = np.iinfo(dtype)
        fits = float(value).is_integer() and limits.min <= value <= limits.max
    return value if fits else None


def is_restored(software: str, metadata: object) -> bool:
    """Return True if this project's `restore` has written an image.

    Args:
        software: the software that the file names, its tag TIFFTAG_SOFTWARE.
        metadata: all metadata items of the file.
    """
    return software.startswith(RESTORED) or RESTORED_BY in str(metadata)


def require_raw(name: str, restored: bool, force: bool) -> None:
    """Raise ImageError if an image was restored before: a second restoration over-sharpens it.

    Args:
        name: the name of the image, for the message.
        restored: True if the image was restored before.
        force: True if the user wants to restore it all the same, so that no error is raised.
    """
    if restored and not force:
        raise ImageError(
            f"{name} is not a raw image, because 'restore' has written it. Give the raw one, or "
            "restore it once more with `force`."
        )
