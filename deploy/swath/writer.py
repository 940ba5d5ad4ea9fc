"""The finished rows as one tiled TIFF, in place of the old one or not at all."""

import io
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tifffile

from deploy.swath.options import Compression
from deploy.swath.raster import Raster
from deploy.swath.reader import BIG_TIFF_SUFFIXES
from deploy.swath.spool import Spool, sync_folder
from model.images import TIFF_SUFFIXES
from profiles.errors import MachineError, OptionError

TILE_PX = 256
PLAIN_LIMIT_BYTES = 4_000_000_000
"""Offsets of a plain TIFF end at 2^32; above this many bytes of pixels, compressed or not, it is a BigTIFF."""
BUFFER_BYTES = 1 << 25
FAST_LEVEL = 1
"""Of zlib: on a noisy 12-bit image 1 % larger than its default, in less than half the time (measured)."""


def require_tiff_name(path: Path) -> None:
    """Refuse a name under which no program would look for a TIFF.

    Raises:
        OptionError: it does not end as a TIFF's does.
    """
    if path.suffix.lower() not in TIFF_SUFFIXES | BIG_TIFF_SUFFIXES:
        remedy = "name it so; other programs turn a TIFF into what you need"
        raise OptionError("OUT", expected="a TIFF's name, such as restored.tif", got=path.name, remedy=remedy)


def require_codec(compression: Compression) -> None:
    """Find out before the run that a compression needs a package which is not installed.

    Raises:
        MachineError: it does.
    """
    try:
        tifffile.imwrite(io.BytesIO(), np.zeros((16, 16), np.uint16), compression=compression.codec)
    except (ValueError, KeyError, ImportError) as error:
        got, remedy = " ".join(str(error).split()), "pip install 'beers-deploy[codecs]' or use zlib"
        raise MachineError("--compression", expected="an installed codec", got=got, remedy=remedy) from error


def write_output(spool: Spool, raster: Raster, compression: Compression) -> None:
    """Write the spool's rows to its output, rename it into place and remove the spool.

    Raises:
        MachineError: the disk is full or gone; the rows are still there.
    """
    fresh = spool.folder / "out.tif"
    padded_px = raster.bands * _padded(raster.height_px) * _padded(raster.width_px)
    with spool.disk():
        tifffile.imwrite(
            fresh,
            _tiles(spool),
            shape=spool.shape if raster.bands > 1 else spool.shape[1:],
            dtype=spool.dtype,
            tile=(TILE_PX, TILE_PX),
            compression=compression.codec,
            compressionargs={"level": FAST_LEVEL} if compression is Compression.zlib else None,
            bigtiff=padded_px * spool.dtype.itemsize > PLAIN_LIMIT_BYTES,
            photometric="minisblack",
            planarconfig="separate" if raster.bands > 1 else None,
            software="beers-deploy",
            metadata=None,
            extratags=raster.tags,
            buffersize=BUFFER_BYTES,
        )
        with fresh.open("r+b") as stream:
            os.fsync(stream.fileno())
        fresh.replace(spool.out)
        sync_folder(spool.out.parent)
        spool.remove()


def _tiles(spool: Spool) -> Iterator[np.ndarray]:
    """Squares in the order of the file, zeros beyond the image."""
    bands, height, width = spool.shape
    for plane in range(bands):
        for top in range(0, height, TILE_PX):
            rows = spool.read(plane, top, min(top + TILE_PX, height))
            strip = np.zeros((TILE_PX, _padded(width)), spool.dtype)
            strip[: len(rows), :width] = rows
            yield from np.hsplit(strip, strip.shape[1] // TILE_PX)


def _padded(size_px: int) -> int:
    return -(-size_px // TILE_PX) * TILE_PX
