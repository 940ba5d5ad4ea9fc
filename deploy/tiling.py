"""Tiles that give the whole image's result, bit for bit: crop, never blend.

A tile reads `halo_px` more than it keeps on each side. With the halo at least the network's receptive radius, every
kept pixel sees just what it would see in the whole image. The last row and column are moved inward, so that every
tile has the same size and touches the image's own border (where the network pads with zeros) or has a full halo.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from profiles.errors import OptionError


@dataclass(frozen=True)
class Span:
    """One side of a tile: what it reads, and the part of it that is kept, in image pixels (end excluded)."""

    start: int
    stop: int
    keep_start: int
    keep_stop: int


@dataclass(frozen=True)
class Tile:
    """A window of the image and the part that is kept."""

    rows: Span
    columns: Span

    def read(self, image: np.ndarray) -> np.ndarray:
        """The window of an (H, W) image."""
        return image[self.rows.start : self.rows.stop, self.columns.start : self.columns.stop]

    def write(self, result: np.ndarray, image: np.ndarray) -> None:
        """Put the kept part of a tile's result into an (H, W) image."""
        rows = slice(self.rows.keep_start - self.rows.start, self.rows.keep_stop - self.rows.start)
        columns = slice(self.columns.keep_start - self.columns.start, self.columns.keep_stop - self.columns.start)
        target = (
            slice(self.rows.keep_start, self.rows.keep_stop),
            slice(self.columns.keep_start, self.columns.keep_stop),
        )
        image[target] = result[rows, columns]


def plan_tiles(height_px: int, width_px: int, tile_px: int, halo_px: int) -> list[Tile]:
    """Tiles in reading order whose kept parts cover the image exactly once.

    An image smaller than a tile is one window of its own size along that side.
    """
    rows, columns = plan_side(height_px, tile_px, halo_px), plan_side(width_px, tile_px, halo_px)
    return [Tile(row, column) for row in rows for column in columns]


def plan_side(size_px: int, tile_px: int, halo_px: int) -> list[Span]:
    """The spans along one side.

    Raises:
        OptionError: a tile with no room between its two halos.
    """
    if tile_px <= 2 * halo_px or halo_px < 0:
        raise OptionError(
            "--tile",
            expected=f"more than twice the halo of {halo_px} px",
            got=f"{tile_px} px",
            remedy="take larger tiles or a smaller halo",
        )
    return list(_spans(size_px, min(tile_px, size_px), halo_px))


def even_side_px(size_px: int, tile_px: int, halo_px: int) -> int:
    """The shortest side that needs no more tiles than `tile_px` does: what a last tile overlaps is work done twice.

    Raises:
        OptionError: as `plan_side`.
    """
    count = len(plan_side(size_px, tile_px, halo_px))
    return max(-(-(size_px + 2 * halo_px * (count - 1)) // count), 2 * halo_px + 1)


def _spans(size_px: int, tile_px: int, halo_px: int) -> Iterator[Span]:
    done = 0
    while done < size_px:
        start = min(max(done - halo_px, 0), size_px - tile_px)
        stop = start + tile_px
        kept = size_px if stop == size_px else stop - halo_px
        yield Span(start, stop, done, kept)
        done = kept
