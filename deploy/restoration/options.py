"""How an image is to be restored: what a user can choose.

It loads nothing, so that '--help' stays quick.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from beers_deploy.model.raster.compression import Compression
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import TILE_PX

if TYPE_CHECKING:
    from beers_deploy.network import NetworkLike


class Method(StrEnum):
    """A network, or the traditional pipeline."""

    network = "network"
    traditional = "traditional"


class Runtime(StrEnum):
    """The library that runs the network."""

    onnxruntime = "onnxruntime"
    openvino = "openvino"


@dataclass(frozen=True)
class Options:
    """What a user can choose of a restoration.

    Attributes:
        network: what `Network.load` takes; the default network if None.
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
        force: whether to restore an image that was restored already, to follow a VRT or DIMAP to
            tiles outside its folder and at URLs, and to write a result that no restoration has.
        bands: networks of single bands by their names, each for its own sensor; empty if `network`
            is for all.
        exposure: whether dark parts are restored at a higher exposure, by a conditioned network.
        consistency: whether the consistency step is taken where the sensor is known.
        fix_detectors: the list of faulty detectors to replace, or 'found'; empty to replace none.
        cog: whether the output is a Cloud-Optimised GeoTIFF.
        sensors: that the user named, by band; under no name where one is for all, empty where none
            was named.
        method: a network, or the traditional pipeline.
        quality: of the traditional pipeline: fast, standard or best.
        strict: whether an image is refused that contradicts its sensor.
    """

    network: "NetworkLike | None" = None
    tile_px: int = TILE_PX
    halo: str = "exact"
    full_scale: float | None = None
    runtime: Runtime = Runtime.onnxruntime
    threads: int = 0
    compression: Compression = Compression.zlib
    memory_bytes: int | None = None
    resume: bool = False
    scheduler: str | None = None
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    strict: bool = False
    cog: bool = False
    force: bool = False
    bands: "Mapping[str, NetworkLike]" = field(default_factory=dict)
    exposure: bool = True
    consistency: bool = True
    fix_detectors: str = ""
    method: Method = Method.network
    quality: str = "standard"

    @property
    def network_paths(self) -> list[Path]:
        """The files of the networks, which no output may be."""
        given = [
            each if isinstance(each, str | os.PathLike) else getattr(each, "path", None)
            for each in (self.network, *self.bands.values())
        ]
        return [Path(each) for each in given if each is not None]

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
