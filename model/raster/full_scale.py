"""Determine which pixel value is full scale: the value that a network receives as 1.0."""

from collections.abc import Iterable

import numpy as np

from beers_deploy.model.raster.facts import Extent
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.profiles.instrument import MAX_DN

UNIT_MAX = 2.0
"""Floats up to this value may be shares of full scale, or reflectances, which exceed 1 on snow and
glint.

A raw image has a pixel above 2 DN wherever there is any light.
"""
RADIANCE_SHARE = 0.2
"""Non-integer floats up to this share of full scale may be radiances. Those of a bright scene stay
below some 700 W/m2/sr/um.
"""

ADVICE = "Give the pixel value that is full scale as `full_scale`"


def settled_scale(
    name: str,
    dtype: np.dtype[np.generic],
    extents: Iterable[Extent],
    asked: float | None = None,
    usual: float = MAX_DN,
    remedy: str | None = None,
) -> float:
    """Determine the pixel value that is full scale, which a network reads as 1.0.

    Args:
        name: the name of the image, for the message.
        dtype: the dtype of the pixels.
        extents: the extents (`facts.extent_of`) of successive parts of the image. They are only
            consumed for float pixels, up to the first part that decides.
        asked: the value that the user gave, which is returned; None lets type and values decide.
        usual: the full scale of digital numbers, by default that of 12 bits.
        remedy: the advice in the message if full scale is ambiguous; None advises to set
            `full_scale`.

    Raises:
        ImageError: the pixels have 8 bits, or are floats that may be digital numbers, radiances or
            shares of full scale.
        OptionError: no pixel of this type can have the value `asked`.
    """
    if asked is not None:
        floats = dtype.kind == "f"
        fits = floats or (asked <= 65535 and asked % 1 == 0)
        if 0 < asked < np.inf and fits:
            return asked
        allowed = "a number above 0" if floats else "an integer of 1 to 65535 for integer pixels"
        raise OptionError(f"`full_scale` must be {allowed}, got {asked:g}. 12 bits are 4095.")
    if dtype.itemsize == 1:
        advice = remedy or f"{ADVICE} (255 for all of 8 bits), or use the raw image."
        raise ImageError(
            f"{name} has 8-bit pixels, but digital numbers have more than 8 bits. {advice}"
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
    advice = remedy or f"{ADVICE}: 1 for shares, {usual:g} for digital numbers, else your own."
    raise ImageError(
        f"{name} has floats of at most {brightest:.3g}, which may be digital numbers, radiances or "
        f"shares of full scale. {advice}"
    )


def remedy_outside(low: float, high: float, remedy: str) -> str:
    """Return a sentence that says what to do about pixels outside the range of the sensor.

    Args:
        low: the smallest pixel value of the image.
        high: the largest pixel value of the image.
        remedy: the sentence to return if the values are only too large.
    """
    if not np.isfinite([low, high]).all():
        return (
            "Write NaN or the nodata value in place of infinite pixels: 'restore' treats both as "
            "missing."
        )
    if low < 0:
        return (
            "Add the offset that was subtracted from the image, clip it at 0, or mark such pixels "
            "as nodata."
        )
    return remedy
