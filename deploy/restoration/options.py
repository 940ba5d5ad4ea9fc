"""How an image is to be restored: what a user can choose. It loads nothing, so that '--help' stays quick."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from profiles.errors import OptionError

TILE_PX = 640
"""Side of a tile unless somebody asks for another: what the paper's network was given on the board."""


class Runtime(StrEnum):
    """The library that runs the network."""

    onnxruntime = "onnxruntime"
    openvino = "openvino"
    auto = "auto"  # what is fastest here, and gives onnxruntime's bytes: deploy.restoration.choice


class Compression(StrEnum):
    """The compressions of the output, all lossless."""

    none = "none"
    zlib = "zlib"
    zstd = "zstd"
    lzw = "lzw"

    @property
    def codec(self) -> str | None:
        """The name by which tifffile knows it; None without compression."""
        return None if self is Compression.none else self.value


@dataclass(frozen=True)
class Options:
    """What a user can choose of a restoration by a network.

    Attributes:
        model: the network's file.
        tile_px: longest side of a tile; None leaves it to `runtime` where that is auto, and else is TILE_PX.
        halo: 'exact', or pixels of context around a tile.
        full_scale: the pixel value that is 1.0 to the network; None leaves it to deploy.restoration.radiometry.
        runtime: what runs the network.
        threads: of the runtime; 0 takes every core, or a worker's share of them.
        compression: of the output.
        memory_bytes: budget of the process with its workers here, or of each worker elsewhere; None is what is free.
        resume: go on with a stopped run.
        workers: processes of this machine that restore; 0 is this process alone.
        scheduler: address of a Dask scheduler whose workers restore.
        bands: networks of single bands by their names, each for its own sensor; empty where `model` is for all.
        cog: whether the output is a Cloud-Optimised GeoTIFF.
        sensor_bits: bits per pixel of the sensor, where the user named its profile.
        lanes: tiles in work at a time; None leaves it to the number of cores.
        trust_index: whether a VRT or DIMAP may name tiles outside its folder, at URLs too.
    """

    model: Path
    tile_px: int | None = None
    halo: str = "exact"
    full_scale: float | None = None
    runtime: Runtime = Runtime.onnxruntime
    threads: int = 0
    compression: Compression = Compression.zlib
    memory_bytes: int | None = None
    resume: bool = False
    workers: int = 0
    scheduler: str | None = None
    trust_index: bool = False
    sensor_bits: int | None = None
    cog: bool = False
    bands: Mapping[str, Path] = field(default_factory=dict)
    lanes: int | None = None

    @property
    def is_spread(self) -> bool:
        """Whether other processes than this one restore."""
        return bool(self.workers or self.scheduler)


def parse_halo(text: str, radius_px: int) -> int:
    """The halo in pixels that a user asked for: 'exact' is the network's receptive radius.

    Raises:
        OptionError: neither 'exact' nor a number of pixels.
    """
    if text == "exact":
        return radius_px
    if text.isdecimal():
        return int(text)
    remedy = f"{radius_px} is exact for this network"
    raise OptionError("--halo", expected="'exact' or a number of pixels", got=repr(text), remedy=remedy)
