"""Cut an image into tiles with exact seams, and compute the cost of that before the run.

A tile is read with a halo of `halo_px` pixels around its retained part. If the halo is the
network's receptive radius, the result is the same as for the whole image, bit for bit
(`quant.tiling`). For a network with strides, tiles begin and end at multiples of its
`alignment_px`. If the image is not such a multiple, the last tiles reach beyond it, and the image
is extended there by copies of its last row and column.
"""

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

from beers_deploy.network import Network
from beers_deploy.profiles.errors import ModelError, OptionError, counted, printable
from beers_deploy.profiles.figures import Figure, predicted
from beers_deploy.profiles.rounding import up_to_multiple
from beers_deploy.profiles.shipped import TILE_PX
from beers_deploy.quant.tiling.receptive_field import Tiling


@dataclass(frozen=True)
class Tiles:
    """The user's choice of how to cut an image into tiles, as the options of `restore` state it.

    Attributes:
        side_px: the longest side of a tile in pixels, halo included.
        halo: the context that is read around the retained part of a tile: a number of pixels as
            text, or 'exact' for the network's receptive radius, which leaves no seams.
    """

    side_px: int = TILE_PX
    halo: str = "exact"


def parse_halo(halo: str, radius_px: int) -> int:
    """Convert the user's option `halo` to a number of pixels.

    Args:
        halo: 'exact', or a whole number of pixels as text.
        radius_px: the network's receptive radius, which is the halo that 'exact' stands for.

    Raises:
        OptionError: the text is neither 'exact' nor a whole number.
    """
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
    """The extent of a tile along one side of the image, in image pixels (ends excluded).

    Attributes:
        start: the first pixel that the tile reads, halo included.
        stop: the end of the pixels that the tile reads. It may lie beyond the image, which is
            extended there to a multiple of the network's stride and to the network's shortest side.
        keep_start: the first pixel of the retained part, whose restored values are stored.
        keep_stop: the end of the retained part, at most the end of the image.
    """

    start: int
    stop: int
    keep_start: int
    keep_stop: int

    def keep_slice(self, origin: int = 0, scale: int = 1) -> slice:
        """Return the retained part as a slice of an array.

        Args:
            origin: the pixel of the image at which the array begins.
            scale: the number of pixels of the array per pixel of the image.
        """
        return slice((self.keep_start - origin) * scale, (self.keep_stop - origin) * scale)


class TilePlace(NamedTuple):
    """The place of a tile in an image.

    Attributes:
        group: the index, from 0, of the bands that the network restores jointly. A network of one
            band has one group for each band of the image.
        rows: the rows that the tile reads and retains.
        columns: the columns that the tile reads and retains.
    """

    group: int
    rows: Span
    columns: Span


def plan_side(
    size_px: int, tile_px: int, halo_px: int, alignment_px: int = 1, min_side_px: int = 1
) -> list[Span]:
    """Cut one side of an image into spans of equal length, whose retained parts cover the side.

    A side that is shorter than a tile is one span.

    Args:
        size_px: the length of this side of the image.
        tile_px: the longest side of a tile; it is rounded down to a multiple of `alignment_px`.
        halo_px: the context around the retained part; a multiple of `alignment_px`.
        alignment_px: the multiple at which spans begin and end, because the strides of the network
            repeat after this number of pixels; 1 without strides.
        min_side_px: the shortest side that the network accepts. A shorter image is extended to it.

    Raises:
        OptionError: the halo is negative, or a tile is too small for the network, or to retain
            `alignment_px` pixels between two halos.
    """
    smallest_px = max(2 * halo_px + alignment_px, up_to_multiple(min_side_px, alignment_px))
    if tile_px < smallest_px or halo_px < 0:
        least = f", at least {smallest_px} px" if smallest_px > 2 * halo_px + 1 else ""
        raise OptionError(
            f"`tile` must be more than twice the halo of {halo_px} px{least}, got {tile_px} px. "
            "Use larger tiles or a smaller halo."
        )
    # The strides of a network sample other pixels in a tile that begins or ends off the lattice.
    extended_px = up_to_multiple(max(size_px, min_side_px), alignment_px)
    side_px = min(tile_px // alignment_px * alignment_px, extended_px)
    spans = []
    done = 0
    # All spans have the same length, so the last one is moved inward instead of cut. Spans are read
    # from the image and its extension, but their retained parts end with the image.
    while done < size_px:
        start = min(max(done - halo_px, 0), extended_px - side_px)
        stop = start + side_px
        keep_stop = size_px if stop == extended_px else stop - halo_px
        spans.append(Span(start, stop, done, keep_stop))
        done = keep_stop
    return spans


def even_side_px(
    size_px: int, tile_px: int, halo_px: int, alignment_px: int = 1, min_side_px: int = 1
) -> int:
    """Return the shortest side of a tile, in pixels, with which there are as many tiles as with
    `tile_px`.

    Args:
        size_px: the length of one side of the image.
        tile_px: the longest side that a tile may have.
        halo_px: the context around the retained part of a tile.
        alignment_px: the multiple at which tiles begin and end; 1 without strides.
        min_side_px: the shortest side that the network accepts.

    Raises:
        OptionError: tiles of `tile_px` are too small for the halo or for the network.
    """
    # A last tile that is moved inward computes pixels twice; even tiles compute fewer.
    count = len(plan_side(size_px, tile_px, halo_px, alignment_px, min_side_px))
    even_px = -(-(up_to_multiple(size_px, alignment_px) + 2 * halo_px * (count - 1)) // count)
    return max(up_to_multiple(max(even_px, min_side_px), alignment_px), 2 * halo_px + alignment_px)


@dataclass(frozen=True)
class Plan:
    """The rows and columns of tiles into which one image is cut for one network.

    Attributes:
        bands: the number of bands of the image. Each is cut in the same way and restored
            separately, or jointly if the network reads several.
        height_px: the height of the image.
        width_px: the width of the image.
        tile_px: the longest side that a tile may have.
        halo_px: the context that is read around the retained part of a tile.
        tiling: the network's tiling geometry: its receptive radius, stride, scale and bands.
        rows: the rows of tiles, from top to bottom.
        columns: the columns of tiles, from left to right.
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
        """The network's receptive radius. With a halo of at least this size the seams are exact."""
        return self.tiling.halo_px

    @property
    def scale(self) -> int:
        """The number of pixels of the restored image per pixel of the image, along either side."""
        return int(self.tiling.scale)

    @property
    def groups(self) -> int:
        """The number of groups of bands: 1 if the network restores all bands jointly, else one
        group for each band.
        """
        return self.bands // self.tiling.channels_in

    @property
    def out_shape(self) -> tuple[int, int, int]:
        """The shape of the restored image, (bands, H, W), with the bands that the network returns
        and its scale applied to both sides.
        """
        return (
            self.groups * self.tiling.channels_out,
            self.height_px * self.scale,
            self.width_px * self.scale,
        )

    @property
    def tile_shape(self) -> tuple[int, int]:
        """The height and width in pixels that every tile reads, halo included."""
        return self.rows[0].stop - self.rows[0].start, self.columns[0].stop - self.columns[0].start

    def places(self, row: Span) -> list[TilePlace]:
        """Return the tiles of one row of tiles in the order in which they are restored: group of
        bands by group, each from left to right.

        Args:
            row: one of `rows`.
        """
        across = product(range(self.groups), self.columns)
        return [TilePlace(group, row, column) for group, column in across]

    @property
    def row_tiles(self) -> int:
        """The number of tiles in one row of tiles, over all groups of bands."""
        return len(self.columns) * self.groups

    @property
    def tiles(self) -> int:
        """The number of tiles of the image, over all groups of bands."""
        return len(self.rows) * self.row_tiles

    @property
    def work_factor(self) -> float:
        """The number of pixels that the network reads in all tiles, halos included, over the number
        of pixels of the image: 1.2 means 20 % more work than without tiles.
        """
        window_px = sum(r.stop - r.start for r in self.rows) * sum(
            c.stop - c.start for c in self.columns
        )
        return window_px / (self.height_px * self.width_px)

    @property
    def figures(self) -> dict[str, Figure]:
        """The figures 'tiles' and 'work factor' for the results of a run, by name. They are known
        in advance, not measured.
        """
        numbers = {"tiles": self.tiles, "work factor": self.work_factor}
        source = "arithmetic on the plan of tiles"
        return {
            key: predicted(number, "1", (number, number), source) for key, number in numbers.items()
        }

    @property
    def strip_rows_px(self) -> int:
        """The largest number of rows of pixels that are read from the image at once: the rows of a
        tile, and a receptive radius above and below it, from which missing pixels are filled.
        """
        return min(self.tile_shape[0] + 2 * self.radius_px, self.height_px)

    @property
    def halo_words(self) -> str:
        """The halo in pixels as text, with a note if it is smaller than the receptive radius, so
        that seams between tiles are not exact.
        """
        if self.halo_px >= self.radius_px or len(self.rows) == len(self.columns) == 1:
            return f"{self.halo_px} px (exact)"
        if self.tiling.reads_whole:
            return f"{self.halo_px} px (seams: the network reads its whole tile)"
        return f"{self.halo_px} px (seams: exact is {self.radius_px})"

    @property
    def sentence(self) -> str:
        """The sentence that a run logs on its tiles: number, size, halo and work factor."""
        bands = f", {self.bands} bands" if self.bands > 1 else ""
        larger = f", {self.scale} times as large" if self.scale > 1 else ""
        rows_px, columns_px = self.tile_shape
        return (
            f"plan: {self.width_px} x {self.height_px} pixels{bands}; "
            f"{counted(self.tiles, 'tile')} of {columns_px} x {rows_px}, "
            f"halo {self.halo_words}, work factor {self.work_factor:.2f}{larger}"
        )


def plan_for(network: Network, shape: tuple[int, int, int], tiles: Tiles) -> Plan:
    """Plan the tiles of an image for a network, as the user's options state them.

    Args:
        network: the network that restores the image.
        shape: the shape of the image, (bands, H, W).
        tiles: the size of tiles and the halo that the user chooses.

    Raises:
        OptionError: the tile size, the halo or the number of bands does not fit the network, or the
            network is fixed to one tile size, and `tiles` or the image is smaller, or it reads its
            whole tile, the image is larger and no halo is given.
        ModelError: the network returns an image whose size is no multiple of the image's.
    """
    tiling = network.geometry
    _, height_px, width_px = shape
    tile_px = tiling.fixed_px or tiles.side_px
    if tiling.fixed_px is not None and tile_px > min(tiles.side_px, height_px, width_px):
        raise OptionError(
            f"The network is fixed to tiles of {tile_px} px, but the image has {width_px} x "
            f"{height_px} pixels and `tile` is {tiles.side_px} px. Neither may be smaller: give a "
            "larger image or `tile`, or export the network for any size."
        )
    is_one_tile = shape[1:] == (tiling.fixed_px, tiling.fixed_px)
    if not tiling.reads_whole or tiles.halo.isdecimal():
        halo_px = parse_halo(tiles.halo, tiling.halo_px)
    elif tiles.halo == "exact" and is_one_tile:
        halo_px = 0
    else:
        raise OptionError(
            f"{tiling.reads_whole} To restore tiles independently, with seams between them, "
            "give `halo` a number of pixels, such as 8."
        )
    return make_plan(shape, tile_px, halo_px, tiling)


def make_plan(shape: tuple[int, ...], tile_px: int, halo_px: int, tiling: Tiling) -> Plan:
    """Plan the tiles of an image, given a halo in pixels and the geometry of a network.

    Tiles are as even as possible, with at most `tile_px` a side. If the network is fixed to a tile
    size, they have exactly the size `tile_px`.

    Args:
        shape: the shape of the image, (bands, H, W).
        tile_px: the longest side of a tile, or the side that the network is fixed to.
        halo_px: the context that is read around the retained part of a tile.
        tiling: the network's tiling geometry.

    Raises:
        OptionError: the halo is no multiple of the network's stride or too large for the tile, or
            the network reads another number of bands.
        ModelError: the network returns an image whose size is no multiple of the image's.
    """
    bands, height_px, width_px = shape
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

    def side(size_px: int) -> tuple[Span, ...]:
        alignment_px = tiling.alignment_px
        longest_px = (
            even_side_px(size_px, tile_px, halo_px, alignment_px, tiling.min_side_px)
            if tiling.fixed_px is None
            else tile_px
        )
        return tuple(plan_side(size_px, longest_px, halo_px, alignment_px, tiling.min_side_px))

    return Plan(
        bands, height_px, width_px, tile_px, halo_px, tiling, side(height_px), side(width_px)
    )
