"""Read pixels from TIFF, PNG or JPEG files, settle what value is full scale, and refuse what is no
image.
"""

import io
import math
import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
from PIL import Image

from beers_deploy.model.io.files import IMAGE_SUFFIXES, TIFF_SUFFIXES
from beers_deploy.model.io.tiff import check_page, image_pages, open_tiff, tifffile_works
from beers_deploy.profiles.errors import (
    CODE_FAULTS,
    BeersError,
    ImageError,
    MachineError,
    OptionError,
    sizes,
)
from beers_deploy.profiles.sensor import MAX_DN
from beers_deploy.profiles.toml import read_whole, unreadable

CAMERA = r"[_-](?:dji|img|image|dsc[nf]?|fhd|mos|gopr|frame|p)[_-]?"
"""How cameras and programs begin the names of their files, after the name of a place."""

FRAME_NUMBERS = re.compile(
    rf"(?:(?:_|{CAMERA})[0-9a-f]*\d[0-9a-f]*(?:-[0-9]+)*(?:_(?:pre|post)(?=_|$))?)+$", re.IGNORECASE
)
"""The end of a name that tells frames of one site apart: _0034, _5dded5bc_23, _DJI_0005, _P1010012,
_386690-220241, _2016_pre_1. Nothing else can be known by a name: the site is what it begins with.
"""

READ_AS = {"L": "L", "LA": "L", "I;16": "I;16", "I": "I", "F": "F"}
"""Pillow's modes, and that in which pixels of one band are taken; all others become RGB."""

PACKED_BYTES = 1 << 30
"""Of a PNG or JPEG file."""

WORKING_COPIES = 12
"""Float copies of an image that a command may hold at once: reading refuses what would not fit in
memory.
"""

RESCALE = "rescale it to the sensor's digital numbers"


def read_pixels(path: Path) -> np.ndarray:
    """The pixels of an image file as stored: (H, W) or (H, W, bands), any dtype.

    scikit-image reads the same pixels through the same two libraries, but knows neither the free
    memory nor which formats start other programs, and answers damage with whatever error these
    libraries raise.
    """
    require_image_file(path)
    pixels = _read_tiff(path) if path.suffix.lower() in TIFF_SUFFIXES else _read_other(path)
    if pixels.ndim not in (2, 3) or 0 in pixels.shape:
        raise ImageError(
            str(path),
            expected="a 2-D image",
            got=f"shape {pixels.shape}",
            remedy="export one page of it",
        )
    if np.issubdtype(pixels.dtype, np.floating) and not np.isfinite(pixels).all():
        count = int((~np.isfinite(pixels)).sum())
        remedy = (
            "replace them or crop them off; 'restore' alone takes missing pixels, as NaN or nodata"
        )
        raise ImageError(
            str(path), expected="finite pixels", got=f"{count} NaN or infinite", remedy=remedy
        )
    return pixels


def require_image_file(path: Path) -> None:
    """Refuse what is no file, or an empty one."""
    got = unreadable(path)
    if got is not None:
        raise ImageError(str(path), expected="an image file", got=got, remedy="check the path")
    if path.stat().st_size == 0:
        raise ImageError(
            str(path), expected="an image", got="an empty file", remedy="write or copy it again"
        )


@contextmanager
def damage_in_a_sentence(path: Path, where: str = "") -> Iterator[None]:
    """One sentence for whatever the bytes of a damaged image lead to; `where` names the place in
    it.
    """
    try:
        yield
    except (BeersError, MemoryError):
        raise
    except Exception as error:
        if isinstance(error, CODE_FAULTS) and not _library_works(path):
            raise  # The installed version is at fault, not the file.
        name = f"{path}, {where}" if where else str(path)
        if isinstance(error, ModuleNotFoundError) or "imagecodecs" in str(error):
            remedy = "pip install 'beers-deploy[codecs]'"
            expected = "a TIFF compression known here"
            raise MachineError(name, expected=expected, got=str(error), remedy=remedy) from error
        got = " ".join(str(error).split()) or type(error).__name__
        remedy = "check that it is a whole image"
        raise ImageError(
            name, expected="a readable TIFF, PNG or JPEG", got=got[:120], remedy=remedy
        ) from error


def _library_works(path: Path) -> bool:
    """Return True if the library that reads files of this kind reads an intact one.

    Tags of a wrong type in a damaged file make tifffile raise TypeError, as a call with a wrong
    argument does: the kind of exception alone does not tell which of the two is at fault.
    """
    if path.suffix.lower() in TIFF_SUFFIXES:
        return tifffile_works()
    stream = io.BytesIO()
    try:
        Image.fromarray(np.zeros((2, 2), np.uint8)).save(stream, "PNG")
        np.asarray(Image.open(stream, formats=("PNG", "JPEG")))
    except Exception:  # noqa: BLE001 - a version that does not fit ours may raise anything
        return False
    return True


def image_size_px(path: Path) -> tuple[int, int]:
    """Height and width of an image file as its header has them: no pixel is read."""
    require_image_file(path)
    with damage_in_a_sentence(path), warnings.catch_warnings(action="ignore"):
        if path.suffix.lower() in TIFF_SUFFIXES:
            with open_tiff(path) as file:
                height = file.series[0].keyframe.imagelength
                width = file.series[0].keyframe.imagewidth
        else:
            with Image.open(path, formats=("PNG", "JPEG")) as image:
                width, height = image.size
    return int(height), int(width)


def list_images(folder: Path) -> list[Path]:
    """The image files of a folder, sorted by name."""
    images = (
        sorted(p for p in folder.glob("*") if p.suffix.lower() in IMAGE_SUFFIXES)
        if folder.is_dir()
        else []
    )
    if not images:
        got = "no image in it" if folder.is_dir() else "no such folder"
        raise ImageError(
            str(folder),
            expected="a folder of images",
            got=got,
            remedy="give TIFF, PNG or JPEG files",
        )
    return images


def site_of(name: str) -> str:
    """Return the site of an image: its name without the end that tells frames of one site apart.

    Examples:
        >>> site_of("zebra_DJI_0005.jpg"), site_of("lake_2016_pre_1.tif")
        ('zebra', 'lake')
    """
    return FRAME_NUMBERS.sub("", Path(name).stem) or name


PLANAR = 2
"""TIFF's planar configuration of bands that lie one behind the other."""


def _read_tiff(path: Path) -> np.ndarray:
    with damage_in_a_sentence(path), open_tiff(path) as file:
        pages, mask = image_pages(path, file)
        if mask is not None or any(page.extrasamples and max(page.extrasamples) for page in pages):
            remedy = "cut it to known pixels; 'restore' alone takes missing ones"
            raise ImageError(
                str(path), expected="an image that is whole", got="a mask or alpha", remedy=remedy
            )
        _check_memory(path, math.prod(file.series[0].shape))
        for page in pages:
            check_page(path, page)
        pixels = np.asarray(file.series[0].asarray())
    if pixels.ndim == 3 and (len(pages) > 1 or pages[0].planarconfig == PLANAR):
        # Pages and planar bands are read as (bands, H, W).
        pixels = np.moveaxis(pixels, 0, 2)
    return pixels[..., 0] if pixels.ndim == 3 and pixels.shape[2] == 1 else pixels


def _read_other(path: Path) -> np.ndarray:
    # Pillow's own limit is lifted, because `_check_memory` knows the free memory.
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None
    try:
        with (
            damage_in_a_sentence(path),
            warnings.catch_warnings(action="ignore"),  # Odd EXIF is no concern of ours.
            # In memory, so that a chunk's stated length takes no more of it than there is file.
            # Other formats would run further programs, as for EPS.
            Image.open(
                io.BytesIO(read_whole(path, PACKED_BYTES)), formats=("PNG", "JPEG")
            ) as image,
        ):
            _check_memory(path, image.width * image.height * len(image.getbands()))
            mode = READ_AS.get(image.mode, "RGB")
            return np.asarray(image if mode == image.mode else image.convert(mode))
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def read_alpha(path: Path) -> np.ndarray | None:
    """The alpha (H, W) uint8 of a PNG; None where all of it is opaque."""
    quiet = warnings.catch_warnings(action="ignore")
    with damage_in_a_sentence(path), quiet, Image.open(path, formats=("PNG", "JPEG")) as image:
        if image.mode in ("P", "PA"):
            remedy = "convert it to grey or RGB"
            raise ImageError(
                str(path), expected="pixels that are light", got="a palette", remedy=remedy
            )
        if image.mode != "I;16" and _png_bits(path) == 16:
            remedy = "convert it to TIFF"
            raise ImageError(
                str(path), expected="a PNG of 8 bits, or grey", got="16-bit colour", remedy=remedy
            )
        return (
            np.asarray(image.convert("RGBA").getchannel("A"))
            if image.has_transparency_data
            else None
        )


def _png_bits(path: Path) -> int | None:
    """Bits of a sample, as the head of a PNG has them; None of other files."""
    with path.open("rb") as stream:
        head = stream.read(25)
    # The header chunk comes first: the bit depth is byte 24 of the file.
    return head[24] if head.startswith(b"\x89PNG") else None


def _check_memory(path: Path, samples: int) -> None:
    needed = samples * 4 * WORKING_COPIES
    free = psutil.virtual_memory().available
    if needed > free:
        room, size = sizes(free, needed)
        expected = f"an image that fits in {room} of free memory"
        got = f"{samples:,} samples, which need about {size}"
        raise MachineError(str(path), expected=expected, got=got, remedy="cut it into pieces")


UNIT_MAX = 2.0
"""Floats no larger may be shares of full scale, or reflectances, which pass 1 on snow and glint.

A raw image has a pixel above 2 DN wherever it sees anything at all.
"""
RADIANCE_SHARE = 0.2
"""Floats that are no whole numbers and no larger than this share of full scale may be radiances:
those of a bright scene, in W/m2/sr/um, stay below some 700.
"""

REMEDY = "give the pixel value that is full scale as `full_scale`"


class Extent(NamedTuple):
    """Of some pixels: the largest size of a known one, and whether all are whole numbers, as
    digital numbers are.
    """

    largest: float
    whole: bool


def extent_of(pixels: np.ndarray, known: np.ndarray | bool = True) -> Extent:
    """The extent of pixels of any shape, of those that are `known`."""
    low, high = (float(extreme(pixels, where=known, initial=0)) for extreme in (np.min, np.max))
    integers = pixels.dtype.kind != "f" or bool((np.rint(pixels) == pixels).all(where=known))
    return Extent(max(-low, high), integers)


def settled_scale(
    name: str,
    dtype: np.dtype[np.generic],
    extents: Iterable[Extent],
    asked: float | None = None,
    usual: float = MAX_DN,
    remedy: str | None = None,
) -> float:
    """The pixel value that is full scale.

    Args:
        name: of the image, for the message.
        dtype: of the pixels.
        extents: of each part of the image, drawn for floats only and no further than to the first
            that decides.
        asked: as the user gave it; None lets type and values decide.
        usual: the full scale of digital numbers.
        remedy: what to do about pixels that leave it open, where the caller has no --full-scale.
    """
    if asked is not None:
        check_scale(asked, dtype.kind)
        return asked
    if dtype.itemsize == 1:
        raise _open(
            name, "8-bit pixels", remedy or f"{REMEDY} (255 for all of 8 bits), or the raw image"
        )
    if dtype.kind != "f":
        return usual
    brightest = 0.0
    for extent in extents:
        brightest = max(brightest, extent.largest)
        if brightest > UNIT_MAX and (extent.whole or brightest > RADIANCE_SHARE * usual):
            return usual
    if brightest == 0:  # All of it is black or missing.
        return usual
    if brightest > UNIT_MAX:
        got = "no whole numbers, as radiances are"
        choices = f"{usual:g} for digital numbers, else your own"
    else:
        got = "which may be shares of it"
        choices = f"1 for 0..1, {usual:g} for digital numbers"
    raise _open(
        name, f"floats of at most {brightest:.3g}, {got}", remedy or f"{REMEDY} ({choices})"
    )


def check_scale(full_scale: float, kind: str) -> None:
    """A full scale that pixels of this kind (numpy's letter) can have."""
    fits_integers = full_scale <= 65535 and full_scale % 1 == 0
    if 0 < full_scale < np.inf and (kind == "f" or fits_integers):
        return
    expected = (
        "a number above 0" if kind == "f" else "a whole number of 1 to 65535 for integer pixels"
    )
    raise OptionError(
        "full_scale", expected=expected, got=f"{full_scale:g}", remedy="4095 is 12 bits"
    )


def remedy_outside(low: float, high: float, remedy: str) -> str:
    """What to do about values from `low` to `high` that no sensor gives; `remedy` where they are
    only too large.
    """
    if not np.isfinite([low, high]).all():
        return (
            "write NaN or the nodata value in place of infinite pixels: 'restore' takes both "
            "for missing"
        )
    if low < 0:
        return (
            "add the offset that was taken off the image, clip it at 0, or mark such pixels "
            "as nodata"
        )
    return remedy


def _open(name: str, got: str, remedy: str) -> ImageError:
    return ImageError(name, expected="digital numbers of more than 8 bits", got=got, remedy=remedy)


def read_acquisition(
    path: Path, full_scale: float | None = None, remedy: str | None = RESCALE, max_dn: int = MAX_DN
) -> np.ndarray:
    """Digital numbers (H, W) float32 in 0..max_dn of a mono image: of at most 12 bits unless a
    sensor says otherwise.

    Args:
        path: a TIFF, PNG or JPEG file.
        full_scale: the pixel value that is full scale; None lets the pixels' type and values
            decide.
        remedy: what to do about pixels that leave it open; None names --full-scale.
        max_dn: the sensor's largest digital number.
    """
    pixels = read_pixels(path)
    if pixels.ndim != 2:
        raise ImageError(
            str(path),
            expected="one band",
            got=f"{pixels.shape[2]} bands",
            remedy="extract the panchromatic band",
        )
    low = float(pixels.min())
    high = float(pixels.max())
    scale = settled_scale(str(path), pixels.dtype, [extent_of(pixels)], full_scale, max_dn, remedy)
    if low < 0 or high > scale:
        expected = (
            f"{max_dn.bit_length()}-bit digital numbers, 0 to {max_dn}"
            if scale == max_dn
            else f"values of 0 to {scale:g}"
        )
        got = f"values from {low:g} to {high:g}"
        raise ImageError(
            str(path), expected=expected, got=got, remedy=remedy_outside(low, high, RESCALE)
        )
    dn = np.asarray(pixels, dtype=np.float32)
    if scale == max_dn:
        return dn
    # Rounding may carry full scale above the largest digital number.
    return np.asarray(np.minimum(dn * np.float32(max_dn / scale), np.float32(max_dn)))
