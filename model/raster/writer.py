"""Write images: TIFFs by rows, from rows that are read twice; and Cloud-Optimised GeoTIFFs.

GDAL compresses in threads, which lose the errors of a full disk. It writes the last blocks when the
file is closed, for which rasterio reports no errors. A written file is therefore read again and
compared with the given pixels.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import rasterio
from rasterio.control import GroundControlPoint
from rasterio.enums import ColorInterp
from rasterio.io import MemoryFile
from rasterio.shutil import copy
from rasterio.windows import Window

from beers_deploy.model.io.files import whole_file
from beers_deploy.model.raster.compression import Compression
from beers_deploy.model.raster.facts import RESTORED, BandInfo, Raster
from beers_deploy.model.raster.reader import LEAST_CACHE_BYTES, OFFLINE, gdal
from beers_deploy.model.raster.source import strips
from beers_deploy.profiles.errors import CODE_FAULTS, OptionError
from beers_deploy.profiles.rounding import up_to_multiple

RGB = [ColorInterp.red, ColorInterp.green, ColorInterp.blue]
TILE_PX = 256
ROOM_BYTES = 8 * TILE_PX**2
"""The largest size of a tile in bytes, which a disk that is not full has room for."""
COG_TILE_PX = 512


CODECS = {"none": "NONE", "zlib": "DEFLATE", "zstd": "ZSTD", "lzw": "LZW"}
"""GDAL's names of the compressions."""
LEVELS = {"zlib": {"ZLEVEL": 1}, "zstd": {"ZSTD_LEVEL": 1}}
"""The quickest levels: a noisy image is hardly smaller at higher ones."""


class Pixels(Protocol):
    """The pixels of an image to write, which the writer requests by rows, and more than once."""

    def read(self, band: int, start: int, stop: int) -> np.ndarray:
        """Return rows `start` to `stop` (excluded) of one band, counted from 0: (rows, width)."""

    def read_mask(self, start: int, stop: int) -> np.ndarray:
        """Return rows `start` to `stop` (excluded) of the mask or of alpha, (rows, width); 0 marks
        a missing pixel.
        """


def require_codec(compression: Compression) -> None:
    """Raise OptionError if the installed GDAL lacks a compression; it is called before a long run
    begins.
    """
    options = {"driver": "GTiff", "width": 16, "height": 16, "count": 1, "dtype": "uint16"}
    try:
        with gdal(), MemoryFile() as memory:
            memory.open(**options, compress=CODECS[compression]).close()
    except CODE_FAULTS:
        raise
    # rasterio has a class of its own for each of GDAL's errors.
    except Exception as error:
        raise OptionError(
            f"`compression` is {compression}, which the installed GDAL does not have. Use zlib."
        ) from error


def write_raster(
    path: Path | str,
    raster: Raster,
    pixels: Pixels,
    compression: Compression,
    software: str = RESTORED,
) -> None:
    """Write a TIFF in tiles of 256 pixels, read it again, and compare.

    Args:
        path: the path of the TIFF, whose folder exists, or GDAL's name of a file in memory.
        raster: the size, the type and the metadata of the file.
        pixels: the pixels to write.
        compression: the compression of the tiles.
        software: the program that the file names as its origin.

    Raises:
        OSError: the disk cannot be written, or the file differs from the given pixels.
    """
    with disk_errors(path), gdal(GDAL_CACHEMAX=LEAST_CACHE_BYTES, GDAL_TIFF_INTERNAL_MASK="YES"):
        with rasterio.open(path, "w", **_profile(raster, compression)) as file:
            file.update_tags(TIFFTAG_SOFTWARE=software, **dict(raster.tags))
            if raster.georeference.area_or_point:
                file.update_tags(AREA_OR_POINT=raster.georeference.area_or_point)
            if raster.georeference.rpcs:
                file.update_tags(ns="RPC", **dict(raster.georeference.rpcs))
            if raster.mask_kind == "alpha":
                # The creation option ALPHA would mark the first band after grey or blue.
                grey = [ColorInterp.gray, *[ColorInterp.undefined] * raster.bands]
                light = RGB if raster.colour else grey
                file.colorinterp = [*light[: raster.bands], ColorInterp.alpha]
            if raster.band_info:
                _describe_bands(file, raster.band_info)
            for plane, window, rows in _planes(raster, pixels):
                if plane == MASK:
                    file.write_mask(rows, window=window)
                else:
                    file.write(rows, plane, window=window)
        require_equal(path, raster, pixels)


def require_equal(path: Path | str, raster: Raster, pixels: Pixels) -> None:
    """Read a written TIFF again, and raise OSError if its pixels differ from those that were to be
    written.

    Args:
        path: the path of the TIFF.
        raster: the facts with which the TIFF was written, as given to `write_raster`.
        pixels: the pixels that were to be written.
    """
    with disk_errors(), gdal(), rasterio.open(path, driver="GTiff") as file:
        for plane, window, rows in _planes(raster, pixels):
            if plane == MASK:
                stored = file.dataset_mask(window=window)
            else:
                stored = file.read(plane, window=window)
            # Floats are compared bit for bit, because NaN differs from itself.
            if stored.tobytes() != rows.tobytes():
                raise OSError("the file holds other pixels than were written")


MASK = 0
"""The number of the mask among the planes of a TIFF, whose bands and alpha count from 1."""


def _planes(raster: Raster, pixels: Pixels) -> Iterator[tuple[int, Window, np.ndarray]]:
    """Yield plane after plane in strips: its number, the window, and the rows as GDAL has them."""
    planes = list(range(1, raster.bands + 1))
    if raster.mask_kind:
        planes.append(MASK if raster.mask_kind == "mask" else raster.bands + 1)
    for plane in planes:
        for start, stop in strips(raster.height_px, TILE_PX):
            window = Window(0, start, raster.width_px, stop - start)
            if 0 < plane <= raster.bands:
                rows = pixels.read(plane - 1, start, stop)
            elif plane == MASK:
                rows = np.where(pixels.read_mask(start, stop) == 0, 0, 255).astype(np.uint8)
            else:
                rows = pixels.read_mask(start, stop).astype(raster.dtype)
            yield plane, window, rows


@contextmanager
def disk_errors(output: Path | str | None = None) -> Iterator[None]:
    """Turn any error that GDAL raises within the block, while it writes, into an OSError that
    states its cause.

    Args:
        output: the path of the file that is written; None where a file is read.
    """
    try:
        yield
    except Exception as error:
        # GDAL does not state that the disk is full, but Python does if the file cannot grow either.
        path = None if output is None or isinstance(error, CODE_FAULTS) else Path(output)
        if path is not None and path.is_file():
            # Appending as many bytes as a tile has raises the OSError of a full disk.
            with path.open("ab") as file:
                file.write(bytes(ROOM_BYTES))
        # RasterioIOError is an OSError, and names its cause instead of itself.
        if isinstance(error, (OSError, *CODE_FAULTS)) and error.__cause__ is None:
            raise
        raise OSError(" ".join(str(error.__cause__ or error).split())) from error


def _profile(raster: Raster, compression: Compression) -> dict[str, Any]:
    """Return the creation options of a TIFF."""
    georeference = raster.georeference
    points = [GroundControlPoint(row, column, *at) for row, column, *at in georeference.gcps]
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": raster.width_px,
        "height": raster.height_px,
        "count": raster.bands + (raster.mask_kind == "alpha"),
        "dtype": raster.dtype.name,
        "nodata": raster.nodata,
        "crs": georeference.crs,
        "tiled": True,
        "blockxsize": TILE_PX,
        "blockysize": TILE_PX,
        "interleave": "band",
        "compress": CODECS[compression],
        "photometric": "RGB" if raster.colour else "MINISBLACK",
        "BIGTIFF": "IF_SAFER",
        "NUM_THREADS": "ALL_CPUS",
        **LEVELS.get(compression, {}),
    }
    if compression != "none" and raster.dtype.kind != "f":
        # On a noisy 12-bit photograph differences take 6 % less than the numbers (measured).
        profile["predictor"] = 2
    if points:
        profile["gcps"] = points
    elif georeference.transform is not None:
        profile["transform"] = georeference.transform
    return profile


def _describe_bands(file: Any, bands: Sequence[BandInfo]) -> None:
    """Write names, units, scales and metadata of the bands; alpha has none."""
    both = [*bands, *[BandInfo()] * (file.count - len(bands))]
    file.descriptions = [band.name or None for band in both]
    if any(band.unit for band in bands):
        file.units = [band.unit for band in both]
    if any((band.scale, band.offset) != (1.0, 0.0) for band in bands):
        file.scales = [band.scale for band in both]
        file.offsets = [band.offset for band in both]
    for number, band in enumerate(bands, 1):
        if band.tags:
            file.update_tags(number, **dict(band.tags))


def write_cog(plain: Path, cog: Path, compression: Compression, about: Mapping[str, str]) -> None:
    """Rewrite a TIFF as a Cloud-Optimised GeoTIFF: tiles, overviews, and a header with their
    positions (https://gdal.org/en/stable/drivers/raster/cog.html).

    Args:
        plain: the path of the TIFF, which is changed: `about` is added to its metadata.
        cog: the path of the file to write.
        compression: the compression of the tiles.
        about: metadata items on the processing of the image, from name to text.

    Raises:
        OSError: the disk cannot be read or written.
    """
    options: dict[str, Any] = {
        "COMPRESS": CODECS[compression],
        # The horizontal predictor of integers.
        "PREDICTOR": "NO" if compression == "none" else "YES",
        "BLOCKSIZE": COG_TILE_PX,
        "BIGTIFF": "IF_SAFER",
        # An average of known pixels does not overshoot them.
        "RESAMPLING": "AVERAGE",
    }
    with disk_errors(), gdal(**OFFLINE, GDAL_CACHEMAX=LEAST_CACHE_BYTES):
        with rasterio.open(plain, "r+", driver="GTiff") as file:
            file.update_tags(**about)
            # Readers compute from its width by how much an overview is reduced.
            if file.width == 1:
                options["OVERVIEWS"] = "NONE"
        copy(plain, cog, driver="COG", **options)


def padded_px(shape: tuple[int, int, int], tile_px: int = TILE_PX) -> int:
    """Return the number of pixels that an image takes in a file that stores whole tiles only.

    Args:
        shape: the shape (bands, height, width) of the image.
        tile_px: the side of a tile, by default that of the TIFFs that are written here.
    """
    bands, height, width = shape
    return bands * up_to_multiple(height, tile_px) * up_to_multiple(width, tile_px)


def cog_bytes(shape: tuple[int, int, int], itemsize: int) -> int:
    """Return the largest disk space in bytes that writing an image as a Cloud-Optimised GeoTIFF
    (COG) can take.

    The driver halves the image until it is one tile, and writes these overviews into a separate
    file first. No compression is assumed.

    Args:
        shape: the shape (bands, height, width) of the image.
        itemsize: the number of bytes of a pixel.
    """
    bands, height, width = shape
    full = padded_px(shape, COG_TILE_PX)
    overviews = 0
    while max(height, width) > COG_TILE_PX:
        height = -(-height // 2)
        width = -(-width // 2)
        overviews += padded_px((bands, height, width), COG_TILE_PX)
    return (full + 2 * overviews) * itemsize


@dataclass
class ArrayPixels:
    """Pixels in memory, (bands, H, W), as `Pixels` to write; none of them is missing."""

    pixels: np.ndarray

    def read(self, band: int, start: int, stop: int) -> np.ndarray:
        """Return rows `start` to `stop` (excluded) of one band, counted from 0: (rows, width)."""
        return self.pixels[band, start:stop]

    def read_mask(self, start: int, stop: int) -> np.ndarray:
        """Return 255, which marks no pixel as missing, for rows `start` to `stop` (excluded):
        (rows, width) uint8.
        """
        return np.full(self.pixels[0, start:stop].shape, 255, np.uint8)


def write_array(path: Path, raster: Raster, pixels: np.ndarray) -> None:
    """Write pixels in memory, (bands, H, W), as a losslessly compressed TIFF; after an error no
    partial file remains.

    Args:
        path: the path of the TIFF.
        raster: the size, the type and the metadata of the file.
        pixels: the pixels to write, none of which is missing.
    """
    # Where GDAL itself writes, libtiff prints each error of a full disk.
    with whole_file(path) as temporary, MemoryFile() as memory:
        write_raster(memory.name, raster, ArrayPixels(pixels), "zlib", "beers-deploy")
        temporary.write_bytes(memory.read())


def write_tiff(path: Path, dn: np.ndarray) -> None:
    """Write an image of one band as `write_array` does.

    Args:
        path: the path of the TIFF.
        dn: digital numbers (H, W) of an integer or float type.
    """
    height_px, width_px = dn.shape
    write_array(path, Raster(1, height_px, width_px, dn.dtype), dn[None])
