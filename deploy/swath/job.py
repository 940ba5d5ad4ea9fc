"""All that decides the pixels of an output: a stopped run is resumed only by one of the same job."""

import hashlib
from pathlib import Path

from deploy.swath.options import Options
from deploy.swath.plan import Plan
from model.files import sha256

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
