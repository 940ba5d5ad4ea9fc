"""Restore a tile with a network, the description of an image, and the two steps around the network.

`Restorer.read` reads a strip of rows from a `Source`. `Restorer.tile` runs the network on one tile
of it, at each exposure that its pixels need. `Restorer.finish` makes the restored pixels agree with
the raw ones and stores them. `restoration.tiles.rows` calls these for all tiles of an image.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from beers_deploy.model.consistency.blocks import Placed
from beers_deploy.model.consistency.step import RAW_REACH_PX, REACH_PX, Consistency
from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.full_scale import remedy_outside
from beers_deploy.model.raster.source import Source
from beers_deploy.profiles.errors import ImageError
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.plan import Plan, Span, TilePlace
from beers_deploy.restoration.tiles.exposures import ExposedNetwork
from beers_deploy.restoration.tiles.missing_pixels import fill_from_nearest

NAME = "The image"
"""The name of an image that has no file, in messages."""

NEAR_NODATA = 2**-20
"""GDAL reads floats within 2**-21 of the nodata value, as a share of it, as missing."""
SMALLEST = float(np.finfo(np.float32).smallest_subnormal)

Window = tuple[slice, slice, slice]
"""Bands, rows and columns of an array."""


class Tile(NamedTuple):
    """The restored pixels of the retained part of a tile, and their statistics.

    Attributes:
        pixels: (bands, h, w). From `Restorer.tile` they are float32, NaN where a pixel is missing;
            from `Restorer.finish` they have the type and rounding of the output.
        tally: counts and sums over these pixels and their raw ones.
    """

    pixels: np.ndarray
    tally: Tally


@dataclass(frozen=True)
class Strip:
    """Rows of raw pixels of an image, which have been checked.

    Attributes:
        top: the row of the image at which the strip begins.
        pixels: the pixels (bands, rows, width) as stored.
        missing: mask of the missing pixels, bool of the same shape; None if none is missing.
        above: True if a pixel that is not missing is above full scale.
        left: the column of the image at which the strip begins; 0 for whole rows.
    """

    top: int
    pixels: np.ndarray
    missing: np.ndarray | None
    above: bool
    left: int


@dataclass(frozen=True)
class Restorer:
    """Restores the tiles of one image, with its networks and the steps around them.

    Attributes:
        raster: the description of the image.
        networks: the network for all groups of bands, or one for each group, with its versions for
            the exposures at which dark parts and strong edges are restored.
        full_scale: the pixel value that is 1.0 to the networks.
        plan: how the image is cut into tiles. Missing pixels are filled from pixels within the
            network's receptive radius. Pixels beyond that do not influence a known pixel.
        name: the name of the image, for messages.
        clips: True to clip and count values above full scale; False to raise an error for them.
        consistency: the step that makes the result agree with the raw image at low spatial
            frequencies, one for all bands or one for each; None for a band without it, empty if it
            is omitted.
    """

    raster: Raster
    networks: tuple[ExposedNetwork, ...]
    full_scale: float
    plan: Plan
    name: str = NAME
    clips: bool = False
    consistency: tuple[Consistency | None, ...] = ()

    @property
    def reach_px(self) -> int:
        """The number of restored pixels that `finish` needs on each side of a tile's retained part,
        because the consistency step reads them; 0 without that step.
        """
        return REACH_PX if self.consistency else 0

    @property
    def margin_px(self) -> int:
        """The raw pixels that are read on each side of a tile, for filling and consistency."""
        # The missing pixels of a tile are filled from those around it.
        fill_px = self.plan.radius_px if self.raster.may_miss else 0
        return max(fill_px, RAW_REACH_PX if self.consistency else 0)

    def read(self, source: Source, rows: Span) -> Strip:
        """Read and check the raw rows that one row of tiles needs, with the margin around them.

        Args:
            source: the image.
            rows: the rows that the row of tiles reads and retains.

        Raises:
            ImageError: a pixel is negative, infinite, or above full scale without `clips`.
        """
        start = max(rows.start - self.margin_px, 0)
        stop = min(rows.stop + self.margin_px, self.raster.height_px)
        return checked_strip(
            self.raster, start, source.read(start, stop), self.full_scale, self.name, self.clips
        )

    def tile(self, strip: Strip, place: TilePlace) -> Tile:
        """Run the network on one tile, at each exposure that its pixels need.

        The network does not run on a tile whose retained pixels are all missing.

        Args:
            strip: the raw rows, as `read` returns them.
            place: the group of bands, rows and columns of the tile.

        Returns:
            The retained pixels, float32, not rounded, NaN where missing, and the number of runs.

        Raises:
            ModelError: the network returns another shape than its file states.
            ImageError: the network returns NaN or infinite values.
        """
        missing = self._missing(strip, place)
        if missing is not None and missing.all():
            # All pixels would be filled in, so there is nothing to restore.
            return Tile(np.full(missing.shape, np.nan, np.float32), Tally())
        network = self.networks[place.group % len(self.networks)]
        window = self._window(strip, place)
        pixels, tally = network.restore(window, self.full_scale, place[1:], self.plan.tiling)
        if missing is not None:
            pixels = np.where(missing, np.float32(np.nan), pixels)
        return Tile(pixels, tally)

    def finish(
        self, strip: Strip, restored: np.ndarray, at: tuple[int, int], place: TilePlace
    ) -> Tile:
        """Apply the consistency step to a tile, and convert its pixels to the output's type.

        Args:
            strip: the raw rows around the tile, as `read` returns them.
            restored: pixels that `tile` returned for this tile and its neighbours, (bands, h, w):
                the retained part of this tile, and `reach_px` pixels around it within the image.
            at: the row and column of the image at which `restored` begins.
            place: the group of bands, rows and columns of the tile.

        Returns:
            The retained pixels in the type of the output, and their counts and sums. Missing pixels
            keep their raw value, or are nodata if the network returns other bands.
        """
        missing = self._missing(strip, place)
        window = self._retained(strip, place)
        raw = strip.pixels[window]
        if missing is not None and missing.all():
            return Tile(self._unrestored(raw, missing), Tally())
        down, across = (
            span.keep_slice(start, self.plan.scale)
            for span, start in zip(place[1:], at, strict=True)
        )
        valid_raw = None if strip.missing is None else ~strip.missing[window]
        valid = None if missing is None else ~missing
        raw_shares = raw.astype(np.float64) / self.full_scale

        def tally_of(values: np.ndarray) -> Tally:
            shares = values.astype(np.float64) / self.full_scale
            return Tally.of(raw_shares, shares, valid_raw, valid)

        network_pixels = restored[:, down, across]
        values = rounded(self.raster, network_pixels)
        tally = tally_of(values)
        if self.consistency:
            change = self._change(strip, restored, at, place)
            pixels = np.clip(network_pixels + change, 0, np.float32(self.full_scale))
            squares = np.square((pixels - network_pixels) / self.full_scale)
            squared = float(np.nansum(squares, dtype=np.float64))
            values = rounded(self.raster, pixels)
            # Doubts about a result refer to the network's output, before this step.
            tally = replace(
                tally_of(values),
                change_squared=squared,
                network_at_ends=tally.at_ends,
                network_after=tally.after,
                network_after_squared=tally.after_squared,
            )
        result = as_stored(self.raster, values, self.full_scale)
        if missing is not None:
            result = np.where(missing, self._unrestored(raw, missing), result)
        return Tile(result, tally)

    def _change(
        self, strip: Strip, restored: np.ndarray, at: tuple[int, int], place: TilePlace
    ) -> np.ndarray:
        """Return the correction of the consistency step for the retained pixels, (bands, h, w)."""
        _, rows, columns = place
        bands = self._bands(place)
        top = max(rows.keep_start - RAW_REACH_PX, 0)
        left = max(columns.keep_start - RAW_REACH_PX, 0)
        down = slice(top - strip.top, rows.keep_stop + RAW_REACH_PX - strip.top)
        across = slice(left - strip.left, columns.keep_stop + RAW_REACH_PX - strip.left)
        raw = strip.pixels[bands, down, across]
        if strip.missing is not None:
            # The step gives the blocks of missing pixels a weight of 0, and 0 times NaN is NaN.
            raw = np.where(strip.missing[bands, down, across], 0, raw)
        raw = raw.astype(np.float32)
        sides = (
            Placed(self.raster.height_px, at[0], rows.keep_start, rows.keep_stop),
            Placed(self.raster.width_px, at[1], columns.keep_start, columns.keep_stop),
        )
        shape = len(raw), rows.keep_stop - rows.keep_start, columns.keep_stop - columns.keep_start
        change = np.zeros(shape, np.float32)
        for number, result in enumerate(change):
            step = self.consistency[(bands.start + number) % len(self.consistency)]
            if step is not None:
                result[:] = step.correction(raw[number], restored[number], *sides, (top, left))
        return change

    def _bands(self, place: TilePlace) -> slice:
        count = self.plan.tiling.channels_in
        return slice(place.group * count, (place.group + 1) * count)

    def _retained(self, strip: Strip, place: TilePlace) -> Window:
        """Return the window of a strip's arrays that contains the retained part of a tile."""
        return (
            self._bands(place),
            place.rows.keep_slice(strip.top),
            place.columns.keep_slice(strip.left),
        )

    def _missing(self, strip: Strip, place: TilePlace) -> np.ndarray | None:
        """Return a mask of the restored pixels of a tile that are missing, (bands, h, w), or None
        if the strip has none.

        If a network computes other bands from several, a pixel is missing if it is missing in any
        of them.
        """
        if strip.missing is None:
            return None
        missing = strip.missing[self._retained(strip, place)]
        tiling = self.plan.tiling
        if tiling.channels_in != tiling.channels_out:
            missing = np.repeat(missing.any(axis=0, keepdims=True), tiling.channels_out, axis=0)
        return _enlarged(missing, self.plan.scale)

    def _unrestored(self, raw: np.ndarray, missing: np.ndarray) -> np.ndarray:
        """Return the values that missing pixels are stored as: unchanged, or the nodata value if
        bands do not correspond.
        """
        if self.plan.tiling.channels_in == self.plan.tiling.channels_out:
            return _enlarged(self.raster.unrestored(raw), self.plan.scale)
        none = np.nan if self.raster.out_dtype.kind == "f" else 0
        blank = none if self.raster.nodata is None else self.raster.nodata
        return self.raster.unrestored(np.full(missing.shape, blank))

    def _window(self, strip: Strip, place: TilePlace) -> np.ndarray:
        """Return the network's input for a tile, (bands, h, w), with missing pixels filled,
        extended to the lattice.
        """
        _, rows, columns = place
        reach_px = 0 if strip.missing is None else self.plan.radius_px
        # A slice stops at the last pixel by itself, but a negative start would count from the
        # end.
        top = max(rows.start - reach_px - strip.top, 0)
        left = max(columns.start - reach_px - strip.left, 0)
        down = slice(top, rows.stop + reach_px - strip.top)
        across = slice(left, columns.stop + reach_px - strip.left)
        around = self._bands(place), down, across
        window = strip.pixels[around]
        if strip.missing is not None:
            planes = zip(window, strip.missing[around], strict=True)
            window = np.stack([fill_from_nearest(*plane, reach_px) for plane in planes])
        above = rows.start - strip.top - top
        aside = columns.start - strip.left - left
        height = rows.stop - rows.start
        width = columns.stop - columns.start
        window = window[:, above : above + height, aside : aside + width]
        if strip.above:
            window = np.minimum(window, window.dtype.type(self.full_scale))
        lack = height - window.shape[1], width - window.shape[2]
        if not any(lack):
            return window
        # An image that is no multiple of the lattice is extended by its last row and column.
        return np.pad(window, ((0, 0), (0, lack[0]), (0, lack[1])), mode="edge")


def _enlarged(planes: np.ndarray, scale: int) -> np.ndarray:
    """Return (bands, h, w) with each pixel repeated `scale` times along both sides."""
    return planes if scale == 1 else planes.repeat(scale, axis=1).repeat(scale, axis=2)


def checked_strip(
    raster: Raster,
    top: int,
    pixels: np.ndarray,
    full_scale: float,
    name: str,
    clips: bool = False,
    left: int = 0,
) -> Strip:
    """Check that raw pixels are digital numbers, and return them with the mask of missing pixels.

    Args:
        raster: the description of the image, which states how missing pixels are marked.
        top: the row of the image at which `pixels` begins.
        pixels: (bands, rows, width) values as stored, masked or not.
        full_scale: the pixel value that is the largest digital number.
        name: the name of the image, for messages.
        clips: True to accept values above full scale, which are clipped later.
        left: the column of the image at which `pixels` begins; 0 for whole rows.

    Raises:
        ImageError: a valid pixel is below 0, infinite, or above full scale without `clips`.
    """
    missing = raster.missing(pixels) if raster.may_miss else None
    pixels = np.ma.getdata(pixels)
    missing = missing if missing is not None and missing.any() else None
    valid = True if missing is None else ~missing
    # Where no pixel is valid both are 0, which lies within full scale.
    low, high = (float(extreme(pixels, where=valid, initial=0)) for extreme in (np.min, np.max))
    if low < 0 or (high > full_scale and not (clips and np.isfinite(high))):
        too_large = (
            "Give the sensor's highest number as `full_scale`, or mark missing pixels as nodata."
        )
        raise ImageError(
            f"{name} has values from {low:g} to {high:g} in rows {top} to "
            f"{top + pixels.shape[1] - 1}, outside the digital numbers of 0 to {full_scale:g}. "
            f"{remedy_outside(low, high, too_large)}"
        )
    return Strip(top, pixels, missing, high > full_scale, left)


def rounded(raster: Raster, restored: np.ndarray) -> np.ndarray:
    """Return restored pixels as whole numbers, unless the output stores floats. Missing ones, which
    are NaN, become 0.
    """
    values = np.asarray(np.nan_to_num(restored))
    return values if raster.out_dtype.kind == "f" else np.rint(values)


def as_stored(raster: Raster, values: np.ndarray, full_scale: float) -> np.ndarray:
    """Convert restored pixels to the type of the output.

    A restored pixel that equals the nodata value, or of floats one that nearly does, would read as
    missing, so it gets an adjacent number.

    Args:
        raster: the description of the image, which states the output's type and the nodata value.
        values: pixels of any shape as `rounded` returns them, between 0 and full scale.
        full_scale: the pixel value that is full scale.
    """
    result = values.astype(raster.out_dtype)
    nodata = raster.nodata
    # A restored pixel lies between 0 and full scale, so another nodata value is never hit.
    if nodata is not None and 0 <= nodata <= full_scale:
        step = max(nodata * NEAR_NODATA, SMALLEST) if raster.out_dtype.kind == "f" else 1
        adjacent = nodata + step if nodata + step <= full_scale else nodata - step
        result[np.abs(values - np.float32(nodata)) < step] = adjacent
    return result
