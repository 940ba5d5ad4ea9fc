"""How an image is to be restored."""

import hashlib
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from deploy.restoration.plan import Plan
from model.io.files import sha256

TILE_PX = 640


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
        full_scale: the pixel value that is 1.0 to the network; None lets type and values decide (model.io.images).
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
    full_scale: float | None = None
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


DIGEST_BYTES = 1 << 16


def make_job(image: Path, options: Options, plan: Plan, runtime: str, full_scale: float) -> dict[str, object]:
    """As the journal keeps it; who computes, and on how many machines, is no part of it."""
    return {
        "image": [*fingerprint(image), image.stat().st_mtime_ns],
        "model": sha256(options.model),
        "tile_px": plan.tile_px,
        "halo_px": plan.halo_px,
        "full_scale": full_scale,
        "runtime": runtime,
    }


def fingerprint(image: Path) -> tuple[int, str]:
    """Size in bytes, and a digest of the file's two ends: quick, however large it is."""
    size_bytes = image.stat().st_size
    with image.open("rb") as stream:
        ends = stream.read(DIGEST_BYTES)
        stream.seek(max(size_bytes - DIGEST_BYTES, 0))
        ends += stream.read(DIGEST_BYTES)
    return size_bytes, hashlib.sha256(ends).hexdigest()
