"""The memory that a run will need, checked before it starts, and the peak that it used."""

import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil

from beers_deploy.model.raster.source import Source
from beers_deploy.profiles.errors import MachineError, sizes
from beers_deploy.profiles.figures import Figure, measured
from beers_deploy.restoration.plan import Plan

STATUS = Path("/proc/self/status")
"""Linux's own statistics of this process."""

FLOAT_BYTES = np.dtype(np.float32).itemsize


def rows_bytes(source: Source, plan: Plan, begun: bool = False) -> int:
    """Estimate the bytes of memory that the rows in work need, in addition to the memory that the
    process uses now.

    At its peak a run holds three strips of raw rows, two in work and one being read; three rows of
    tiles in float32, as the network returned them; two finished rows of tiles in the type of the
    output; and the memory in which the image is decoded. If pixels may be missing, each raw pixel
    has a flag of a byte, and one more while flags are computed.

    Args:
        source: the image.
        plan: how the image is cut into tiles.
        begun: True if the run has read its first strip, so that this strip and the memory for
            decoding are part of the memory in use.
    """
    raster = source.raster
    strip_px = plan.strip_rows_px * raster.bands * raster.width_px
    # `may_miss` adds one byte a pixel: the flag of a missing one.
    flags = strip_px * raster.may_miss
    strip_bytes = strip_px * raster.dtype.itemsize + flags
    source_bytes = 0 if begun else strip_bytes + source.held_bytes(plan.strip_rows_px)
    bands, _, width_px = plan.out_shape
    row_values = plan.tile_shape[0] * plan.scale * bands * width_px
    restored = row_values * (3 * FLOAT_BYTES + 2 * raster.out_dtype.itemsize)
    return 2 * strip_bytes + flags + restored + source_bytes


def check_memory(rows: int, budget_bytes: int | None) -> int:
    """Return the peak memory that this process will reach, in bytes: the resident memory that it
    uses now, plus the memory for rows of the image.

    Args:
        rows: the bytes that rows of the image will need, as `rows_bytes` estimates them.
        budget_bytes: the memory that the process may use; None allows all free memory.

    Raises:
        MachineError: the peak exceeds the memory that is allowed.
    """
    resident_bytes = psutil.Process().memory_info().rss
    allowed_bytes = budget_bytes
    if allowed_bytes is None:
        # Memory that this process already uses is not free.
        allowed_bytes = psutil.virtual_memory().available + resident_bytes
    if resident_bytes + rows <= allowed_bytes:
        return resident_bytes + rows
    limit, before, rows_size = sizes(allowed_bytes, resident_bytes, rows)
    raise MachineError(
        f"The run may use {limit} of memory, but the process already uses {before}, and rows of "
        f"the image need {rows_size} more. Allow more memory than both together, use a smaller "
        "`tile`, or rewrite an image of large strips in tiles (gdal_translate -co TILED=YES)."
    )


def peak_memory() -> Figure:
    """Return the peak resident memory of this process since it started, in GB."""
    source = "resident memory of this process, highest since it began"
    return measured(_peak_bytes() / 1e9, "GB", source)


def _peak_bytes() -> int:
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    # On Linux, getrusage's count begins with the memory of the process's parent.
    with suppress(OSError, StopIteration):
        lines = STATUS.read_text(encoding="utf-8").splitlines()
        return 1024 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
    # Every system but Windows has this module.
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # macOS counts bytes, the others KiB.
    return peak if sys.platform == "darwin" else 1024 * peak
