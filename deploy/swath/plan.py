"""How an image is cut, and what that costs: known before the run."""

from dataclasses import dataclass

from deploy.swath.raster import Raster
from deploy.tiling import Span, even_side_px, plan_side


@dataclass(frozen=True)
class Plan:
    """Rows and columns of tiles, none longer than `tile_px`, over an image of `bands` planes."""

    bands: int
    height_px: int
    width_px: int
    tile_px: int
    halo_px: int
    radius_px: int
    rows: tuple[Span, ...]
    columns: tuple[Span, ...]

    @property
    def tile_shape(self) -> tuple[int, int]:
        """Rows and columns of pixels of every tile."""
        row, column = self.rows[0], self.columns[0]
        return row.stop - row.start, column.stop - column.start

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
        return min(self.tile_shape[0] + 2 * self.radius_px, self.height_px)


def make_plan(raster: Raster, tile_px: int, halo_px: int, radius_px: int, fixed: bool = False) -> Plan:
    """The plan of an image: tiles of at most `tile_px` a side, or of just that where the network is `fixed` to it.

    Raises:
        OptionError: a tile with no room between its two halos.
    """
    sizes = raster.height_px, raster.width_px
    sides = [tile_px if fixed else even_side_px(size, tile_px, halo_px) for size in sizes]
    rows, columns = (tuple(plan_side(size, side, halo_px)) for size, side in zip(sizes, sides, strict=True))
    return Plan(*raster.shape, tile_px, halo_px, radius_px, rows, columns)
