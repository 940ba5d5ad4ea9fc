"""Bands of rows from an image file: only the strips or tiles touched are decoded, each once while reading downwards.

Uncompressed rows that lie one after another are read as they are. They are not memory-mapped: mapped pages count as
memory, and a file cut short under a map kills the process.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np
import tifffile

from deploy.swath.raster import Raster, page_raster, require_numbers
from model.images import TIFF_SUFFIXES, damage_in_a_sentence, read_pixels, require_image_file
from model.tiff import open_tiff
from model.tiff_page import check_page

BIG_TIFF_SUFFIXES = {".btf", ".tf8"}


class Source(Protocol):
    """An image that gives rows."""

    raster: Raster

    def read(self, start: int, stop: int) -> np.ndarray:
        """Rows `start` to `stop` (excluded) of every band, (bands, rows, width), as stored."""

    def held_bytes(self, rows_px: int) -> int:
        """Memory that reading so many rows at a time takes, besides the rows themselves."""


@contextmanager
def open_source(path: Path) -> Iterator[Source]:
    """Open an image for reading by rows: a TIFF page as a stream, anything else whole.

    Raises:
        ImageError: no such file, or no image of numbers.
        MachineError: an unknown compression, or an image read whole that does not fit in memory.
    """
    require_image_file(path)
    if path.suffix.lower() not in TIFF_SUFFIXES | BIG_TIFF_SUFFIXES:
        yield whole_source(path)
        return
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
    return ArraySource(bands, Raster(count, height_px, width_px, dtype))


class ArraySource:
    """An image in memory, (bands, height, width)."""

    def __init__(self, pixels: np.ndarray, raster: Raster) -> None:
        self._pixels, self.raster = pixels, raster

    def read(self, start: int, stop: int) -> np.ndarray:
        """See Source."""
        return self._pixels[:, start:stop]

    def held_bytes(self, rows_px: int) -> int:  # noqa: ARG002
        """Nothing more than it holds from the start."""
        return 0


class TiffSource:
    """One page of a TIFF, plain or BigTIFF, in strips or tiles, samples interleaved or in planes."""

    def __init__(self, path: Path, page: tifffile.TiffPage) -> None:
        self._path, self._page = path, page
        self.raster = page_raster(str(path), page)
        self._planes, _, height_px, width_px, self._samples = page.shaped
        self._segment_px = min(page.tilelength if page.is_tiled else page.rowsperstrip, height_px)
        self._down = -(-height_px // self._segment_px)
        self._across = -(-width_px // page.tilewidth) if page.is_tiled else 1
        self._held: dict[int, np.ndarray] = {}
        self._flat = page.compression == 1 and page.is_contiguous and page.bitspersample in (8, 16, 32, 64)

    def read(self, start: int, stop: int) -> np.ndarray:
        """See Source."""
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
            pixels = self._held[row] if row in self._held else self._decode(row)
            self._held[row] = pixels
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
