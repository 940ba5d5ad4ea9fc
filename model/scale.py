"""What pixel value is full scale, the network's 1.0: as asked for, or as the pixels' type and values tell.

- Integers of more than 8 bits are 12-bit digital numbers: 4095.
- Floats are digital numbers too where one of them is larger than any share of full scale or reflectance.
- 8-bit pixels and floats that all lie in about 0..1 came from no 12-bit sensor as they are, and nothing in them says
  what was done to them: they are refused until the full scale is given.

The output has the scale of the input.
"""

from collections.abc import Iterable

import numpy as np

from profiles.errors import ImageError, OptionError

FULL_SCALE_DN = 4095.0
"""Of 12 bits."""

UNIT_MAX = 2.0
"""Floats no larger may be shares of full scale, or reflectances, which pass 1 on snow and glint. A raw image has a
pixel above 2 DN wherever it sees anything at all."""

REMEDY = "give the pixel value that is full scale as --full-scale"


def settled_scale(
    name: str,
    dtype: np.dtype[np.generic],
    largest: Iterable[float],
    asked: float | None = None,
    usual: float = FULL_SCALE_DN,
    remedy: str | None = None,
) -> float:
    """The pixel value that is full scale.

    Args:
        name: of the image, for the message.
        dtype: of the pixels.
        largest: the largest size of a known pixel in each part of the image, drawn for floats only and no further
            than to the first that decides; 0 says nothing.
        asked: as the user gave it; None lets type and values decide.
        usual: the full scale of digital numbers.
        remedy: what to do about pixels that leave it open, where the caller has no --full-scale.

    Raises:
        ImageError: pixels that leave it open.
        OptionError: a full scale that such pixels cannot have.
    """
    if asked is not None:
        check_scale(asked, dtype.kind)
        return asked
    if dtype.itemsize == 1:
        raise _open(name, "8-bit pixels", remedy or f"{REMEDY} (255 for all of 8 bits), or the raw image")
    if dtype.kind != "f":
        return usual
    brightest = 0.0
    for value in largest:
        brightest = max(brightest, value)
        if brightest > UNIT_MAX:
            return usual
    if brightest == 0:  # black, or missing everywhere
        return usual
    got = f"floats of at most {brightest:.3g}"
    raise _open(name, got, remedy or f"{REMEDY} (1 for 0..1, {usual:g} for digital numbers)")


def check_scale(full_scale: float, kind: str) -> None:
    """A full scale that pixels of this kind (numpy's letter) can have.

    Raises:
        OptionError: another.
    """
    whole = full_scale <= 65535 and full_scale % 1 == 0
    if 0 < full_scale < np.inf and (kind == "f" or whole):
        return
    expected = "a number above 0" if kind == "f" else "a whole number of 1 to 65535 for integer pixels"
    raise OptionError("--full-scale", expected=expected, got=f"{full_scale:g}", remedy="4095 is 12 bits")


def remedy_outside(low: float, high: float, remedy: str) -> str:
    """What to do about values from `low` to `high` that no sensor gives; `remedy` where they are only too large."""
    if not np.isfinite([low, high]).all():
        return "write NaN or the nodata value in place of infinite pixels: 'restore' takes both for missing"
    if low < 0:
        return "add the offset that was taken off the image, clip it at 0, or mark such pixels as nodata"
    return remedy


def _open(name: str, got: str, remedy: str) -> ImageError:
    return ImageError(name, expected="digital numbers of more than 8 bits", got=got, remedy=remedy)
