"""Read whole images, list those of a folder, and determine which of them are frames of one site."""

import re
from math import prod
from pathlib import Path

import numpy as np
import psutil

from beers_deploy.model.io.files import IMAGE_SUFFIXES
from beers_deploy.model.raster.facts import extent_of
from beers_deploy.model.raster.full_scale import remedy_outside, settled_scale
from beers_deploy.model.raster.reader import open_raster
from beers_deploy.profiles.errors import ImageError, MachineError, counted, sizes
from beers_deploy.profiles.instrument import MAX_DN

CAMERA = r"[_-](?:dji|img|image|dsc[nf]?|fhd|mos|gopr|frame|p)[_-]?"
"""The parts of file names that cameras and programs add after the name of a place."""

FRAME_NUMBERS = re.compile(
    rf"(?:(?:_|{CAMERA})[0-9a-f]*\d[0-9a-f]*(?:-[0-9]+)*(?:_(?:pre|post)(?=_|$))?)+$", re.IGNORECASE
)
"""The end of a name that distinguishes frames of one site: _0034, _5dded5bc_23, _DJI_0005,
_P1010012, _386690-220241, _2016_pre_1. The rest of the name is the site.
"""

WORKING_COPIES = 12
"""The number of float copies of an image that a command may hold at once; an image that would not
fit in memory is rejected.
"""

RESCALE = "Rescale it to the sensor's digital numbers."


def read_pixels(path: Path) -> np.ndarray:
    """Read the pixels of an image file as stored: (H, W) or (H, W, bands), any dtype.

    Raises:
        ImageError: no image, a damaged one, or one with missing pixels.
        MachineError: an image that does not fit in memory.
    """
    with open_raster(path) as source:
        raster = source.raster
        samples = prod(raster.shape)
        needed = samples * 4 * WORKING_COPIES
        free = psutil.virtual_memory().available
        if needed > free:
            room, size = sizes(free, needed)
            raise MachineError(
                f"{path} has {samples:,} samples, which need about {size}, but there is only "
                f"{room} of free memory. Cut it into pieces."
            )
        stored = source.read(0, raster.height_px)
    pixels = np.ma.getdata(stored)
    count = int((raster.missing(stored) | ~np.isfinite(pixels)).sum())
    if count:
        raise ImageError(
            f"{path} has {counted(count, 'pixel')} without a value: NaN, infinite, or missing by "
            "nodata value, mask or alpha. Crop them off; only 'restore' accepts missing pixels."
        )
    return pixels[0] if raster.bands == 1 else np.moveaxis(pixels, 0, 2)


def image_size_px(path: Path) -> tuple[int, int]:
    """Return the height and width of an image in pixels; only the header of the file is read."""
    with open_raster(path) as source:
        return source.raster.height_px, source.raster.width_px


def list_images(folder: Path) -> list[Path]:
    """List the image files of a folder, sorted by name, or raise ImageError if there are none."""
    # A folder that does not exist has no files either.
    images = sorted(path for path in folder.glob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
    if not images:
        fault = "there is no image in it" if folder.is_dir() else "no such folder"
        if folder.is_file():
            fault = "it is a file"
        raise ImageError(
            f"{folder} is not a folder of images: {fault}. Give TIFF, PNG or JPEG files."
        )
    return images


def site_of(name: str) -> str:
    """Return the site of an image: its name without the end that distinguishes frames of one site.

    Examples:
        >>> site_of("zebra_DJI_0005.jpg"), site_of("lake_2016_pre_1.tif")
        ('zebra', 'lake')
    """
    return FRAME_NUMBERS.sub("", Path(name).stem) or name


def read_acquisition(
    path: Path, full_scale: float | None = None, remedy: str | None = RESCALE, max_dn: int = MAX_DN
) -> np.ndarray:
    """Read the digital numbers (H, W) float32 of an image with one band, from 0 to max_dn.

    Args:
        path: the path of an image file.
        full_scale: the pixel value that is full scale; None lets the pixels' type and values
            decide. Pixels are multiplied so that it becomes `max_dn`.
        remedy: the advice in the message if full scale is ambiguous; None advises to set
            `full_scale`.
        max_dn: the sensor's largest digital number, by default that of 12 bits.

    Raises:
        ImageError: no readable image, several bands, missing pixels, or values outside 0 to full
            scale.
        MachineError: an image that does not fit in memory.
        OptionError: a full scale that pixels of this type cannot have.
    """
    pixels = read_pixels(path)
    if pixels.ndim != 2:
        raise ImageError(
            f"{path} must have one band, but it has {pixels.shape[2]}. Extract the panchromatic "
            "band."
        )
    low = float(pixels.min())
    high = float(pixels.max())
    scale = settled_scale(str(path), pixels.dtype, [extent_of(pixels)], full_scale, max_dn, remedy)
    if low < 0 or high > scale:
        raise ImageError(
            f"{path} has values from {low:g} to {high:g}, but they must be 0 to {scale:g}. "
            f"{remedy_outside(low, high, RESCALE)}"
        )
    dn = np.asarray(pixels, dtype=np.float32)
    if scale == max_dn:
        return dn
    # Rounding may carry full scale above the largest digital number.
    return np.asarray(np.minimum(dn * np.float32(max_dn / scale), np.float32(max_dn)))
