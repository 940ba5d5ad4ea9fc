"""How an image is to be restored."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

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
        threads: of the runtime; 0 takes every core.
        compression: of the output.
        memory_bytes: budget of the process; None allows what is free.
        resume: go on with a stopped run.
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
