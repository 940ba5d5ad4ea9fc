"""The radiometry of an image: the pixel value that is full scale, and its source (the user, the
file or the sensor's profile).

If none of them states a full scale, 12 bits are assumed, and the output reports the assumption.
Values above a stated full scale are clipped, counted and reported. Values above an assumed one show
that the assumption is wrong, and the image is refused.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from beers_deploy.model.raster.facts import Extent, Raster
from beers_deploy.model.raster.full_scale import settled_scale
from beers_deploy.profiles.errors import OptionError, counted
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.profiles.sensor import Sensor


@dataclass(frozen=True)
class Reading:
    """The options of a run that decide how the pixels of its image are interpreted and checked.

    Attributes:
        sensors: the sensors that the user names, by the name of the band. One sensor for all bands
            has the key ""; the mapping is empty if none is named.
        full_scale: the pixel value that is 1.0 to a network; None to take it from the file or the
            sensor.
        nodata: the value of an array's missing pixels, in addition to NaN; a file states its own.
        strict: True to refuse an image that contradicts its sensor, and a result that contradicts
            its raw image.
        force: True to accept an image that was restored before and an index that leads to tiles
            outside its folder or at URLs, and to write implausible results.
        memory_bytes: memory budget of this process; None for all that is free.
        fix_detectors: the list of faulty detectors to replace, or 'found'; empty to replace none.
    """

    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    full_scale: float | None = None
    nodata: float | None = None
    strict: bool = False
    force: bool = False
    memory_bytes: int | None = None
    fix_detectors: str = ""


@dataclass(frozen=True)
class FullScale:
    """The full scale of an image, which is 1.0 to a network, and its source.

    Attributes:
        value: the pixel value that is full scale.
        source: in words, who states it: the user, the file, the sensor or an assumption.
        assumed: True if nobody states it, so that 12 bits are assumed.
    """

    value: float
    source: str
    assumed: bool = False

    @property
    def words(self) -> str:
        """The value and its source in words, such as "4095 (12 bits, of the sensor)"."""
        return f"{self.value:g} ({self.source})"

    @property
    def text(self) -> dict[str, str]:
        """The value and its source as two entries, by name, for the row of results of a run."""
        return {"full scale": f"{self.value:g}", "full scale from": self.source}


def full_scale_of(
    name: str,
    raster: Raster,
    extents: Iterable[Extent],
    reading: Reading,
) -> FullScale:
    """Determine the full scale of an image: that of the user, the file, the sensor, or 12 bits.

    Args:
        name: the name of the image, for messages.
        raster: the description of the image.
        extents: for each part of the image its largest value, and whether its values are integers.
            They are read for float pixels only, to tell digital numbers from other units.
        reading: the options of the run, of which `full_scale` and the bits of `sensors` count.

    Raises:
        OptionError: the user's full scale is not positive, or the output's type cannot hold it.
        ImageError: the pixels have 8 bits, or are floats that may be other units than digital
            numbers, and neither the user nor the file states a full scale.
    """
    requested = reading.full_scale
    # Of several sensors the smallest number of bits counts.
    bits = min((int(sensor.bits.low) for sensor in reading.sensors.values()), default=None)
    if requested is not None:
        settled_scale(name, raster.dtype, extents, requested)
        kind = raster.out_dtype
        # A float output holds any full scale.
        if kind.kind != "f" and requested > np.iinfo(kind).max:
            raise OptionError(
                f"`full_scale` must be at most {np.iinfo(kind).max} for {kind} pixels, got "
                f"{requested:g}. Convert the image to uint16."
            )
        return FullScale(requested, "asked for")
    if raster.bits is not None:
        return FullScale(2**raster.bits - 1, f"{counted(raster.bits, 'bit')}, as the file states")
    # A full scale that the type of the pixels cannot hold is not that of the image.
    if bits is None or (raster.dtype.kind != "f" and 2**bits - 1 > np.iinfo(raster.dtype).max):
        return FullScale(
            settled_scale(name, raster.dtype, extents), f"assumed: {MAX_DN.bit_length()} bits", True
        )
    usual = 2**bits - 1
    value = (
        settled_scale(name, raster.dtype, extents, usual=usual)
        if raster.dtype.kind == "f"
        else usual
    )
    return FullScale(value, f"{counted(bits, 'bit')}, of the sensor")
