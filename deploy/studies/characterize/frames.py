"""Read the raw frames of one camera, and determine the step of a digital number, the bits and the
level of the dark.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from beers_deploy.model.metrics.uneven_edge import HALF_PX
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.raster.reader import open_raster
from beers_deploy.profiles.errors import ImageError, OptionError, printable

TILE_PX = 1024
BOX_PX = 2 * int(HALF_PX) + 1
"""The shortest side of a box with an edge."""
MAX_DN = 65535
CLIPPED_PIXELS = 10
PILE = 4
"""A value 2^n - 1 is full scale if it has at least this number of pixels, and this multiple of the
number just below it.
"""
DARKEST_PERCENT = 0.01
DARK_SHARE = 0.02
"""If the darkest pixels of all frames are above this share of full scale, a black level is
probable.
"""


@dataclass(frozen=True)
class Frames:
    """Raw images of one camera at one setting, and what their values mean.

    Attributes:
        paths: the paths of the images, in the given order; those of a folder are sorted by name.
        step: the stored value of one digital number; all stored values are multiples of it.
        bits: the number of bits of a digital number.
        bits_stated: True if the user states the bits; False if clipped pixels show them.
        black_dn: the digital number that the camera stores without light, as the user states it; 0
            if the user does not. Measurements subtract it, `read` does not.
        darkest_dn: the digital number of the darkest pixels, the black level included.
    """

    paths: tuple[Path, ...]
    step: int
    bits: int
    bits_stated: bool
    black_dn: float
    darkest_dn: float

    @property
    def full_scale_dn(self) -> int:
        """The largest digital number, at which pixels clip."""
        return int(2**self.bits) - 1

    @property
    def stored_full_scale(self) -> int:
        """The value that the files store for the largest digital number."""
        return self.full_scale_dn * self.step

    @property
    def name(self) -> str:
        """The name of the first image and the number of others, for messages."""
        more = f" and {len(self.paths) - 1} more" if len(self.paths) > 1 else ""
        return f"{self.paths[0].name}{more}"

    def read(self, path: Path) -> np.ndarray:
        """Read the digital numbers (H, W) of one frame, float64, with 0 where they are missing.

        Raises:
            ImageError: the image has several bands, or values that are no digital numbers.
        """
        return read_raw(path).astype(np.float64) / self.step

    def tiles(self, path: Path) -> Iterator[np.ndarray]:
        """Yield the digital numbers of one frame in parts (h, w) of at most `TILE_PX` pixels a
        side.
        """
        pixels = self.read(path)
        for top in range(0, pixels.shape[0], TILE_PX):
            for left in range(0, pixels.shape[1], TILE_PX):
                yield pixels[top : top + TILE_PX, left : left + TILE_PX]


def open_frames(images: Sequence[Path], bits: int | None, black_level: float | None) -> Frames:
    """Read raw images of one camera, and determine the step, the bits and the black level.

    Args:
        images: files, and folders whose images are sorted by name.
        bits: the bits of a digital number, such as 12; or those of a stored value, such as 16, if
            the file stores multiples of a power of two. None infers them from clipped pixels.
        black_level: the stored value of a pixel without light; None uses 0.

    Raises:
        ImageError: there is no image, or an image has no whole digital numbers in steps of 1.
        OptionError: an image is given twice, the bits cannot be inferred or do not fit the pixels,
            or the black level is not below the median of the images.
    """
    paths: tuple[Path, ...] = ()
    for image in images:
        paths += tuple(list_images(image)) if image.is_dir() else (image,)
    if not paths:
        raise ImageError("There are no `images`. Give one or several raw images of one sensor.")
    if len({path.resolve() for path in paths}) < len(paths):
        raise OptionError(
            "One of the `images` is given twice, but the same pixels add no information. Give "
            "each image once."
        )
    frames = [_look(path) for path in paths]
    step = int(np.gcd.reduce([frame.step for frame in frames]))
    largest = max(frame.largest for frame in frames)
    bit_count = _settled_bits(bits, largest, step, any(frame.piled for frame in frames))
    black_dn = (black_level or 0.0) / step
    darkest_dn = min(frame.darkest for frame in frames) / step
    middle_dn = float(np.median([frame.middle for frame in frames])) / step
    if not 0 <= black_dn < max(middle_dn, 1.0):
        raise OptionError(
            "`black_level` must be at least 0 and below the median of the images, "
            f"{middle_dn * step:g}, but it is {black_level:g}. Give the value of dark frames."
        )
    return Frames(paths, step, bit_count, bits is not None, black_dn, darkest_dn)


class _Values(NamedTuple):
    """Statistics of the stored values of one frame.

    Attributes:
        step: the largest integer that divides all values.
        largest: the largest value.
        piled: True if pixels accumulate there, as they do only at full scale.
        darkest: the value of the darkest pixels.
        middle: the median.
    """

    step: int
    largest: int
    piled: bool
    darkest: float
    middle: float


def _look(path: Path) -> _Values:
    """Return statistics of one frame; raise ImageError if its values are no digital numbers."""
    pixels = read_raw(path)
    values = pixels.astype(np.int64, copy=False).ravel()
    largest = int(values.max())
    step = int(np.gcd.reduce(values))
    apart = int(np.gcd.reduce(values - values.min()))
    # All differences are multiples of `apart` and the values are not: they are no digital numbers.
    if apart > 1 and step % apart:
        raise ImageError(
            f"{path} has values in steps of {apart}: {apart - 1} of {apart} values never occur, "
            f"so they are no digital numbers, which have steps of 1. Divide them by {apart}."
        )
    # A constant image does not show its step.
    step = step if apart else 1
    count = int((values == largest).sum())
    below = int((values == largest - step).sum())
    # Values stored in 8 bits do not reveal the bits of the digitiser, clipped or not.
    piled = count >= max(CLIPPED_PIXELS, PILE * below) and pixels.dtype.itemsize > 1
    # 0 also stands for a missing pixel, so it says nothing about the dark.
    present = values[values > 0]
    darkest, middle = np.percentile(present, [DARKEST_PERCENT, 50]) if present.size else (0.0, 0.0)
    return _Values(step, largest, piled, float(darkest), float(middle))


def _settled_bits(stated: int | None, largest: int, step: int, piled: bool) -> int:
    """Return the bits that the user states, or those inferred from pixels clipped at full scale."""
    largest_dn = largest // step
    if stated is None:
        if not piled or largest_dn != 2 ** largest_dn.bit_length() - 1:
            raise OptionError(
                f"`bits` is missing. The values up to {largest} do not show it, because the "
                "images are not clipped at full scale, or are stored in 8 bits. Give the bits of "
                "the digitiser, such as 12."
            )
        return largest_dn.bit_length()
    # 16 bits of values in steps of 64 are 10 bits of digital numbers.
    shift = step.bit_length() - 1
    bits = stated - shift if step == 2**shift and largest <= 2**stated - 1 else stated
    if largest_dn > 2**bits - 1:
        raise OptionError(
            f"`bits` allows digital numbers up to {2**bits - 1}, but the images have {largest_dn}. "
            "Give the bits of the raw image."
        )
    if (2**bits - 1) * step > MAX_DN:
        raise OptionError(
            f"`bits` of {stated} and values that are multiples of {step} make a full scale of "
            f"{(2**bits - 1) * step}, but 16 bits hold up to {MAX_DN}. Give fewer bits."
        )
    return bits


def read_raw(path: Path) -> np.ndarray:
    """Read the stored values of a raw image of one band.

    Returns:
        The values (H, W), integers of the type that the file has or floats without fractions, with
        0 where pixels are missing.

    Raises:
        ImageError: the image has several bands, no pixel with a value, or values that are no whole
            numbers of 0 to `MAX_DN`.
    """
    with open_raster(path) as source:
        raster = source.raster
        rows = source.read(0, raster.height_px)
    if raster.bands != 1:
        raise ImageError(
            f"{path} must have one band, because each band has its own sensor, but it has "
            f"{raster.bands} bands. Extract one band."
        )
    missing = raster.missing(rows)[0]
    if missing.all():
        raise ImageError(
            f"{path} has no pixels with values, only NaN or nodata. Check that it is the right "
            "file."
        )
    pixels = np.where(missing, 0, np.ma.getdata(rows)[0])
    if (
        (pixels.dtype.kind == "f" and (pixels != np.rint(pixels)).any())
        or pixels.min() < 0
        or pixels.max() > MAX_DN
    ):
        actual = f"{pixels.dtype} from {float(pixels.min()):.4g} to {float(pixels.max()):.4g}"
        raise ImageError(
            f"{path} must have whole digital numbers from 0 to {MAX_DN}, but it has {actual}. Give "
            "the raw image, because resampling, calibration and scaling change the noise."
        )
    return pixels


def cut_box(words: str, frames: Frames) -> np.ndarray:
    """Read the digital numbers in a box with an edge that the user points at.

    Args:
        words: the box as FILE:X,Y,WIDTH,HEIGHT in pixels, where FILE is one of the frames and X,Y
            the upper left pixel, counted from 0.
        frames: the raw images.

    Returns:
        The digital numbers (HEIGHT, WIDTH), float64.

    Raises:
        OptionError: the text has another form, names another file, or the box is too small or
            reaches beyond the image.
    """
    parts = re.fullmatch(r"(.*):(\d{1,8}),(\d{1,8}),(\d{1,8}),(\d{1,8})", words, re.ASCII)
    if parts is None:
        raise OptionError(
            "`edge` must be FILE:X,Y,WIDTH,HEIGHT in whole pixels, such as "
            f"raw.tif:1200,340,60,60, but it is {printable(repr(words))}."
        )
    path = Path(parts[1])
    left, top, width, height = map(int, parts.groups()[1:])
    if path not in frames.paths:
        raise OptionError(
            f"`edge` names {printable(repr(parts[1]))}, which is not one of the `images`. Write "
            "the file's name as it is in `images`."
        )
    pixels = frames.read(path)
    region = pixels[top : top + height, left : left + width]
    if region.shape != (height, width) or min(region.shape) < BOX_PX:
        raise OptionError(
            f"`edge` must be a box of {BOX_PX} x {BOX_PX} pixels or more inside the image of "
            f"{pixels.shape[1]} x {pixels.shape[0]} pixels, but it is {printable(words)}. X,Y is "
            "the upper left pixel, counted from 0."
        )
    return region
