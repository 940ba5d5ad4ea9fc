"""An image as a source of rows: what is known before its pixels are read, and only what is touched
is decoded.

A `Raster` holds size, type, nodata value and the tags that place the image on Earth. A TIFF page is
a stream of rows; whatever else, and arrays, lie in memory.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import chain, product
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import tifffile

from beers_deploy.model.io.files import TIFF_SUFFIXES, sha256
from beers_deploy.model.io.images import (
    Extent,
    damage_in_a_sentence,
    extent_of,
    read_alpha,
    read_pixels,
    require_image_file,
)
from beers_deploy.model.io.tiff import check_page, image_pages, open_tiff
from beers_deploy.profiles.errors import ImageError
from beers_deploy.quant.untrusted import times

NODATA_TAG = 42113
CARRIED_TAGS = (33550, 33922, 34264, 34735, 34736, 34737, 42112, NODATA_TAG, 50844)
"""GeoTIFF's scale, tie points, transformation and keys; GDAL's metadata and nodata; rational
polynomials.
"""

RESTORED = "beers-deploy restore"
RESTORED_BY = "RESTORED_BY"
"""What a restored image names as its software, and the item of its metadata where it is
cloud-optimised.
"""
RGB = 2
RGB_BANDS = ("red", "green", "blue")
"""TIFF's photometric interpretation of bands of these colours."""

SIDE_PX = 1 << 22
BANDS = 1 << 12
"""An image has a plan of its tiles before any pixel is read: a header alone must not make that
large.
"""

Tag = tuple[int, int, int, Any, bool]
"""Code, type, count, value, once: what tifffile takes as an extra tag."""


Veil = Literal["", "mask", "unassalpha", "assocalpha"]
"""What hides pixels beside the bands: nothing, a mask, or alpha, which a colour may have been
multiplied by.
"""
ALPHAS: dict[int, Veil] = {1: "assocalpha", 2: "unassalpha"}
"""By TIFF's ExtraSamples."""


@dataclass(frozen=True)
class Raster:
    """An image as stored: `bands` planes of (height_px, width_px), of so many `bits` where the file
    says it.

    `veil` is what hides pixels besides NaN and the nodata value: where its plane is 0 they are
    missing. `colour` says that the bands are red, green and blue, `restored` that `restore` has
    written them.
    """

    bands: int
    height_px: int
    width_px: int
    dtype: np.dtype[Any]
    nodata: float | None = None
    tags: tuple[Tag, ...] = ()
    bits: int | None = None
    veil: Veil = ""
    colour: bool = False
    restored: bool = False

    @property
    def shape(self) -> tuple[int, int, int]:
        """Bands, height and width, (bands, H, W) in pixels."""
        return self.bands, self.height_px, self.width_px

    @property
    def out_dtype(self) -> np.dtype[Any]:
        """Of the restored image: float32 of floats, uint8 of uint8, uint16 of
        all other integers.
        """
        if self.dtype.kind == "f":
            return np.dtype(np.float32)
        return np.dtype(np.uint8 if self.dtype == np.uint8 else np.uint16)

    def missing(self, pixels: np.ndarray) -> np.ndarray:
        """Where stored pixels hold no measurement: NaN, the nodata value, or masked; bool of the
        same shape.
        """
        flags = np.ma.getmaskarray(pixels).copy()
        values = np.ma.getdata(pixels)
        if self.dtype.kind == "f":
            flags |= np.isnan(values)
        if self.nodata is not None:
            flags |= values == values.dtype.type(self.nodata)
        return flags

    def extent(self, pixels: np.ndarray) -> Extent:
        """The extent of the known ones among stored pixels."""
        return extent_of(np.ma.getdata(pixels), ~self.missing(pixels))

    @property
    def has_alpha(self) -> bool:
        """Whether alpha is what hides pixels."""
        return self.veil not in ("", "mask")

    @property
    def may_miss(self) -> bool:
        """Whether any pixel could be missing at all."""
        return self.dtype.kind == "f" or self.nodata is not None or bool(self.veil)

    def fill_margin_px(self, radius_px: int) -> int:
        """How far around a window pixels are read that missing ones of it may be filled from."""
        return radius_px if self.may_miss else 0


def raster_of(path: str, pages: Sequence[tifffile.TiffPage]) -> Raster:
    """What the pages of an image say of it, before any pixel is read."""
    page = pages[0]
    planes, _, height_px, width_px, samples = page.shaped
    bands = len(pages) * planes * samples
    require_size(path, bands, height_px, width_px)
    dtype = require_numbers(path, page.dtype)
    nodata = _nodata(path, page, dtype)
    tags = tuple(tag for tag in carried_tags(page) if tag[0] != NODATA_TAG or nodata is not None)
    # A container of whole bytes says nothing about the sensor; packed bits were counted.
    bits = (
        page.bitspersample
        if dtype.kind == "u" and page.bitspersample < 8 * dtype.itemsize
        else None
    )
    about = bits, _alpha(path, pages), page.photometric == RGB, is_restored(page.software, tags)
    return Raster(bands, height_px, width_px, dtype, nodata, tags, *about)


def is_restored(software: str, said: object) -> bool:
    """Whether an image was written by `restore`, by the software that it names
    or by its metadata.
    """
    return software.startswith(RESTORED) or RESTORED_BY in str(said)


def strips(height_px: int, step_px: int) -> Iterator[tuple[int, int]]:
    """First row and the one behind the last of each strip of an image."""
    for top in range(0, height_px, step_px):
        yield top, min(top + step_px, height_px)


def require_raw(name: str, restored: bool, again: bool) -> None:
    """Refuse to restore twice what is `restored`: the second time sharpens what is sharp."""
    if restored and not again:
        remedy = "give the raw one, or restore it once more with `again`"
        raise ImageError(
            name, expected="a raw image", got="one that 'restore' has written", remedy=remedy
        )


def _alpha(path: str, pages: Sequence[tifffile.TiffPage]) -> Veil:
    """The kind of alpha that the last sample of an image is, if any."""
    codes = chain.from_iterable(page.extrasamples for page in pages)
    alphas = [ALPHAS.get(int(code), "") for code in codes]
    if any(alphas[:-1]) or (any(alphas) and len(pages) > 1):
        raise ImageError(
            path, expected="alpha as the last band", got="one before others", remedy="move it there"
        )
    return alphas[-1] if alphas else ""


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
        raise ImageError(
            path, expected="integer or float pixels", got=got, remedy="convert it to uint16"
        )
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
    # A value that no pixel can have marks none, so that the image is as good without it.
    if not value.is_integer() or not limits.min <= value <= limits.max:
        return None
    if not 0 <= value <= np.iinfo(np.uint16).max:
        remedy = "give its missing pixels a value of 0 to 65535"
        raise ImageError(
            path, expected="a nodata value that uint16 holds", got=f"{value:g}", remedy=remedy
        )
    return value


BIG_TIFF_SUFFIXES = {".btf", ".tf8"}
GDAL_DRIVERS = {
    ".jp2": "JP2OpenJPEG",
    ".j2k": "JP2OpenJPEG",
    ".ntf": "NITF",
    ".nitf": "NITF",
    ".img": "HFA",
    ".vrt": "VRT",
    ".xml": "DIMAP",
}
"""By a file's suffix: others of GDAL's drivers open further files, or the network."""

Plane = Callable[[int, int], np.ndarray]
"""Gives rows `start` to `stop` (excluded) of one plane, (rows, width)."""
Rows = Callable[[int, int], np.ndarray]
"""Gives them of several bands, (bands, rows, width)."""


class Source(Protocol):
    """An image that gives its rows: a `raster` of facts, and pixels as they are asked for.

    Attributes:
        raster: the facts.
        files: that it is read from: its own, and the tiles that an index names; none for an array.
        veil: the plane of its mask or alpha, 0 where pixels are missing; None without one.
    """

    raster: Raster
    files: tuple[Path, ...]
    veil: Plane | None

    def read(self, start: int, stop: int) -> np.ndarray:
        """Rows `start` to `stop` (excluded) of every band, (bands, rows, width), as stored; masked
        where veiled.
        """

    def held_bytes(self, rows_px: int) -> int:
        """Memory that reading so many rows at a time takes, besides the rows themselves."""


class VeiledSource:
    """An image whose pixels are missing where a plane beside its bands is 0."""

    def __init__(
        self,
        source: Source,
        kind: Veil,
        mask: Rows | None = None,
        held_bytes: Callable[[int], int] = lambda _: 0,
        files: tuple[Path, ...] = (),
    ) -> None:
        """Of a source whose last band is its alpha, or of one with a mask.

        Args:
            source: the image.
            kind: of the veil.
            mask: gives rows of its mask, (1, rows, width).
            held_bytes: memory that the mask takes beside the image, by rows at a time.
            files: that the mask lies in, where they are others.
        """
        self._source = source
        self._mask = mask
        self._mask_bytes = held_bytes
        self.files = (*source.files, *files)
        bands = source.raster.bands - (mask is None)
        self.raster = replace(source.raster, bands=bands, veil=kind)
        self.veil: Plane | None = self._rows_of_veil

    def read(self, start: int, stop: int) -> np.ndarray:
        """Rows `start` to `stop` (excluded) of every band, masked where the veil is 0."""
        pixels = self._source.read(start, stop)
        hidden = (pixels[-1] if self._mask is None else self._rows_of_veil(start, stop)) == 0
        pixels = pixels[: self.raster.bands]
        return np.ma.MaskedArray(pixels, mask=np.broadcast_to(hidden, pixels.shape))

    def held_bytes(self, rows_px: int) -> int:
        """As the image's own, and the mask's."""
        return self._source.held_bytes(rows_px) + self._mask_bytes(rows_px)

    def _rows_of_veil(self, start: int, stop: int) -> np.ndarray:
        rows = (
            self._source.read(start, stop)[-1:] if self._mask is None else self._mask(start, stop)
        )
        return np.asarray(rows[0])


def fingerprint(files: Iterable[Path]) -> str:
    """Return one digest of the whole content of some files.

    Size and time alone, or the ends of a file, do not tell two images apart. SHA-256 reads 0.9 GB/s
    on one core: for a 12-bit image that is 0.2 % of a restoration's processor time (measured).
    """
    return hashlib.sha256("".join(map(sha256, files)).encode()).hexdigest()


def stamps(files: Iterable[Path]) -> list[tuple[int, int, int]]:
    """Return size, time of the last change and inode of each file: a quick sign that one may have
    changed.
    """
    stats = (file.stat() for file in files)
    return [(stat.st_size, stat.st_mtime_ns, stat.st_ino) for stat in stats]


@contextmanager
def open_source(path: Path, trusted: bool = False) -> Iterator[Source]:
    """Open an image for reading by rows: pages of a TIFF as streams, PNG and JPEG whole, others by
    windows of GDAL.

    Args:
        path: of the file, or of the index of its tiles.
        trusted: whether an index may name files outside its folder and at URLs.
    """
    require_image_file(path)
    suffix = path.suffix.lower()
    with ExitStack() as stack:
        if suffix in GDAL_DRIVERS:
            # GDAL comes with an optional package.
            from beers_deploy.restoration.gdal_source import open_gdal

            source = stack.enter_context(open_gdal(path, trusted))
        elif suffix in TIFF_SUFFIXES | BIG_TIFF_SUFFIXES:
            source = _of_pages(path, stack)
        else:
            source = whole_source(path)
        # These import what this module defines.
        from beers_deploy.restoration.georeference import of_sidecar, sidecar_of

        source.raster = of_sidecar(path, source.raster)
        if sidecar_of(path).is_file():
            source.files = (*source.files, sidecar_of(path))
        beside = path.with_name(f"{path.name}.msk")
        yield _masked(source, beside, stack) if beside.is_file() else source


def _of_pages(path: Path, stack: ExitStack) -> Source:
    """A TIFF's bands, in one page or in a page each, and its mask or alpha."""
    with damage_in_a_sentence(path):
        pages, mask = image_pages(path, stack.enter_context(open_tiff(path)))
        for page in [*pages, *([mask] if mask else [])]:
            check_page(path, page)
        source: Source = TiffSource(path, pages)
        if source.raster.veil:
            source = VeiledSource(source, source.raster.veil)
        return _with_mask(source, PageRows(path, mask), ()) if mask else source


def _masked(source: Source, path: Path, stack: ExitStack) -> Source:
    """An image with the mask of a file beside it, as GDAL writes one (IMAGE.msk)."""
    with damage_in_a_sentence(path):
        page = stack.enter_context(open_tiff(path)).pages.first
        check_page(path, page)
        return _with_mask(source, PageRows(path, page), (path,))


def _with_mask(source: Source, mask: "PageRows", files: tuple[Path, ...]) -> Source:
    raster = source.raster
    name = str(mask.path)
    if mask.shape != (1, raster.height_px, raster.width_px) or raster.veil:
        got = "alpha or another mask beside it" if raster.veil else f"one of {times(mask.shape)}"
        raise ImageError(
            name,
            expected=f"one mask of {times(raster.shape[1:])}",
            got=got,
            remedy="keep one of them",
        )
    return VeiledSource(source, "mask", mask.read, mask.held_bytes, files)


def whole_source(path: Path) -> Source:
    """An image read whole: PNG or JPEG."""
    pixels = read_pixels(path)
    alpha = read_alpha(path)
    dtype = require_numbers(str(path), pixels.dtype)
    bands = pixels[None] if pixels.ndim == 2 else np.moveaxis(pixels, 2, 0)
    planes = bands if alpha is None else np.concatenate([bands, alpha[None]])
    count, height_px, width_px = planes.shape
    source = ArraySource(
        planes,
        Raster(count, height_px, width_px, dtype, colour=len(bands) == len(RGB_BANDS)),
        (path,),
    )
    return source if alpha is None else VeiledSource(source, "unassalpha")


class ArraySource:
    """An image in memory: `pixels` (bands, height, width), of which rows are views."""

    veil: Plane | None = None

    def __init__(self, pixels: np.ndarray, raster: Raster, files: tuple[Path, ...] = ()) -> None:
        self._pixels = pixels
        self.raster = raster
        self.files = files

    def read(self, start: int, stop: int) -> np.ndarray:
        """Rows `start` to `stop` (excluded) of every band, (bands, rows, width), not copied."""
        return self._pixels[:, start:stop]

    def held_bytes(self, rows_px: int) -> int:  # noqa: ARG002
        """Nothing more than it holds from the start."""
        return 0


class TiffSource:
    """The bands of a TIFF, plain or BigTIFF, in one page or in a page each."""

    veil: Plane | None = None

    def __init__(self, path: Path, pages: Sequence[tifffile.TiffPage]) -> None:
        self.files: tuple[Path, ...] = (path,)
        self.raster = raster_of(str(path), pages)
        self._pages = [PageRows(path, page) for page in pages]

    def read(self, start: int, stop: int) -> np.ndarray:
        """Rows `start` to `stop` (excluded) of every band, (bands, rows, width), as stored."""
        bands = [page.read(start, stop) for page in self._pages]
        return bands[0] if len(bands) == 1 else np.concatenate(bands)

    def held_bytes(self, rows_px: int) -> int:
        """What each of the pages holds."""
        return sum(page.held_bytes(rows_px) for page in self._pages)


class PageRows:
    """The rows of one page of a TIFF, in strips or tiles, samples interleaved or in planes.

    Attributes:
        path: of the file.
        shape: bands, height and width.
    """

    def __init__(self, path: Path, page: tifffile.TiffPage) -> None:
        self.path = path
        self._page = page
        self._planes, _, height_px, width_px, self._samples = page.shaped
        self.shape = self._planes * self._samples, height_px, width_px
        self._dtype = np.dtype(page.dtype)
        self._segment_px = min(page.tilelength if page.is_tiled else page.rowsperstrip, height_px)
        self._down = -(-height_px // self._segment_px)
        self._across = -(-width_px // page.tilewidth) if page.is_tiled else 1
        # Strips of rows overlap, and a segment that two of them need is decoded once.
        self._held: dict[int, np.ndarray] = {}
        # Uncompressed and in one piece, rows lie in the file as they are: no more than those are
        # read.
        self._flat = (
            page.compression == 1 and page.is_contiguous and page.bitspersample in (8, 16, 32, 64)
        )

    def read(self, start: int, stop: int) -> np.ndarray:
        """Rows `start` to `stop` (excluded) of every band, (bands, rows, width), as stored."""
        with damage_in_a_sentence(self.path, f"rows {start} to {stop - 1}"):
            return self._read_flat(start, stop) if self._flat else self._read_segments(start, stop)

    def held_bytes(self, rows_px: int) -> int:
        """Whole segments around the rows, and one row of segments, packed and decoded, while it is
        read.
        """
        if self._flat:
            return 0
        covered = min(rows_px + 2 * self._segment_px, self._down * self._segment_px)
        row_bytes = self.shape[0] * self.shape[2] * self._dtype.itemsize
        return (covered + 2 * self._segment_px) * row_bytes

    def _read_flat(self, start: int, stop: int) -> np.ndarray:
        _, height, width = self.shape
        samples = self._samples
        rows = stop - start
        # A TIFF has the byte order of the machine that wrote it.
        kind = self._dtype.newbyteorder(self._page.parent.byteorder)
        out = np.empty((self._planes, samples, rows, width), self._dtype)
        for plane in range(self._planes):
            first = (plane * height + start) * width * samples
            offset = self._page.dataoffsets[0] + first * kind.itemsize
            pixels = np.fromfile(self.path, kind, rows * width * samples, offset=offset)
            out[plane] = np.moveaxis(pixels.reshape(rows, width, samples), 2, 0)
        return out.reshape(-1, rows, width)

    def _read_segments(self, start: int, stop: int) -> np.ndarray:
        size = self._segment_px
        first = start // size
        last = -(-stop // size)
        self._held = {row: pixels for row, pixels in self._held.items() if first <= row < last}
        out = np.empty((self.shape[0], stop - start, self.shape[2]), self._dtype)
        for row in range(first, last):
            pixels = self._held[row] = self._held[row] if row in self._held else self._decode(row)
            top = row * size
            low = max(start, top)
            high = min(stop, top + size)
            out[:, low - start : high - start] = pixels[:, low - top : high - top]
        return out

    def _decode(self, row: int) -> np.ndarray:
        """The strips or tiles at one height, (bands, segment rows, width)."""
        page = self._page
        bands, _, width = self.shape
        block = np.empty((self._planes, self._samples, self._segment_px, width), self._dtype)
        # TIFF numbers segments from left to right, then downwards, then plane by plane.
        segments = [
            (plane * self._down + row) * self._across + column
            for plane, column in product(range(self._planes), range(self._across))
        ]
        offsets = [page.dataoffsets[i] for i in segments]
        counts = [page.databytecounts[i] for i in segments]
        jpeg = {"jpegtables": page.jpegtables, "jpegheader": page.jpegheader}
        for data, index in page.parent.filehandle.read_segments(offsets, counts, segments):
            pixels, (plane, _, _, left, _), (_, rows, columns, _) = page.decode(data, index, **jpeg)
            # The tiles at the right and lower border reach beyond the image.
            rows = min(rows, self._segment_px)
            columns = min(columns, width - left)
            target = block[plane, :, :rows, left : left + columns]
            target[:] = (
                page.nodata if pixels is None else np.moveaxis(pixels[0, :rows, :columns], 2, 0)
            )
        return block.reshape(bands, self._segment_px, width)
