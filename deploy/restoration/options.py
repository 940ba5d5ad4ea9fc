"""How an image is to be restored: what a user can choose.

It loads nothing, so that '--help' stays quick.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from beers_deploy.model.raster.compression import Compression
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import TILE_PX


class Runtime(StrEnum):
    """The library that runs the network."""

    onnxruntime = "onnxruntime"
    openvino = "openvino"


@dataclass(frozen=True)
class Options:
    """What a user can choose of a restoration.

    Attributes:
        model: the network's file; none of the traditional pipeline.
        tile_px: longest side of a tile.
        halo: 'exact', or pixels of context around a tile.
        full_scale: the pixel value that is 1.0 to the network; None leaves it to
            deploy.restoration.radiometry.
        runtime: what runs the network.
        threads: of the runtime; 0 takes every core, or one for each call that a scheduler's workers
            run at once.
        compression: of the output.
        memory_bytes: budget of this process; None is what is free.
        resume: go on with a stopped run.
        scheduler: address of a Dask scheduler whose workers run the network; None runs it here.
        again: whether an image may be one that was restored already.
        any_result: whether a result is written that no restoration has.
        bands: networks of single bands by their names, each for its own sensor; empty where `model`
            is for all.
        brighter: the network for sensors of so many times the gain, by band and factor; empty where
            none is.
        consistency: whether the consistency step is taken where the sensor is known.
        fix_detectors: the list of faulty detectors to replace, or 'found'; empty to replace none.
        cog: whether the output is a Cloud-Optimised GeoTIFF.
        sensors: that the user named, by band; under no name where one is for all, empty where none
            was named.
        strict: whether an image is refused that contradicts its sensor.
        trust_index: whether a VRT or DIMAP may name tiles outside its folder, at URLs too.
    """

    model: Path = Path()
    tile_px: int = TILE_PX
    halo: str = "exact"
    full_scale: float | None = None
    runtime: Runtime = Runtime.onnxruntime
    threads: int = 0
    compression: Compression = Compression.zlib
    memory_bytes: int | None = None
    resume: bool = False
    scheduler: str | None = None
    trust_index: bool = False
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    strict: bool = False
    cog: bool = False
    again: bool = False
    any_result: bool = False
    bands: Mapping[str, Path] = field(default_factory=dict)
    brighter: Mapping[str, Mapping[int, Path]] = field(default_factory=dict)
    consistency: bool = True
    fix_detectors: str = ""

    @property
    def sensor_bits(self) -> int | None:
        """Bits of a digital number, where a sensor was named."""
        return min((int(sensor.bits.low) for sensor in self.sensors.values()), default=None)


def parse_halo(text: str, radius_px: int) -> int:
    """The halo in pixels that a user asked for: 'exact' is the network's receptive radius."""
    if text == "exact":
        return radius_px
    if text.isdecimal():
        return int(text)
    remedy = f"{radius_px} is exact for this network"
    raise OptionError(
        "halo", expected="'exact' or a number of pixels", got=repr(text), remedy=remedy
    )
