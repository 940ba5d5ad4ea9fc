"""An image as a source of rows: what is known before its pixels are read, and only what is touched is decoded.

A `Raster` holds size, type, nodata value and the tags that place the image on Earth. A TIFF page is a stream of rows;
whatever else, and arrays, lie in memory.
"""

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import tifffile

from beers_deploy.model.io.files import TIFF_SUFFIXES
from beers_deploy.model.io.images import damage_in_a_sentence, read_pixels, require_image_file
from beers_deploy.model.io.tiff import check_page, open_tiff
from beers_deploy.profiles.errors import ImageError

NODATA_TAG = 42113
CARRIED_TAGS = (33550, 33922, 34264, 34735, 34736, 34737, 42112, NODATA_TAG, 50844)
"""GeoTIFF's scale, tie points, transformation and keys; GDAL's metadata and nodata; rational polynomials."""

SIDE_PX, BANDS = 1 << 22, 1 << 12
"""An image has a plan of its tiles before any pixel is read: a header alone must not make that large."""

Tag = tuple[int, int, int, Any, bool]
"""Code, type, count, value, once: what tifffile takes as an extra tag."""


@dataclass(frozen=True)
class Raster:
    """An image as stored: `bands` planes of (height_px, width_px), of so many `bits` where the file says it."""

    bands: int
    height_px: int
    width_px: int
    dtype: np.dtype[Any]
    nodata: float | None = None
    tags: tuple[Tag, ...] = ()
    bits: int | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Bands, height and width, (bands, H, W) in pixels."""
        return self.bands, self.height_px, self.width_px

    @property
    def out_dtype(self) -> np.dtype[Any]:
        """Of the restored image: float32 of floats, uint8 of uint8, uint16 of all other integers."""
        if self.dtype.kind == "f":
            return np.dtype(np.float32)
        return np.dtype(np.uint8 if self.dtype == np.uint8 else np.uint16)

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

    def fill_margin_px(self, radius_px: int) -> int:
        """How far around a window pixels are read that missing ones of it may be filled from."""
        return radius_px if self.may_miss else 0


def page_raster(path: str, page: tifffile.TiffPage) -> Raster:
    """What a TIFF page says of its image, before any pixel is read."""
    planes, _, height_px, width_px, samples = page.shaped
    require_size(path, planes * samples, height_px, width_px)
    dtype = require_numbers(path, page.dtype)
    nodata = _nodata(path, page, dtype)
    tags = tuple(tag for tag in carried_tags(page) if tag[0] != NODATA_TAG or nodata is not None)
    # A container of whole bytes says nothing of the sensor; packed bits were counted by somebody.
    bits = page.bitspersample if dtype.kind == "u" and page.bitspersample < 8 * dtype.itemsize else None
    return Raster(planes * samples, height_px, width_px, dtype, nodata, tags, bits)


def carried_tags(page: tifffile.TiffPage) -> tuple[Tag, ...]:
    """The tags of a page that a restored image keeps."""
    tags = [page.tags[code] for code in CARRIED_TAGS if code in page.tags]
    return tuple((tag.code, int(tag.dtype), tag.count, tag.value, True) for tag in tags)


def require_size(path: str, bands: int, height_px: int, width_px: int) -> None:
    """That an image can be planned."""
    if max(height_px, width_px) > SIDE_PX or bands > BANDS:
        got = f"{bands} bands of {width_px} x {height_px} pixels"
        expected = f"at most {BANDS} bands of {SIDE_PX} pixels a side"
        raise ImageError(path, expected=expected, got=got, remedy="cut it into pieces")


def require_numbers(path: str, dtype: np.dtype[Any] | None) -> np.dtype[Any]:
    """The type of the pixels, unless they are complex or packed bits."""
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
    """A nodata value; None for one that no pixel of this type can have."""
    if value is None or dtype.kind == "f":
        return value
    limits = np.iinfo(dtype)
    if not value.is_integer() or not limits.min <= value <= limits.max:
        return None
    if not 0 <= value <= np.iinfo(np.uint16).max:
        remedy = "give its missing pixels a value of 0 to 65535"
        raise ImageError(path, expected="a nodata value that uint16 holds", got=f"{value:g}", remedy=remedy)
    return value


BIG_TIFF_SUFFIXES = {".btf", ".tf8"}
GDAL_DRIVERS = {
    ".jp2": "JP2OpenJPEG", ".j2k": "JP2OpenJPEG", ".ntf": "NITF", ".nitf": "NITF", ".img": "HFA", ".vrt": "VRT",
    ".xml": "DIMAP",
}  # fmt: skip
"""By a file's suffix: others of GDAL's drivers open further files, or the network."""
DIGEST_BYTES = 1 << 16
"""Of each end of a file."""


class Source(Protocol):
    """An image that gives its rows: a `raster` of facts, and pixels as they are asked for.

    Attributes:
        raster: the facts.
        files: that it is read from: its own, and the tiles that an index names; none for an array.
    """

    raster: Raster
    files: tuple[Path, ...]

    def read(self, start: int, stop: int) -> np.ndarray:
        """Rows `start` to `stop` (excluded) of every band, (bands, rows, width), as stored."""

    def held_bytes(self, rows_px: int) -> int:
        """Memory that reading so many rows at a time takes, besides the rows themselves."""


def fingerprint(files: Iterable[Path]) -> tuple[int, str]:
    """The files' size in bytes, and the SHA-256 of the two ends of each: quick at any size."""
    digest, total_bytes = hashlib.sha256(), 0
    for file in files:
        size_bytes = file.stat().st_size
        total_bytes += size_bytes
        with file.open("rb") as stream:
            digest.update(stream.read(DIGEST_BYTES))
            stream.seek(max(size_bytes - DIGEST_BYTES, 0))
            digest.update(stream.read(DIGEST_BYTES))
    return total_bytes, digest.hexdigest()


@contextmanager
def open_source(path: Path, trusted: bool = False) -> Iterator[Source]:
    """Open an image for reading by rows: a TIFF page as a stream, PNG and JPEG whole, others by windows of GDAL.

    Args:
        path: of the file, or of the index of its tiles.
        trusted: whether an index may name files outside its folder and at URLs.
    """
    require_image_file(path)
    suffix = path.suffix.lower()
    if suffix in GDAL_DRIVERS:
        from beers_deploy.restoration.gdal_source import open_gdal  # of an optional package

        with open_gdal(path, trusted) as source:
            yield source
    elif suffix in TIFF_SUFFIXES | BIG_TIFF_SUFFIXES:
        with open_page(path) as source:
            yield source
    else:
        yield whole_source(path)


@contextmanager
def open_page(path: Path) -> Iterator[Source]:
    """A TIFF of one page as a stream, of several whole."""
    with damage_in_a_sentence(path):
        file = open_tiff(path)
    with file:
        with damage_in_a_sentence(path):
            series = file.series[0]
            page = series.keyframe
            one_page = page.shaped[1] == 1 and page.size == series.size
            check_page(path, page)
            source = TiffSource(path, page) if one_page else whole_source(path)
        yield source


def whole_source(path: Path) -> "ArraySource":
    """An image read whole: PNG, JPEG, and TIFFs of several pages."""
    pixels = read_pixels(path)
    dtype = require_numbers(str(path), pixels.dtype)
    bands = pixels[None] if pixels.ndim == 2 else np.moveaxis(pixels, 2, 0)
    count, height_px, width_px = bands.shape
    return ArraySource(bands, Raster(count, height_px, width_px, dtype), (path,))


class ArraySource:
    """An image in memory: `pixels` (bands, height, width), of which rows are views."""

    def __init__(self, pixels: np.ndarray, raster: Raster, files: tuple[Path, ...] = ()) -> None:
        self._pixels, self.raster, self.files = pixels, raster, files

    def read(self, start: int, stop: int) -> np.ndarray:
        """Rows `start` to `stop` (excluded) of every band, (bands, rows, width), not copied."""
        return self._pixels[:, start:stop]

    def held_bytes(self, rows_px: int) -> int:  # noqa: ARG002
        """Nothing more than it holds from the start."""
        return 0


class TiffSource:
    """One page of a TIFF, plain or BigTIFF, in strips or tiles, samples interleaved or in planes."""

    def __init__(self, path: Path, page: tifffile.TiffPage) -> None:
        self._path, self._page = path, page
        self.files: tuple[Path, ...] = (path,)
        self.raster = page_raster(str(path), page)
        self._planes, _, height_px, width_px, self._samples = page.shaped
        self._segment_px = min(page.tilelength if page.is_tiled else page.rowsperstrip, height_px)
        self._down = -(-height_px // self._segment_px)
        self._across = -(-width_px // page.tilewidth) if page.is_tiled else 1
        self._held: dict[int, np.ndarray] = {}  # strips of rows overlap: segments are decoded once
        # Uncompressed and in one piece, rows lie in the file as they are: no more than those is read.
        self._flat = page.compression == 1 and page.is_contiguous and page.bitspersample in (8, 16, 32, 64)

    def read(self, start: int, stop: int) -> np.ndarray:
        """Rows `start` to `stop` (excluded) of every band, (bands, rows, width), as stored."""
        with damage_in_a_sentence(self._path, f"rows {start} to {stop - 1}"):
            return self._read_flat(start, stop) if self._flat else self._read_segments(start, stop)

    def held_bytes(self, rows_px: int) -> int:
        """Whole segments around the rows, and one row of segments, packed and decoded, while it is read."""
        if self._flat:
            return 0
        covered = min(rows_px + 2 * self._segment_px, self._down * self._segment_px)
        row_bytes = self.raster.bands * self.raster.width_px * self.raster.dtype.itemsize
        return (covered + 2 * self._segment_px) * row_bytes

    def _read_flat(self, start: int, stop: int) -> np.ndarray:
        width, samples, rows = self.raster.width_px, self._samples, stop - start
        kind = self.raster.dtype.newbyteorder(self._page.parent.byteorder)
        out = np.empty((self._planes, samples, rows, width), self.raster.dtype)
        for plane in range(self._planes):
            first = (plane * self.raster.height_px + start) * width * samples
            offset = self._page.dataoffsets[0] + first * kind.itemsize
            pixels = np.fromfile(self._path, kind, rows * width * samples, offset=offset)
            out[plane] = np.moveaxis(pixels.reshape(rows, width, samples), 2, 0)
        return out.reshape(self.raster.bands, rows, width)

    def _read_segments(self, start: int, stop: int) -> np.ndarray:
        size = self._segment_px
        first, last = start // size, -(-stop // size)
        self._held = {row: pixels for row, pixels in self._held.items() if first <= row < last}
        out = np.empty((self.raster.bands, stop - start, self.raster.width_px), self.raster.dtype)
        for row in range(first, last):
            pixels = self._held[row] = self._held[row] if row in self._held else self._decode(row)
            top = row * size
            low, high = max(start, top), min(stop, top + size)
            out[:, low - start : high - start] = pixels[:, low - top : high - top]
        return out

    def _decode(self, row: int) -> np.ndarray:
        """The strips or tiles at one height, (bands, segment rows, width)."""
        page, raster = self._page, self.raster
        block = np.empty((self._planes, self._samples, self._segment_px, raster.width_px), raster.dtype)
        wanted = [(p * self._down + row) * self._across + c for p in range(self._planes) for c in range(self._across)]
        offsets, counts = [page.dataoffsets[i] for i in wanted], [page.databytecounts[i] for i in wanted]
        jpeg = {"jpegtables": page.jpegtables, "jpegheader": page.jpegheader}
        for data, index in page.parent.filehandle.read_segments(offsets, counts, wanted):
            pixels, (plane, _, _, left, _), (_, rows, columns, _) = page.decode(data, index, **jpeg)
            rows, columns = min(rows, self._segment_px), min(columns, raster.width_px - left)
            target = block[plane, :, :rows, left : left + columns]
            target[:] = page.nodata if pixels is None else np.moveaxis(pixels[0, :rows, :columns], 2, 0)
        return block.reshape(raster.bands, self._segment_px, raster.width_px)
