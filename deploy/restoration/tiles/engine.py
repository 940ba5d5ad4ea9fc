"""Restore a tile with a network, the description of an image, and the two steps around the network.

`Restorer.read` reads a strip of rows from a `Source`. `Restorer.tile` runs the network on one tile
of it, at each exposure that its pixels need. `Restorer.finish` makes the restored pixels agree with
the raw ones and stores them. `restoration.tiles.rows` calls these for all tiles of an image.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from beers_deploy.model.blocks import Placed
from beers_deploy.model.consistency import RAW_REACH_PX, REACH_PX, Consistency
from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.full_scale import remedy_outside
from beers_deploy.model.raster.source import Source
from beers_deploy.profiles.errors import ImageError
from beers_deploy.quant.tiling.receptive_field import Tiling
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.plan import Span
from beers_deploy.restoration.tiles.exposures import ExposedNetwork
from beers_deploy.restoration.tiles.missing import fill_from_nearest

NAME = "The image"
"""The name of an image that has no file, in messages."""

Window = tuple[slice, slice, slice]
"""Bands, rows and columns of an array."""


class Tile(NamedTuple):
    """The retained pixels of a tile, (bands, h, w), and their statistics.

    From `Restorer.tile` the pixels are float32, NaN where a pixel is missing. From
    `Restorer.finish` they are as stored.
    """

    pixels: np.ndarray
    tally: Tally


@dataclass(frozen=True)
class Strip:
    """Rows of an image from `top` on: `pixels` (bands, rows, width) as stored, and which of them
    are missing.

    `missing` is bool of the same shape, or None if no pixel is missing. `above` is True if a known
    pixel is above full scale. `left` is the first column, if the strip does not begin at the
    image's border.
    """

    top: int
    pixels: np.ndarray
    missing: np.ndarray | None
    above: bool = False
    left: int = 0

    def inner_window(self, bands: slice, rows: Span, columns: Span) -> Window:
        """Return the window of these arrays that contains the retained part of a tile."""
        down = slice(rows.keep_start - self.top, rows.keep_stop - self.top)
        return bands, down, slice(columns.keep_start - self.left, columns.keep_stop - self.left)


@dataclass(frozen=True)
class Restorer:
    """Restores stored pixels, given a network and the description of an image.

    Attributes:
        raster: the description of the image.
        networks: the network at its exposures; one for all groups of bands, or one for each.
        full_scale: the pixel value that is 1.0 to the network.
        tiling: the network's tiling geometry. Missing pixels are filled from no farther away than
            its halo. Pixels beyond that, filled or not, do not influence a known pixel.
        name: of the image, for messages.
        clips: if True, values above full scale are clipped and counted; else they are an error.
        consistency: the consistency step, one for all bands or one for each; empty if it is
            omitted, None for a band without it.
    """

    raster: Raster
    networks: tuple[ExposedNetwork, ...]
    full_scale: float
    tiling: Tiling
    name: str = NAME
    clips: bool = False
    consistency: tuple[Consistency | None, ...] = ()

    @property
    def reach_px(self) -> int:
        """The number of restored pixels that `finish` needs around those that it retains."""
        return REACH_PX if self.consistency else 0

    @property
    def margin_px(self) -> int:
        """The number of raw pixels that are read around the windows of tiles."""
        fill_px = self.raster.fill_margin_px(self.tiling.halo_px)
        return max(fill_px, RAW_REACH_PX if self.consistency else 0)

    def read(self, source: Source, start: int, stop: int) -> Strip:
        """Read the strip that tiles from row `start` to `stop` (excluded) need."""
        start = max(start - self.margin_px, 0)
        stop = min(stop + self.margin_px, self.raster.height_px)
        return checked_strip(
            self.raster, start, source.read(start, stop), self.full_scale, self.name, self.clips
        )

    def tile(self, strip: Strip, group: int, rows: Span, columns: Span) -> Tile:
        """Run the network of one group of bands on the tile that reads `rows` and `columns`.

        A tile of missing pixels is not run.
        """
        bands = self._bands(group)
        missing = self._missing(strip, bands, rows, columns)
        if missing is not None and missing.all():
            # The network would restore nothing but what fills missing pixels.
            return Tile(np.full(missing.shape, np.nan, np.float32), Tally())
        network = self.networks[group % len(self.networks)]
        window = self._window(strip, bands, rows, columns)
        inner = _within(rows), _within(columns)
        restored = network.restore(window, self.full_scale, inner, self.tiling)
        tally = Tally(tiles=1, runs=restored.runs, brightened=restored.brightened)
        pixels = restored.pixels
        if missing is not None:
            pixels = np.where(missing, np.float32(np.nan), pixels)
        return Tile(pixels, tally)

    def finish(
        self,
        strip: Strip,
        restored: np.ndarray,
        at: tuple[int, int],
        group: int,
        rows: Span,
        columns: Span,
    ) -> Tile:
        """Apply the consistency step and store the retained pixels of a tile.

        Args:
            strip: the raw rows around the tile.
            restored: the result of `tile`, (bands, h, w), with `reach_px` pixels around the
                retained ones.
            at: row and column in the image of its first pixel.
            group: the group of bands.
            rows: the rows of the tile, of which the retained ones are stored.
            columns: likewise.
        """
        scale = int(self.tiling.scale)
        bands = self._bands(group)
        down = slice((rows.keep_start - at[0]) * scale, (rows.keep_stop - at[0]) * scale)
        across = slice((columns.keep_start - at[1]) * scale, (columns.keep_stop - at[1]) * scale)
        missing = self._missing(strip, bands, rows, columns)
        if missing is not None and missing.all():
            return Tile(self._unrestored(strip, missing, bands, rows, columns), Tally())
        network_pixels = pixels = restored[:, down, across]
        if self.consistency:
            change = self._change(strip, restored, at, bands, rows, columns)
            pixels = np.clip(network_pixels + change, 0, np.float32(self.full_scale))
        inner_window = strip.inner_window(bands, rows, columns)
        valid_raw = None if strip.missing is None else ~strip.missing[inner_window]
        raw = strip.pixels[inner_window].astype(np.float64) / self.full_scale
        valid = None if missing is None else ~missing
        tally = Tally.of(raw, self._shares(pixels), valid_raw, valid)
        if self.consistency:
            squared = float(
                np.nansum(np.square((pixels - network_pixels) / self.full_scale), dtype=np.float64)
            )
            tally = tally.changed_from(
                Tally.of(raw, self._shares(network_pixels), valid_raw, valid), squared
            )
        result = as_stored(self.raster, np.nan_to_num(pixels), self.full_scale)
        if missing is not None:
            result = np.where(
                missing, self._unrestored(strip, missing, bands, rows, columns), result
            )
        return Tile(result, tally)

    def _shares(self, pixels: np.ndarray) -> np.ndarray:
        """Return pixels in shares of full scale, with missing ones 0."""
        return np.asarray(np.nan_to_num(pixels).astype(np.float64) / self.full_scale)

    def _change(
        self,
        strip: Strip,
        restored: np.ndarray,
        at: tuple[int, int],
        bands: slice,
        rows: Span,
        columns: Span,
    ) -> np.ndarray:
        """Return the correction of the consistency step for the retained pixels, (bands, h, w)."""
        top = max(rows.keep_start - RAW_REACH_PX, 0)
        left = max(columns.keep_start - RAW_REACH_PX, 0)
        down = slice(top - strip.top, rows.keep_stop + RAW_REACH_PX - strip.top)
        across = slice(left - strip.left, columns.keep_stop + RAW_REACH_PX - strip.left)
        raw = strip.pixels[bands, down, across].astype(np.float32)
        if strip.missing is not None:
            # The step gives the blocks of missing pixels a weight of 0, and 0 times NaN is NaN.
            raw[strip.missing[bands, down, across]] = 0
        sides = (
            Placed(self.raster.height_px, at[0], rows.keep_start, rows.keep_stop),
            Placed(self.raster.width_px, at[1], columns.keep_start, columns.keep_stop),
        )
        steps = [
            self.consistency[band % len(self.consistency)]
            for band in range(bands.start, bands.stop)
        ]
        change = np.zeros(
            (len(steps), *(placed.keep_stop - placed.keep_start for placed in sides)), np.float32
        )
        for number, step in enumerate(steps):
            if step is not None:
                change[number] = step.correction(raw[number], restored[number], *sides, (top, left))
        return change

    def _bands(self, group: int) -> slice:
        return slice(group * self.tiling.channels_in, (group + 1) * self.tiling.channels_in)

    def _missing(self, strip: Strip, bands: slice, rows: Span, columns: Span) -> np.ndarray | None:
        """Return a mask of the retained pixels that are missing, of the restored shape, or None if
        there are none.

        If a network computes other bands from several, a pixel is missing if it is missing in any
        of them.
        """
        if strip.missing is None:
            return None
        missing = strip.missing[strip.inner_window(bands, rows, columns)]
        tiling = self.tiling
        if tiling.channels_in != tiling.channels_out:
            missing = np.repeat(missing.any(axis=0, keepdims=True), tiling.channels_out, axis=0)
        return _enlarged(missing, int(tiling.scale))

    def _unrestored(
        self, strip: Strip, missing: np.ndarray, bands: slice, rows: Span, columns: Span
    ) -> np.ndarray:
        """Return the values that missing pixels are stored as: unchanged, or the nodata value if
        bands do not correspond.
        """
        tiling = self.tiling
        if tiling.channels_in != tiling.channels_out:
            none = np.nan if self.raster.out_dtype.kind == "f" else 0
            blank = none if self.raster.nodata is None else self.raster.nodata
            return np.full(missing.shape, blank, self.raster.out_dtype)
        stored = strip.pixels[strip.inner_window(bands, rows, columns)].astype(
            self.raster.out_dtype
        )
        return _enlarged(stored, int(tiling.scale))

    def _window(self, strip: Strip, bands: slice, rows: Span, columns: Span) -> np.ndarray:
        """Return the network's input for a tile, (bands, h, w), with missing pixels filled,
        extended to the lattice.
        """
        if strip.missing is None:
            down = slice(rows.start - strip.top, rows.stop - strip.top)
            window = strip.pixels[
                bands, down, columns.start - strip.left : columns.stop - strip.left
            ]
        else:
            window = self._filled(strip, strip.missing, bands, rows, columns)
        if strip.above:
            window = np.minimum(window, window.dtype.type(self.full_scale))
        lack = (
            rows.stop - rows.start - window.shape[1],
            columns.stop - columns.start - window.shape[2],
        )
        if not any(lack):
            return window
        # An image that is no multiple of the lattice is extended by its last row and column.
        return np.pad(window, ((0, 0), (0, lack[0]), (0, lack[1])), mode="edge")

    def _filled(
        self, strip: Strip, flags: np.ndarray, bands: slice, rows: Span, columns: Span
    ) -> np.ndarray:
        """Return a window with its missing pixels filled, as far as the image reaches."""
        radius_px = self.tiling.halo_px
        # A slice stops at the last pixel by itself, but a negative start would count from the
        # end.
        left = max(columns.start - strip.left - radius_px, 0)
        right = columns.stop - strip.left + radius_px
        top = max(rows.start - radius_px, 0) - strip.top
        bottom = rows.stop + radius_px - strip.top
        around = (bands, slice(max(top, 0), bottom), slice(left, right))
        planes = zip(strip.pixels[around], flags[around], strict=True)
        filled = np.stack(
            [fill_from_nearest(pixels, missing, radius_px) for pixels, missing in planes]
        )
        above = rows.start - strip.top - max(top, 0)
        aside = columns.start - strip.left - left
        return filled[
            :, above : above + rows.stop - rows.start, aside : aside + columns.stop - columns.start
        ]


def _enlarged(planes: np.ndarray, scale: int) -> np.ndarray:
    """Return (bands, h, w) with each pixel repeated `scale` times along both sides."""
    return planes if scale == 1 else planes.repeat(scale, axis=1).repeat(scale, axis=2)


def _within(span: Span) -> slice:
    return slice(span.keep_start - span.start, span.keep_stop - span.start)


def checked_strip(
    raster: Raster,
    top: int,
    pixels: np.ndarray,
    full_scale: float,
    name: str,
    clips: bool = False,
    left: int = 0,
) -> Strip:
    """Return rows from `top` on, (bands, rows, width) as stored, with the mask of missing pixels.
    Raise ImageError for values outside full scale.
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


def as_stored(raster: Raster, restored: np.ndarray, full_scale: float) -> np.ndarray:
    """Return restored pixels of any shape in the output's type, rounded if that is an integer.

    A restored pixel that equals the nodata value would read as missing, so it gets the adjacent
    number.
    """
    result = np.rint(restored) if raster.out_dtype.kind != "f" else restored
    result = result.astype(raster.out_dtype)
    nodata = raster.nodata
    # A restored pixel lies between 0 and full scale, so another nodata value is never hit.
    if nodata is not None and 0 <= nodata <= full_scale:
        result[result == result.dtype.type(nodata)] = _beside(raster, nodata, full_scale)
    return result


def _beside(raster: Raster, nodata: float, full_scale: float) -> float:
    if raster.out_dtype.kind != "f":
        return nodata + 1 if nodata + 1 <= full_scale else nodata - 1
    towards = full_scale if nodata < full_scale else 0
    return float(np.nextafter(np.float32(nodata), np.float32(towards)))
