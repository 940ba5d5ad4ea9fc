"""How many tiles an image takes: as the paper counts, and as a grid of whole tiles with exact seams."""

from deploy.tiling import plan_side


def paper_frames(width_px: int, height_px: int, tile_px: int) -> float:
    """Pixels of the image over pixels of a tile: a fraction, with no halo (paper, table of the VCK190 benchmark).

    13600 x 9016 at 640 is 299.4; at the published 7.2 frames a second that is the published 42 s.
    """
    return width_px * height_px / tile_px**2


def tile_count(size_px: int, tile_px: int, halo_px: int) -> int:
    """Tiles along one side, ceil((size - 2 halo) / (tile - 2 halo)): the outer tiles need no halo outside.

    Raises:
        OptionError: a tile with no room between its two halos.
    """
    return len(plan_side(size_px, tile_px, halo_px))


def whole_tiles(width_px: int, height_px: int, tile_px: int, halo_px: int) -> int:
    """Tiles of the grid, the last row and column moved inward: 384 for 13600 x 9016 at 640 with a halo of 35."""
    return tile_count(width_px, tile_px, halo_px) * tile_count(height_px, tile_px, halo_px)
