"""Settle which pixel value is full scale: the one that is 1.0 to a network."""

from collections.abc import Iterable

import numpy as np

from beers_deploy.model.raster.facts import Extent
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.profiles.sensor import MAX_DN

UNIT_MAX = 2.0
"""Floats no larger may be shares of full scale, or reflectances, which pass 1 on snow and glint.

A raw image has a pixel above 2 DN wherever it sees anything at all.
"""
RADIANCE_SHARE = 0.2
"""Floats that are no whole numbers and no larger than this share of full scale may be radiances:
those of a bright scene, in W/m2/sr/um, stay below some 700.
"""

REMEDY = "give the pixel value that is full scale as `full_scale`"


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
