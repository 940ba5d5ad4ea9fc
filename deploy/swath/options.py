"""How an image is to be restored."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from profiles.errors import OptionError

TILE_PX = 640
FULL_SCALE_DN = 4095.0


class Runtime(StrEnum):
    """What runs the network."""

    onnxruntime = "onnxruntime"
    openvino = "openvino"


class Compression(StrEnum):
    """Lossless compressions of the output."""

    none = "none"
    zlib = "zlib"
    zstd = "zstd"
    lzw = "lzw"

    @property
    def codec(self) -> str | None:
        """As tifffile calls it."""
        return None if self is Compression.none else self.value


@dataclass(frozen=True)
class Options:
    """What a user can choose.

    Attributes:
        model: the network's file.
        tile_px: side of a tile.
        halo: 'exact', or pixels of context around a tile.
        full_scale: the digital number that is 1.0 to the network.
        runtime: what runs the network.
        threads: of the runtime; 0 takes every core, or a worker's share of them.
        compression: of the output.
        memory_bytes: budget of the process with its workers here, or of each worker elsewhere; None is what is free.
        resume: go on with a stopped run.
        workers: processes of this machine that restore; 0 is this process alone.
        scheduler: address of a Dask scheduler whose workers restore.
    """

    model: Path
    tile_px: int = TILE_PX
    halo: str = "exact"
    full_scale: float = FULL_SCALE_DN
    runtime: Runtime = Runtime.onnxruntime
    threads: int = 0
    compression: Compression = Compression.zlib
    memory_bytes: int | None = None
    resume: bool = False
    workers: int = 0
    scheduler: str | None = None

    @property
    def is_spread(self) -> bool:
        """Whether other processes restore."""
        return bool(self.workers or self.scheduler)


def check_scale(full_scale: float, kind: str) -> None:
    """A full scale that pixels of this kind (numpy's letter, of the output) can have.

    Raises:
        OptionError: another.
    """
    if full_scale > 0 and (kind == "f" or (full_scale <= 65535 and full_scale % 1 == 0)):
        return
    expected = "a number above 0" if kind == "f" else "a whole number of 1 to 65535 for integer pixels"
    raise OptionError("--full-scale", expected=expected, got=f"{full_scale:g}", remedy="4095 is 12 bits")
