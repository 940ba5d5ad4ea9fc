"""Open a TIFF of others as plain pages, and refuse one whose pixels would take more memory than
they should.

Formats for microscopes name further files to be opened.
"""

import io
import logging
import math
import re
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import tifffile

from beers_deploy.model.io.files import whole_file
from beers_deploy.profiles.errors import ImageError, MachineError, sizes

LABORATORIES = {
    "avs",
    "bif",
    "eer",
    "fluoview",
    "lsm",
    "mdgel",
    "mmstack",
    "ndpi",
    "ndtiff",
    "nih",
    "ome",
    "philips",
    "qpi",
    "scanimage",
    "scn",
    "sis",
    "stk",
}
"""Laboratories' own kinds of TIFF are read as plain pages: some name other files to be opened."""
# Each release of tifffile knows more kinds than the one before, and raises TypeError for one that
# it does not know.
PLAIN: dict[str, Any] = {f"is_{kind}": False for kind in LABORATORIES & tifffile.TIFF.FILE_FLAGS}

# Whoever asks for tifffile's remarks still has them.
logging.getLogger("tifffile").addHandler(logging.NullHandler())


def open_tiff(path: Path) -> tifffile.TiffFile:
    """A TIFF as plain pages; raises what tifffile raises."""
    return tifffile.TiffFile(path, **PLAIN)


def tifffile_works() -> bool:
    """Return True if the installed tifffile reads a small image that it has written itself."""
    stream = io.BytesIO()
    try:
        tifffile.imwrite(stream, np.zeros((2, 2), np.uint16))
        stream.seek(0)
        with tifffile.TiffFile(stream, **PLAIN) as file:
            file.series[0].asarray()
    except Exception:  # noqa: BLE001 - a version that does not fit ours may raise anything
        return False
    return True


REDUCED = 1
MASK = 4
"""Bits of TIFF's NewSubfileType."""
MASK_PHOTOMETRIC = 4
LIGHT = {1, 2, 6}
"""PhotometricInterpretation of pixels where more is brighter: MinIsBlack, RGB, and JPEG's YCbCr,
which is decoded.
"""
GDAL_METADATA = 42112
OFFSET_DN = 40
"""Of the number that stands for no light: 1 % of 12 bits."""


def image_pages(
    path: Path, file: tifffile.TiffFile
) -> tuple[list[tifffile.TiffPage], tifffile.TiffPage | None]:
    """The pages of the one image of a file, each of which holds bands of it, and the page of its
    mask, if any.
    """
    pages = [
        page
        for page in file.pages
        if isinstance(page, tifffile.TiffPage) and not page.subfiletype & REDUCED
    ]
    masks = [
        page for page in pages if page.subfiletype & MASK or page.photometric == MASK_PHOTOMETRIC
    ]
    images = [page for page in pages if page not in masks]
    if not images or len(images) != len(file.series[0].pages) or len(masks) > 1:
        got = f"{len(images)} pages and {len(masks)} masks"
        raise ImageError(
            str(path), expected="one image", got=got, remedy="save the page that you mean by itself"
        )
    for page in images:
        if page.photometric not in LIGHT:
            got = getattr(page.photometric, "name", str(page.photometric))
            remedy = (
                "convert it to MinIsBlack or RGB: 'gdal_translate -expand' does it for palettes"
            )
            raise ImageError(
                str(path), expected="pixels where more is brighter", got=got, remedy=remedy
            )
    _require_no_offset(path, images[0])
    return images, masks[0] if masks else None


def _require_no_offset(path: Path, page: tifffile.TiffPage) -> None:
    """That 0 stands for no light in every band, by GDAL's metadata."""
    metadata = str(page.tags[GDAL_METADATA].value) if GDAL_METADATA in page.tags else ""
    values = [
        re.findall(rf'<Item [^>]*role="{role}"[^>]*>([^<]*)<', metadata)
        for role in ("offset", "scale")
    ]
    for offset, scale in zip_longest(*values, fillvalue="1"):
        require_small_offset(str(path), number_of(offset, 0), number_of(scale, 1))


def number_of(text: str, otherwise: float) -> float:
    """The number that a text states, or another where it states none."""
    try:
        return float(text)
    except ValueError:
        return otherwise


def require_small_offset(path: str, offset: float, scale: float) -> None:
    """Refuse pixels whose 0 is far from no light: value = scale x pixel + offset."""
    if abs(offset) > OFFSET_DN * abs(scale):
        got = (
            f"{-offset / (scale or 1):g} DN for it, by its offset of {offset:g} and scale of "
            f"{scale:g}"
        )
        remedy = (
            "take it off the pixels, or remove the offset with 'gdal_edit.py -offset 0' if "
            "it is none of them"
        )
        raise ImageError(path, expected="pixels whose 0 is no light", got=got, remedy=remedy)


KNOWN = {1, 5, 7, 8, 32946, 32773, 50000}
"""Compressions, by TIFF's numbers: none, LZW, JPEG, deflate (two), PackBits, zstd.

The others' decoders take their sizes from the packed bytes.
"""


def check_page(path: Path, page: tifffile.TiffPage) -> None:
    """Refuse a page that would take more than its pixels do."""
    if page.compression not in KNOWN:
        got = str(tifffile.COMPRESSION(page.compression).name)
        remedy = "write it with deflate, LZW or zstd"
        raise ImageError(
            str(path), expected="a TIFF compression known here", got=got, remedy=remedy
        )
    needed = segment_bytes(page)
    free = psutil.virtual_memory().available
    if needed > free:
        room, size = sizes(free, needed)
        expected = f"strips or tiles that fit in {room}"
        got = f"{size} for one"
        raise MachineError(
            str(path), expected=expected, got=got, remedy="rewrite it in smaller tiles"
        )
    _check_whole(path, page)


def segment_bytes(page: tifffile.TiffPage) -> int:
    """Bytes of one decoded strip or tile, as the file sizes it."""
    # Bands that lie one behind the other have strips or tiles of their own.
    samples = page.samplesperpixel if page.planarconfig == 1 else 1
    place = page.tilelength, page.tilewidth
    pixels = math.prod(
        place if page.is_tiled else (min(page.rowsperstrip, page.imagelength), page.imagewidth)
    )
    return pixels * max(page.tiledepth, 1) * samples * max(page.bitspersample // 8, 1)


def _check_whole(path: Path, page: tifffile.TiffPage) -> None:
    """Raise ImageError if the file ends before its pixels do."""
    # Reading beyond the end would take the memory first, and find out then.
    ends = (a + n for a, n in zip(page.dataoffsets, page.databytecounts, strict=True))
    end = max(ends, default=0)
    size = path.stat().st_size
    if end > size:
        got = f"a file cut short at {size} of {end} bytes"
        remedy = "copy it again"
        raise ImageError(str(path), expected="a whole TIFF", got=got, remedy=remedy)


def write_tiff(path: Path, dn: np.ndarray) -> None:
    """Write (H, W) uint16 as a tiled, losslessly compressed TIFF, whole or not at all."""
    with whole_file(path) as temporary:
        tifffile.imwrite(
            temporary, dn, tile=(256, 256), compression="zlib", software="beers-deploy"
        )
