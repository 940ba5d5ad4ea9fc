"""From pixels as stored to the kept pixels of a tile: missing ones are filled for the network, and put back."""

from dataclasses import dataclass

import numpy as np

from deploy.restore import Infer, restore_window
from deploy.swath.missing import fill_missing
from deploy.swath.raster import Raster
from deploy.swath.reader import Source
from deploy.tiling import Span
from model.scale import remedy_outside
from profiles.errors import ImageError

NAME = "image"
"""Of one that came without a file."""


@dataclass(frozen=True)
class Band:
    """Rows of an image from `top` on: (bands, rows, width) as stored, and which are missing (None: none is)."""

    top: int
    pixels: np.ndarray
    missing: np.ndarray | None


@dataclass(frozen=True)
class Restorer:
    """What turns a window into restored pixels.

    Attributes:
        raster: the image's facts.
        infer: the network.
        full_scale: the digital number that is 1.0 to the network.
        radius_px: the network's receptive radius; missing pixels are filled from no farther away, so what lies
            beyond, filled or not, is nothing that a known pixel sees.
        name: of the image, for messages.
    """

    raster: Raster
    infer: Infer
    full_scale: float
    radius_px: int
    name: str = NAME

    def read(self, source: Source, start: int, stop: int) -> Band:
        """The rows that a row of tiles needs.

        Raises:
            ImageError: unreadable rows, or values outside 0 to full scale.
        """
        margin = self.margin_px
        start, stop = max(start - margin, 0), min(stop + margin, self.raster.height_px)
        return self.band(start, source.read(start, stop))

    @property
    def margin_px(self) -> int:
        """How far around a window pixels are read that missing ones may be filled from."""
        return self.radius_px if self.raster.may_miss else 0

    def band(self, top: int, pixels: np.ndarray) -> Band:
        """Rows from `top` on, (bands, rows, width) as stored, with what they miss.

        Raises:
            ImageError: values outside 0 to full scale.
        """
        return checked_band(self.raster, top, pixels, self.full_scale, self.name)

    def kept(self, band: Band, plane: int, rows: Span, columns: Span) -> tuple[np.ndarray, int]:
        """The kept pixels of one tile as they are stored, and how many of them are known."""
        keep = (
            plane,
            slice(rows.keep_start - band.top, rows.keep_stop - band.top),
            slice(columns.keep_start, columns.keep_stop),
        )
        stored = band.pixels[keep].astype(self.raster.out_dtype)
        missing = None if band.missing is None else band.missing[keep]
        if missing is not None and missing.all():
            return stored, 0
        window = restore_window(self._window(band, plane, rows, columns), self.infer, self.full_scale)
        inner = window[_within(rows), _within(columns)]
        result = as_stored(self.raster, inner, self.full_scale)
        if missing is None:
            return result, result.size
        return np.where(missing, stored, result), int((~missing).sum())

    def _window(self, band: Band, plane: int, rows: Span, columns: Span) -> np.ndarray:
        """What the network sees of a tile, missing pixels filled."""
        if band.missing is None:
            return band.pixels[plane, rows.start - band.top : rows.stop - band.top, columns.start : columns.stop]
        left, right = max(columns.start - self.radius_px, 0), columns.stop + self.radius_px
        top, bottom = max(rows.start - self.radius_px, 0) - band.top, rows.stop + self.radius_px - band.top
        around = (plane, slice(top, bottom), slice(left, right))
        filled = fill_missing(band.pixels[around], band.missing[around], self.radius_px)
        above, aside = rows.start - band.top - top, columns.start - left
        return filled[above : above + rows.stop - rows.start, aside : aside + columns.stop - columns.start]


def checked_band(raster: Raster, top: int, pixels: np.ndarray, full_scale: float, name: str) -> Band:
    """Rows from `top` on, (bands, rows, width) as stored, with what they miss.

    Raises:
        ImageError: values outside 0 to full scale.
    """
    missing = raster.missing(pixels) if raster.may_miss else None
    band = Band(top, pixels, missing if missing is not None and missing.any() else None)
    known = True if band.missing is None else ~band.missing
    low, high = (float(extreme(band.pixels, where=known, initial=0)) for extreme in (np.min, np.max))
    if low < 0 or high > full_scale:
        remedy = "give the sensor's highest number as --full-scale, or mark missing pixels as nodata"
        raise ImageError(
            f"{name}, rows {band.top} to {band.top + band.pixels.shape[1] - 1}",
            expected=f"digital numbers of 0 to {full_scale:g}",
            got=f"values from {low:g} to {high:g}",
            remedy=remedy_outside(low, high, remedy),
        )
    return band


def as_stored(raster: Raster, restored: np.ndarray, full_scale: float) -> np.ndarray:
    """Rounded where the output holds integers; never the nodata value, which would read as missing."""
    result = np.rint(restored) if raster.out_dtype.kind == "u" else restored
    result = result.astype(raster.out_dtype)
    nodata = raster.nodata
    if nodata is not None and 0 <= nodata <= full_scale:
        result[result == result.dtype.type(nodata)] = _beside(raster, nodata, full_scale)
    return result


def _beside(raster: Raster, nodata: float, full_scale: float) -> float:
    if raster.out_dtype.kind == "u":
        return nodata + 1 if nodata + 1 <= full_scale else nodata - 1
    towards = full_scale if nodata < full_scale else 0
    return float(np.nextafter(np.float32(nodata), np.float32(towards)))


def _within(span: Span) -> slice:
    return slice(span.keep_start - span.start, span.keep_stop - span.start)
