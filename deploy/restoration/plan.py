"""How an image is cut into tiles with exact seams, and what that costs: known before the run.

A tile is read with a halo of `halo_px` pixels around what is kept of it. Where the halo is the
network's receptive radius, the result is the whole image's, bit for bit (`quant.tiling`). A network
with strides is given tiles that begin and end at multiples of its lattice; the last ones reach
beyond an image that is no multiple of it, which is extended there by copies of its last row and
column.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from beers_deploy.network import Network
from beers_deploy.profiles.errors import ModelError, OptionError, printable
from beers_deploy.profiles.shipped import TILE_PX
from beers_deploy.quant.tiling.receptive_field import Tiling


@dataclass(frozen=True)
class Tiles:
    """How an image is to be cut.

    Attributes:
        side_px: longest side of a tile.
        halo: 'exact', or pixels of context around a tile.
    """

    side_px: int = TILE_PX
    halo: str = "exact"


def parse_halo(halo: str, radius_px: int) -> int:
    """Return the halo in pixels that a user asks for: 'exact' is the network's receptive radius."""
    if halo == "exact":
        return radius_px
    if halo.isdecimal():
        return int(halo)
    raise OptionError(
        f"`halo` must be 'exact' or a number of pixels, got {printable(repr(halo))}. A halo "
        f"of {radius_px} px is exact for this network."
    )


@dataclass(frozen=True)
class Span:
    """One side of a tile: what it reads, and the part of it that is kept, in image pixels (end
    excluded).

    What it reads may end beyond the image, by less than the network's lattice.
    """

    start: int
    stop: int
    keep_start: int
    keep_stop: int


def plan_side(
    size_px: int, tile_px: int, halo_px: int, alignment_px: int = 1, min_side_px: int = 1
) -> list[Span]:
    """The spans along one side of `size_px` pixels, each of `tile_px`, or one of all where that is
    less.

    Args:
        size_px: of the image.
        tile_px: side of a tile; rounded down to the lattice.
        halo_px: a multiple of the lattice.
        alignment_px: spans begin at its multiples, and read to one.
        min_side_px: that a span reads, beyond the image where that has fewer.
    """
    if tile_px < 2 * halo_px + alignment_px or halo_px < 0:
        least = f", at least {2 * halo_px + alignment_px} px" if alignment_px > 1 else ""
        raise OptionError(
            f"`tile` must be more than twice the halo of {halo_px} px{least}, got {tile_px} px. "
            "Use larger tiles or a smaller halo."
        )
    # The strides of a network sample other pixels in a tile that begins or ends off the lattice.
    extended_px = _up(max(size_px, min_side_px), alignment_px)
    side_px = min(tile_px // alignment_px * alignment_px, extended_px)
    return list(_spans(size_px, extended_px, side_px, halo_px))


def _up(size_px: int, alignment_px: int) -> int:
    return -(-size_px // alignment_px) * alignment_px


def even_side_px(size_px: int, tile_px: int, halo_px: int, alignment_px: int = 1) -> int:
    """The shortest side that needs no more tiles than `tile_px` does."""
    # A last tile that is moved inward computes pixels twice; even tiles compute fewer.
    count = len(plan_side(size_px, tile_px, halo_px, alignment_px))
    even_px = -(-(_up(size_px, alignment_px) + 2 * halo_px * (count - 1)) // count)
    return max(_up(even_px, alignment_px), 2 * halo_px + alignment_px)


def _spans(image_px: int, size_px: int, tile_px: int, halo_px: int) -> Iterator[Span]:
    """Spans over `size_px`, the image and its extension; what is kept ends with the image."""
    done = 0
    # All spans have the same length, so the last one is moved inward instead of cut.
    while done < image_px:
        start = min(max(done - halo_px, 0), size_px - tile_px)
        stop = start + tile_px
        keep_stop = image_px if stop == size_px else stop - halo_px
        yield Span(start, stop, done, keep_stop)
        done = keep_stop


@dataclass(frozen=True)
class Plan:
    """Rows and columns of tiles over an image of `bands` bands.

    Attributes:
        bands: of the image, each cut alike and restored by itself, or all together as the network
            takes them.
        height_px: of the image.
        width_px: of the image.
        tile_px: no tile is longer.
        halo_px: context around what is kept of a tile.
        tiling: how the network meets an image.
        rows: of tiles, from top to bottom.
        columns: of tiles, from left to right.
    """

    bands: int
    height_px: int
    width_px: int
    tile_px: int
    halo_px: int
    tiling: Tiling
    rows: tuple[Span, ...]
    columns: tuple[Span, ...]

    @property
    def radius_px(self) -> int:
        """The network's receptive radius; with a halo of so much the seams are exact."""
        return self.tiling.halo_px

    @property
    def scale(self) -> int:
        """Pixels of the restored image for one of the image, along either side."""
        return int(self.tiling.scale)

    @property
    def groups(self) -> int:
        """Of bands that the network takes together."""
        return self.bands // self.tiling.channels_in

    @property
    def out_shape(self) -> tuple[int, int, int]:
        """Of the restored image: (bands, H, W)."""
        return (
            self.groups * self.tiling.channels_out,
            self.height_px * self.scale,
            self.width_px * self.scale,
        )

    @property
    def tile_shape(self) -> tuple[int, int]:
        """Rows and columns of pixels of every tile."""
        return self.rows[0].stop - self.rows[0].start, self.columns[0].stop - self.columns[0].start

    @property
    def row_tiles(self) -> int:
        """Tiles of one row of tiles, those of all groups of bands."""
        return len(self.columns) * self.groups

    @property
    def tiles(self) -> int:
        """All tiles of the image: windows that the network sees."""
        return len(self.rows) * self.row_tiles

    @property
    def work_factor(self) -> float:
        """Pixels that the network sees over pixels of the image."""
        window_px = sum(r.stop - r.start for r in self.rows) * sum(
            c.stop - c.start for c in self.columns
        )
        return window_px / (self.height_px * self.width_px)

    @property
    def strip_rows_px(self) -> int:
        """Most rows that are read at once: a tile's, and those that missing
        pixels are filled from.
        """
        return min(self.tile_shape[0] + 2 * self.radius_px, self.height_px)

    @property
    def halo_words(self) -> str:
        """The halo, and whether seams are exact with it."""
        if self.halo_px >= self.radius_px:
            return f"{self.halo_px} px (exact)"
        return f"{self.halo_px} px (seams: exact is {self.radius_px})"

    @property
    def sentence(self) -> str:
        """How the image is cut, in one sentence for the user."""
        bands = f", each of {self.bands} bands by itself" if self.groups > 1 else ""
        bands = f", {self.bands} bands together" if self.tiling.channels_in > 1 else bands
        larger = f", {self.scale} times as large" if self.scale > 1 else ""
        rows_px, columns_px = self.tile_shape
        tiles = "1 tile" if self.tiles == 1 else f"{self.tiles} tiles"
        return (
            f"plan: {self.width_px} x {self.height_px} pixels{bands}; {tiles} of {columns_px} x "
            f"{rows_px}, "
            f"halo {self.halo_words}, work factor {self.work_factor:.2f}{larger}"
        )


def plan_for(network: Network, shape: tuple[int, int, int], tiles: Tiles) -> Plan:
    """Return how an image of `shape` (bands, H, W) is cut for a network."""
    tiling = network.tiling
    _, height_px, width_px = shape
    if tiling.fixed_px is not None and (
        tiling.fixed_px != tiles.side_px or min(shape[1:]) < tiling.fixed_px
    ):
        raise OptionError(
            f"`tile` must be {tiling.fixed_px} px, the size to which the network is fixed, and the "
            f"image at least as large, got {tiles.side_px} px and an image of {width_px} x "
            f"{height_px} pixels. Use a network with free sizes."
        )
    return make_plan(shape, tiles.side_px, parse_halo(tiles.halo, tiling.halo_px), tiling)


def make_plan(shape: tuple[int, ...], tile_px: int, halo_px: int, tiling: Tiling) -> Plan:
    """The plan of an image of `shape` (bands, H, W).

    Tiles are as even as can be, of at most `tile_px` a side; of just that where the network is
    fixed to it.
    """
    bands, height_px, width_px = shape
    _require_fit(bands, halo_px, tiling)

    def side(size_px: int) -> tuple[Span, ...]:
        alignment_px = tiling.alignment_px
        longest_px = (
            even_side_px(size_px, tile_px, halo_px, alignment_px)
            if tiling.fixed_px is None
            else tile_px
        )
        return tuple(plan_side(size_px, longest_px, halo_px, alignment_px, tiling.min_side_px))

    return Plan(
        bands, height_px, width_px, tile_px, halo_px, tiling, side(height_px), side(width_px)
    )


def _require_fit(bands: int, halo_px: int, tiling: Tiling) -> None:
    """That a network can restore an image of so many bands, with such a halo."""
    if tiling.scale.denominator != 1:
        raise ModelError(
            "The network's result must have the size of the image or a multiple of it, but it has "
            f"{tiling.scale} of it. Add the layers that enlarge the result to the network."
        )
    if tiling.channels_in not in (1, bands):
        raise OptionError(
            f"The network restores {tiling.channels_in} bands together, but the number of bands of "
            f"the image is {bands}. Select bands, or use another network."
        )
    if halo_px % tiling.alignment_px:
        raise OptionError(
            f"`halo` must be a multiple of {tiling.alignment_px} px, after which the strides of "
            f"the network repeat, got {halo_px} px. A halo of {tiling.halo_px} px is exact for "
            "this network."
        )
