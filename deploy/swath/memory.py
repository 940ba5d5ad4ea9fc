"""What a run takes of memory, and whether it fits in the budget."""

import psutil

from deploy.swath.plan import Plan
from deploy.swath.reader import Source
from profiles.errors import MachineError, sizes


def rows_bytes(source: Source, plan: Plan, begun: bool = False) -> int:
    """Memory that rows of the image will take beyond what is held now.

    Three bands as read and three as restored: two in work and one on its way, on either side; and what the source
    holds. Once the run has `begun`, the first band and the source's share are there already. Where pixels may be
    missing, each has a flag, and one more while flags are made.
    """
    raster = source.raster
    row_px = raster.bands * raster.width_px
    read = plan.band_rows_px * row_px * (raster.dtype.itemsize + raster.may_miss)
    flags = plan.band_rows_px * row_px * raster.may_miss
    held = 0 if begun else read + source.held_bytes(plan.band_rows_px)
    return 2 * read + flags + 3 * restored_bytes(source, plan) + held


def restored_bytes(source: Source, plan: Plan) -> int:
    """Memory of one row of tiles as it is stored."""
    raster = source.raster
    return plan.tile_shape[0] * raster.bands * raster.width_px * raster.out_dtype.itemsize


def check_memory(rows: int, budget_bytes: int | None, bulky: bool, share: int = 1) -> int:
    """The process's peak memory in bytes: what it holds now, and the rows to come.

    Args:
        rows: bytes that rows of the image will take.
        budget_bytes: None allows what is free.
        bulky: most of them for the sake of an image in large strips.
        share: how many processes share the budget.

    Raises:
        MachineError: it does not fit.
    """
    held = psutil.Process().memory_info().rss
    allowed = budget_bytes // share if budget_bytes else psutil.virtual_memory().available // share + held
    if held + rows <= allowed:
        return held + rows
    limit, before, rows_size = sizes(allowed, held, rows)
    remedy = "rewrite the image in tiles (gdal_translate -co TILED=YES)" if bulky else "take a smaller --tile"
    raise MachineError(
        "--memory" + (f", one of {share} processes" if share > 1 else ""),
        expected=f"a run within {limit}",
        got=f"{before} before and {rows_size} for rows of the image",
        remedy=f"{remedy} or give it more" if held < allowed else f"give it more than {before}",
    )


def is_bulky(source: Source, plan: Plan) -> bool:
    """Whether most of the memory is for the image's own strips or tiles."""
    return source.held_bytes(1) > rows_bytes(source, plan) / 2
