"""How an image is cut, and what that costs: known before the run."""

from dataclasses import dataclass

import psutil

from deploy.swath.reader import Source
from deploy.tiling import Span, plan_side
from profiles.errors import MachineError


@dataclass(frozen=True)
class Plan:
    """Rows and columns of tiles over an image of `bands` planes."""

    bands: int
    height_px: int
    width_px: int
    tile_px: int
    halo_px: int
    radius_px: int
    rows: tuple[Span, ...]
    columns: tuple[Span, ...]

    @property
    def tiles(self) -> int:
        """Windows that the network sees."""
        return len(self.rows) * len(self.columns) * self.bands

    @property
    def work_factor(self) -> float:
        """Pixels that the network sees over pixels of the image."""
        seen = sum(r.stop - r.start for r in self.rows) * sum(c.stop - c.start for c in self.columns)
        return seen / (self.height_px * self.width_px)

    @property
    def band_rows_px(self) -> int:
        """Most rows that are read at once: a tile's, and those that missing pixels are filled from."""
        return min(max(r.stop - r.start for r in self.rows) + 2 * self.radius_px, self.height_px)


def make_plan(source: Source, tile_px: int, halo_px: int, radius_px: int) -> Plan:
    """The plan of an image.

    Raises:
        OptionError: a tile with no room between its two halos.
    """
    raster = source.raster
    rows, columns = (plan_side(size, tile_px, halo_px) for size in (raster.height_px, raster.width_px))
    return Plan(*raster.shape, tile_px, halo_px, radius_px, tuple(rows), tuple(columns))


def rows_bytes(source: Source, plan: Plan, begun: bool = False) -> int:
    """Memory that rows of the image will take beyond what is held now.

    Two bands as read and two as restored: one in work and one on its way, on either side; and what the source holds.
    Once the run has `begun`, the first band and the source's share are there already. Where pixels may be missing,
    each has a flag, and one more while flags are made.
    """
    raster = source.raster
    row_px = raster.bands * raster.width_px
    read = plan.band_rows_px * row_px * (raster.dtype.itemsize + raster.may_miss)
    restored = min(plan.tile_px, plan.height_px) * row_px * raster.out_dtype.itemsize
    flags = plan.band_rows_px * row_px * raster.may_miss
    return read + flags + 2 * restored + (0 if begun else read + source.held_bytes(plan.band_rows_px))


def check_memory(source: Source, plan: Plan, budget_bytes: int | None, begun: bool) -> int:
    """The process's peak memory in bytes: what it holds now, and the rows to come.

    Args:
        source: the image.
        plan: how it is cut.
        budget_bytes: None allows what is free.
        begun: the network has run and the first rows are read, so that what it holds now includes both.

    Raises:
        MachineError: it does not fit.
    """
    held = psutil.Process().memory_info().rss
    rows = rows_bytes(source, plan, begun)
    allowed = budget_bytes or psutil.virtual_memory().available + held
    if held + rows <= allowed:
        return held + rows
    bulky = source.held_bytes(1) > rows_bytes(source, plan) / 2
    remedy = "rewrite the image in tiles (gdal_translate -co TILED=YES)" if bulky else "take a smaller --tile"
    raise MachineError(
        "--memory",
        expected=f"a run within {allowed / 1e9:.2f} GB",
        got=f"{held / 1e9:.2f} GB before and {rows / 1e9:.2f} GB for rows of the image",
        remedy=f"{remedy} or give it more",
    )
