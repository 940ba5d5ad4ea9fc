"""How the pixels of an image are understood: which value is full scale, and who says so: the user,
the file, the sensor's profile, or nobody.

What nobody states is assumed in sight: 12 bits. Values above a stated full scale are clipped,
counted and told; above an assumed one they show that the assumption is wrong, and are refused.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from beers_deploy.model.raster.facts import Extent, Raster
from beers_deploy.model.raster.full_scale import settled_scale
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.profiles.sensor import Sensor


@dataclass(frozen=True)
class Reading:
    """How the pixels of an image are understood.

    Attributes:
        sensors: that the user names, by band; under no name where one is for all, empty where none
            is named.
        full_scale: the pixel value that is 1.0 to a network; None leaves it to `radiometry`.
        nodata: the value of an array's missing pixels, besides NaN; a file states its own.
        strict: whether an image is refused that contradicts its sensor.
        force: whether an image is accepted that was restored already, an index may lead to tiles
            outside its folder and at URLs, and any result is written.
        memory_bytes: budget of this process; None is what is free.
        fix_detectors: the list of faulty detectors to replace, or 'found'; empty to replace none.
    """

    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    full_scale: float | None = None
    nodata: float | None = None
    strict: bool = False
    force: bool = False
    memory_bytes: int | None = None
    fix_detectors: str = ""

    @property
    def sensor_bits(self) -> int | None:
        """Bits of a digital number, where a sensor is named."""
        return min((int(sensor.bits.low) for sensor in self.sensors.values()), default=None)


@dataclass(frozen=True)
class FullScale:
    """The pixel value that is full scale, in words where it is from, and whether that is an
    assumption.
    """

    value: float
    source: str
    assumed: bool = False

    @property
    def words(self) -> str:
        """The value, and where it is from."""
        return f"{self.value:g} ({self.source})"

    @property
    def text(self) -> dict[str, str]:
        """Both as the text of a row of results."""
        return {"full scale": f"{self.value:g}", "full scale from": self.source}


def full_scale_of(
    name: str,
    raster: Raster,
    extents: Iterable[Extent],
    asked: float | None = None,
    bits: int | None = None,
) -> FullScale:
    """The full scale of an image.

    Args:
        name: of the image, for messages.
        raster: what its file states.
        extents: as for `model.raster.full_scale.settled_scale`, drawn for floats only.
        asked: by the user.
        bits: of the sensor, where the user names its profile.
    """
    if asked is not None:
        settled_scale(name, raster.dtype, extents, asked)
        require_room(raster, asked)
        return FullScale(asked, "asked for")
    if raster.bits is not None:
        return FullScale(2**raster.bits - 1, f"{raster.bits} bits, as the file states")
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
    return FullScale(value, f"{bits} bits, of the sensor")


def require_room(raster: Raster, full_scale: float) -> None:
    """That restored pixels up to full scale fit into the output's type."""
    kind = raster.out_dtype
    # A float output holds any full scale.
    if kind.kind != "f" and full_scale > np.iinfo(kind).max:
        raise OptionError(
            f"`full_scale` must be at most {np.iinfo(kind).max} for {kind} pixels, got "
            f"{full_scale:g}. Convert the image to uint16."
        )
