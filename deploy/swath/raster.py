"""What is known of an image before its pixels are read: size, type, nodata, and the tags that place it on Earth."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import tifffile

from profiles.errors import ImageError

NODATA_TAG = 42113
CARRIED_TAGS = (33550, 33922, 34264, 34735, 34736, 34737, 42112, NODATA_TAG, 50844)
"""GeoTIFF's scale, tie points, transformation and keys; GDAL's metadata and nodata; rational polynomials."""

SIDE_PX, BANDS = 1 << 22, 1 << 12
"""An image has a plan of its tiles before any pixel is read: a header alone must not make that large."""

Tag = tuple[int, int, int, Any, bool]
"""Code, type, count, value, once: what tifffile takes as an extra tag."""


@dataclass(frozen=True)
class Raster:
    """An image as stored: `bands` planes of (height_px, width_px)."""

    bands: int
    height_px: int
    width_px: int
    dtype: np.dtype[Any]
    nodata: float | None = None
    tags: tuple[Tag, ...] = ()

    @property
    def shape(self) -> tuple[int, int, int]:
        """(bands, height, width)."""
        return self.bands, self.height_px, self.width_px

    @property
    def out_dtype(self) -> np.dtype[Any]:
        """Of the restored image: uint16 of integers, float32 of floats."""
        return np.dtype(np.float32 if self.dtype.kind == "f" else np.uint16)

    def missing(self, pixels: np.ndarray) -> np.ndarray:
        """Where stored pixels hold no measurement: NaN or the nodata value; bool of the same shape."""
        flags = np.isnan(pixels) if self.dtype.kind == "f" else np.zeros(pixels.shape, bool)
        if self.nodata is not None:
            flags |= pixels == pixels.dtype.type(self.nodata)
        return flags

    def largest(self, pixels: np.ndarray) -> float:
        """The largest size of a known pixel among these, 0 where none is known."""
        known = ~self.missing(pixels)
        low, high = (float(extreme(pixels, where=known, initial=0)) for extreme in (np.min, np.max))
        return max(-low, high)

    @property
    def may_miss(self) -> bool:
        """Whether any pixel could be missing at all."""
        return self.dtype.kind == "f" or self.nodata is not None


def page_raster(path: str, page: tifffile.TiffPage) -> Raster:
    """The raster of a TIFF page.

    Raises:
        ImageError: too large to be planned, pixels that are no real numbers, or a nodata value that the output could
            not hold.
    """
    planes, _, height_px, width_px, samples = page.shaped
    if max(height_px, width_px) > SIDE_PX or planes * samples > BANDS:
        got = f"{planes * samples} bands of {width_px} x {height_px} pixels"
        expected = f"at most {BANDS} bands of {SIDE_PX} pixels a side"
        raise ImageError(path, expected=expected, got=got, remedy="cut it into pieces")
    dtype = require_numbers(path, page.dtype)
    tags = [page.tags[code] for code in CARRIED_TAGS if code in page.tags]
    nodata = _nodata(path, page, dtype)
    carried = [t for t in tags if t.code != NODATA_TAG or nodata is not None]
    return Raster(
        planes * samples,
        height_px,
        width_px,
        dtype,
        nodata,
        tuple((t.code, int(t.dtype), t.count, t.value, True) for t in carried),
    )


def require_numbers(path: str, dtype: np.dtype[Any] | None) -> np.dtype[Any]:
    """The type of the pixels, unless they are complex or packed bits.

    Raises:
        ImageError: pixels that are neither integers nor floats.
    """
    if dtype is None or dtype.kind not in "uif":
        got = str(dtype or "packed bits")
        raise ImageError(path, expected="integer or float pixels", got=got, remedy="convert it to uint16")
    return dtype


def _nodata(path: str, page: tifffile.TiffPage, dtype: np.dtype[Any]) -> float | None:
    """The nodata value of a page; None without one that can be read."""
    if NODATA_TAG not in page.tags:
        return None
    try:
        value = float(str(page.tags[NODATA_TAG].value).strip("\x00 "))
    except ValueError:
        return None
    return usable_nodata(path, value, dtype)


def usable_nodata(path: str, value: float | None, dtype: np.dtype[Any]) -> float | None:
    """A nodata value; None for one that no pixel of this type can have.

    Raises:
        ImageError: the output could not hold it.
    """
    if value is None or dtype.kind == "f":
        return value
    limits = np.iinfo(dtype)
    if not value.is_integer() or not limits.min <= value <= limits.max:
        return None
    if not 0 <= value <= np.iinfo(np.uint16).max:
        remedy = "give its missing pixels a value of 0 to 65535"
        raise ImageError(path, expected="a nodata value that uint16 holds", got=f"{value:g}", remedy=remedy)
    return value
