"""Open a stranger's TIFF: as plain pages, none of which leads back to an earlier one.

Formats for microscopes name further files to be opened, and tifffile follows directories that lead in a circle for
hours. What a page's pixels could do is the matter of `model.tiff_page`.
"""

import logging
import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import tifffile

from profiles.errors import ImageError

PLAIN: dict[str, Any] = dict.fromkeys(
    (
        "is_avs", "is_bif", "is_eer", "is_fluoview", "is_lsm", "is_mdgel", "is_mmstack", "is_ndpi", "is_ndtiff",
        "is_nih", "is_ome", "is_philips", "is_qpi", "is_scanimage", "is_scn", "is_sis", "is_stk", "is_svs",
    ),
    False,
)  # fmt: skip
"""Laboratories' own kinds of TIFF are read as plain pages: some name other files to be opened."""
TAGS, PAGES_WITHIN = 100_000, 64
"""Of all pages together: a thousand pages have some twenty thousand tags."""

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # who asks for its remarks still has them


def open_tiff(path: Path) -> tifffile.TiffFile:
    """A TIFF as plain pages; raises what tifffile raises.

    Raises:
        ImageError: pages in a circle, or more of them, or of their tags, than any image here has.
    """
    _check_directories(path)
    file = tifffile.TiffFile(path, **PLAIN)
    try:
        within = sum(len(page.subifds or ()) for page in file.pages if isinstance(page, tifffile.TiffPage))
        if within > PAGES_WITHIN:
            raise _endless(path, f"{within} pages within pages")
    except Exception:
        file.close()
        raise
    return file


def _check_directories(path: Path) -> None:
    """Before tifffile follows them: it does not see every circle, and goes round for hours."""
    seen, tags = set[int](), 0
    with path.open("rb") as stream, suppress(struct.error, OSError, OverflowError):  # a broken end: tifffile says so
        for place, count in _directories(stream):
            tags += count + 1
            if place in seen or tags > TAGS:
                raise _endless(path, "pages in a circle" if place in seen else f"more than {TAGS} tags")
            seen.add(place)


def _directories(stream: BinaryIO) -> Iterator[tuple[int, int]]:
    """Place and number of tags of one directory after another, plain or BigTIFF."""
    head = stream.read(4)
    order, big = ">" if head[:2] == b"MM" else "<", head[2:] in (b"+\0", b"\0+")
    (count, tag_bytes, offset), start = (("Q", 20, "Q"), 8) if big else (("H", 12, "I"), 4)

    def number(kind: str) -> int:
        return int(struct.unpack(order + kind, stream.read(struct.calcsize(kind)))[0])

    stream.seek(start)
    while place := number(offset):
        stream.seek(place)
        tags = number(count)
        yield place, tags
        stream.seek(tag_bytes * tags, os.SEEK_CUR)


def _endless(path: Path, got: str) -> ImageError:
    return ImageError(str(path), expected="a TIFF of a few pages", got=got, remedy="write it again")
