"""The one tile loop: whatever restores an image by a network, from a file or an array, runs what stands here.

A `Source` gives a strip of rows, `Restorer.tile` restores one tile of it, and `restore_rows` yields rows of tiles in
order: the next strip is read ahead, and several tiles are in work at a time. `restore_array`, `restore_floats` and
`restore_dn` gather the rows of an image in memory; `deploy.restoration.run` writes those of a file.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import onnx

from beers_deploy.model.io.images import remedy_outside
from beers_deploy.profiles.errors import ImageError, ModelError
from beers_deploy.profiles.sensor import MAX_DN
from beers_deploy.profiles.target import TILE_PX
from beers_deploy.quant.tiling.walk import Tiling, tiling_of
from beers_deploy.quant.untrusted import times
from beers_deploy.restoration.options import Runtime
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.plan import Plan, Span, make_plan
from beers_deploy.restoration.radiometry import require_room
from beers_deploy.restoration.runtime import Infer, open_runtime
from beers_deploy.restoration.source import ArraySource, Raster, Source

NAME = "image"
"""What messages call an image that came without a file."""

Restore = Callable[[np.ndarray], np.ndarray]
"""Degraded digital numbers (H, W) float32 to restored ones."""
Window = tuple[slice, slice, slice]
"""Bands, rows and columns of an array."""


class Tile(NamedTuple):
    """The kept pixels of a tile, (bands, h, w) restored and as stored, and what was seen of them."""

    pixels: np.ndarray
    tally: Tally


@dataclass(frozen=True)
class Strip:
    """Rows of an image from `top` on: `pixels` (bands, rows, width) as stored, and which are missing.

    `missing` is bool of the same shape, or None where no pixel is missing; `above` says whether a known pixel is
    above full scale.
    """

    top: int
    pixels: np.ndarray
    missing: np.ndarray | None
    above: bool = False

    def kept(self, bands: slice, rows: Span, columns: Span) -> Window:
        """Where in these arrays lies what is kept of a tile."""
        down = slice(rows.keep_start - self.top, rows.keep_stop - self.top)
        return bands, down, slice(columns.keep_start, columns.keep_stop)


class RestoredRow(NamedTuple):
    """A row of tiles: its `span` in the image, restored `pixels` (bands, rows, width), and what was seen of them."""

    span: Span
    pixels: np.ndarray
    tally: Tally


@dataclass(frozen=True)
class Restorer:
    """A network and an image's facts: what turns stored pixels into restored ones.

    Attributes:
        raster: the image's facts.
        infer: the network.
        full_scale: the pixel value that is 1.0 to the network.
        tiling: how the network meets an image; missing pixels are filled from no farther away than its halo, so what
            lies beyond, filled or not, is nothing that a known pixel sees.
        name: of the image, for messages.
        clips: whether values above full scale are clipped and counted; else they are an error.
        others: the networks of the bands behind the first, where each has its own.
    """

    raster: Raster
    infer: Infer
    full_scale: float
    tiling: Tiling
    name: str = NAME
    clips: bool = False
    others: tuple[Infer, ...] = ()

    def __post_init__(self) -> None:
        require_room(self.raster, self.full_scale)

    def read(self, source: Source, start: int, stop: int) -> Strip:
        """The strip that tiles from row `start` to `stop` (excluded) need."""
        margin_px = self.raster.fill_margin_px(self.tiling.halo_px)
        start, stop = max(start - margin_px, 0), min(stop + margin_px, self.raster.height_px)
        return checked_strip(self.raster, start, source.read(start, stop), self.full_scale, self.name, self.clips)

    def tile(self, strip: Strip, group: int, rows: Span, columns: Span) -> Tile:
        """The tile of one group of bands that reads `rows` and `columns`; one of missing pixels is not inferred."""
        bands = slice(group * self.tiling.channels_in, (group + 1) * self.tiling.channels_in)
        unknown = self._unknown(strip, bands, rows, columns)
        if unknown is not None and unknown[1].all():
            return Tile(unknown[0], Tally())
        infer = self.others[group - 1] if self.others and group else self.infer
        window = restore_window(self._window(strip, bands, rows, columns), infer, self.full_scale)
        self._require_shape(window, rows, columns)
        restored = window[:, self._within(rows), self._within(columns)]
        result = as_stored(self.raster, restored, self.full_scale)
        known = None if unknown is None else ~unknown[1]
        tally = self._tally(strip, strip.kept(bands, rows, columns), restored, known)
        return Tile(result if unknown is None else np.where(unknown[1], unknown[0], result), tally)

    def _tally(self, strip: Strip, kept: Window, restored: np.ndarray, known: np.ndarray | None) -> Tally:
        """What is seen of a tile's kept pixels, and of their results where `known`; None for all."""
        seen = None if strip.missing is None else ~strip.missing[kept]
        stored = strip.pixels[kept].astype(np.float64) / self.full_scale
        return Tally.of(stored, restored.astype(np.float64) / self.full_scale, seen, known)

    def _unknown(self, strip: Strip, bands: slice, rows: Span, columns: Span) -> tuple[np.ndarray, np.ndarray] | None:
        """What the kept pixels of a tile stay where they are missing, and where; of the restored shape, as stored.

        Where a network makes other bands of several, a pixel is missing that is missing in any.
        """
        if strip.missing is None:
            return None
        kept = strip.kept(bands, rows, columns)
        stored, missing = strip.pixels[kept].astype(self.raster.out_dtype), strip.missing[kept]
        tiling, scale = self.tiling, int(self.tiling.scale)
        if tiling.channels_in != tiling.channels_out:
            none = np.nan if stored.dtype.kind == "f" else 0
            blank = none if self.raster.nodata is None else self.raster.nodata
            missing = np.repeat(missing.any(axis=0, keepdims=True), tiling.channels_out, axis=0)
            stored = np.full(missing.shape, blank, stored.dtype)
        if scale > 1:
            stored, missing = (each.repeat(scale, axis=1).repeat(scale, axis=2) for each in (stored, missing))
        return stored, missing

    def _window(self, strip: Strip, bands: slice, rows: Span, columns: Span) -> np.ndarray:
        """What the network sees of a tile, (bands, h, w): missing pixels filled, extended to the lattice."""
        if strip.missing is None:
            down = slice(rows.start - strip.top, rows.stop - strip.top)
            window = strip.pixels[bands, down, columns.start : columns.stop]
        else:
            window = self._filled(strip, strip.missing, bands, rows, columns)
        if strip.above:
            window = np.minimum(window, window.dtype.type(self.full_scale))
        lack = rows.stop - rows.start - window.shape[1], columns.stop - columns.start - window.shape[2]
        return np.pad(window, ((0, 0), (0, lack[0]), (0, lack[1])), mode="edge") if any(lack) else window

    def _filled(self, strip: Strip, flags: np.ndarray, bands: slice, rows: Span, columns: Span) -> np.ndarray:
        """A window with its missing pixels filled, as far as the image goes."""
        radius_px = self.tiling.halo_px
        # Beyond the last pixel a slice ends by itself; before the first one it would begin at the other end.
        left, right = max(columns.start - radius_px, 0), columns.stop + radius_px
        top, bottom = max(rows.start - radius_px, 0) - strip.top, rows.stop + radius_px - strip.top
        around = (bands, slice(top, bottom), slice(left, right))
        planes = zip(strip.pixels[around], flags[around], strict=True)
        filled = np.stack([fill_from_nearest(pixels, missing, radius_px) for pixels, missing in planes])
        above, aside = rows.start - strip.top - top, columns.start - left
        return filled[:, above : above + rows.stop - rows.start, aside : aside + columns.stop - columns.start]

    def _within(self, span: Span) -> slice:
        scale = int(self.tiling.scale)
        return slice((span.keep_start - span.start) * scale, (span.keep_stop - span.start) * scale)

    def _require_shape(self, window: np.ndarray, rows: Span, columns: Span) -> None:
        scale = int(self.tiling.scale)
        sides = (rows.stop - rows.start) * scale, (columns.stop - columns.start) * scale
        if window.shape != (self.tiling.channels_out, *sides):
            expected = f"a result of {times((self.tiling.channels_out, *sides))}, as its file says"
            remedy = "export it for images of any size, or check its sizes"
            raise ModelError("ONNX model", expected=expected, got=times(window.shape), remedy=remedy)


def checked_strip(
    raster: Raster, top: int, pixels: np.ndarray, full_scale: float, name: str, clips: bool = False
) -> Strip:
    """Rows from `top` on, (bands, rows, width) as stored, and which of their pixels are missing."""
    missing, pixels = raster.missing(pixels) if raster.may_miss else None, np.ma.getdata(pixels)
    missing = missing if missing is not None and missing.any() else None
    known = True if missing is None else ~missing
    # Where nothing is known, 0 is taken for both, which is inside.
    low, high = (float(extreme(pixels, where=known, initial=0)) for extreme in (np.min, np.max))
    if low < 0 or (high > full_scale and not (clips and np.isfinite(high))):
        where = f"{name}, rows {top} to {top + pixels.shape[1] - 1}"
        remedy = "give the sensor's highest number as `full_scale`, or mark missing pixels as nodata"
        got, remedy = f"values from {low:g} to {high:g}", remedy_outside(low, high, remedy)
        raise ImageError(where, expected=f"digital numbers of 0 to {full_scale:g}", got=got, remedy=remedy)
    return Strip(top, pixels, missing, high > full_scale)


def fill_from_nearest(pixels: np.ndarray, missing: np.ndarray, reach_px: int) -> np.ndarray:
    """(h, w) pixels where each `missing` one is a copy of a known one at most `reach_px` rows and columns away.

    The nearest known pixel of the row, then the nearest filled one of the column; 0 where there is none in reach. So
    a filled pixel depends on nothing farther away, and a window gives just what the whole image gives.
    """
    filled, missing = _along_rows(pixels, missing, reach_px)
    filled, missing = _along_rows(filled.T, missing.T, reach_px)
    return np.asarray(np.where(missing, 0, filled).T)


def _along_rows(pixels: np.ndarray, missing: np.ndarray, reach_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Filled pixels, and where none was in reach; of two at the same distance the left one is taken."""
    width = pixels.shape[1]
    far = width + reach_px + 1  # out of reach from every pixel: no known one on that side
    here = np.arange(width)
    left = np.maximum.accumulate(np.where(missing, -far, here), axis=1)
    right = np.minimum.accumulate(np.where(missing, 2 * far, here)[:, ::-1], axis=1)[:, ::-1]
    nearest = np.where(here - left <= right - here, left, right)
    out_of_reach = np.abs(nearest - here) > reach_px
    return np.take_along_axis(pixels, np.where(out_of_reach, here, nearest), axis=1), out_of_reach


def restore_window(dn: np.ndarray, infer: Infer, full_scale: float = MAX_DN) -> np.ndarray:
    """A window of digital numbers through the network: float32 in 0..full_scale, not rounded.

    Args:
        dn: (h, w) or (bands, h, w).
        infer: the network.
        full_scale: the number that is 1.0 to it.

    Returns:
        Of as many axes; of other bands and sizes where the network makes others.
    """
    bands = dn[None] if dn.ndim == 2 else dn
    image = np.ascontiguousarray(bands, dtype=np.float32)[None] / np.float32(full_scale)
    with np.errstate(over="ignore"):  # what overflows is refused
        restored = infer(image)[0] * np.float32(full_scale)
    if not np.isfinite(restored).all():
        raise ImageError("restored tile", expected="finite pixels", got="NaN", remedy="check the model with 'gate'")
    restored = np.clip(restored, 0, np.float32(full_scale))
    return np.asarray(restored[0] if dn.ndim == 2 else restored)


def as_stored(raster: Raster, restored: np.ndarray, full_scale: float) -> np.ndarray:
    """Restored pixels of any shape in the output's type: rounded where that is an integer.

    A restored pixel that falls on the nodata value, which would read as missing, takes the number beside it.
    """
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


def restore_rows(
    source: Source, plan: Plan, restorer: Restorer, rows: Sequence[Span], tick: Callable[[], None], at_once: int = 1
) -> Generator[RestoredRow, None, None]:
    """Restore rows of tiles in order, `at_once` tiles at a time; `tick` is called once a tile.

    A row is begun before the one before it is finished, so that no thread waits for the last tile of a row.
    """
    # A single reader, since a source keeps what it decoded for the rows before, for the next ones to take.
    with ThreadPoolExecutor(1) as reader, ThreadPoolExecutor(at_once) as pool:
        coming = [reader.submit(restorer.read, source, row.start, row.stop) for row in rows[:1]]
        begun: deque[tuple[Span, Iterator[Tile]]] = deque()
        try:
            for k, row in enumerate(rows):
                strip = coming.pop().result()
                coming += [reader.submit(restorer.read, source, nxt.start, nxt.stop) for nxt in rows[k + 1 : k + 2]]
                begun.append((row, _tiles(strip, row, plan, restorer, pool)))
                if len(begun) > 1:
                    yield _joined(*begun.popleft(), plan, restorer, tick)
            while begun:
                yield _joined(*begun.popleft(), plan, restorer, tick)
        finally:
            pool.shutdown(cancel_futures=True)  # or the tiles of two rows would still be restored after an error


def _tiles(strip: Strip, row: Span, plan: Plan, restorer: Restorer, pool: Executor) -> Iterator[Tile]:
    """The tiles of one row, in the order of `_places`."""
    return pool.map(lambda place: restorer.tile(strip, place[0], row, place[1]), _places(plan))


def _joined(
    row: Span, tiles: Iterable[Tile], plan: Plan, restorer: Restorer, tick: Callable[[], None]
) -> RestoredRow:
    bands, _, width_px = plan.out_shape
    shape = (bands, (row.keep_stop - row.keep_start) * plan.scale, width_px)
    result, tally = np.empty(shape, restorer.raster.out_dtype), Tally()
    count = plan.tiling.channels_out
    for (group, columns), tile in zip(_places(plan), tiles, strict=True):
        at = slice(columns.keep_start * plan.scale, columns.keep_stop * plan.scale)
        result[group * count : (group + 1) * count, :, at] = tile.pixels
        tally += tile.tally
        tick()
    return RestoredRow(row, result, tally)


def _places(plan: Plan) -> list[tuple[int, Span]]:
    return [(group, columns) for group in range(plan.groups) for columns in plan.columns]


def restore_array(
    source: Source, plan: Plan, restorer: Restorer, at_once: int = 1, look: Callable[[Tally], object] | None = None
) -> np.ndarray:
    """Restore all rows of an image: the plan's `out_shape` of the raster's `out_dtype`.

    Args:
        source: the image.
        plan: its tiles.
        restorer: its network.
        at_once: tiles in work at a time.
        look: is shown what was seen of all of it, and may refuse it.
    """
    result, tally = np.empty(plan.out_shape, restorer.raster.out_dtype), Tally()
    for row in restore_rows(source, plan, restorer, plan.rows, lambda: None, at_once):
        result[:, row.span.keep_start * plan.scale : row.span.keep_stop * plan.scale] = row.pixels
        tally += row.tally
    if look is not None:
        look(tally)
    return result


def restore_floats(dn: np.ndarray, infer: Infer, plan: Plan, max_dn: float = MAX_DN) -> np.ndarray:
    """Restore (H, W) digital numbers of 0 to `max_dn` to float32, not rounded: what `restore` writes of floats.

    NaN is a missing pixel, and stays.
    """
    if plan.out_shape != (1, *dn.shape):
        got, remedy = f"one of {times(plan.out_shape)}", "restore files with it, or arrays by beers_deploy.library"
        raise ModelError("ONNX model", expected=f"a result of {times(dn.shape)}", got=got, remedy=remedy)
    pixels = np.asarray(dn, np.float32)[None]
    _, height_px, width_px = pixels.shape
    raster = Raster(1, height_px, width_px, pixels.dtype)
    restorer = Restorer(raster, infer, float(max_dn), plan.tiling)
    return np.asarray(restore_array(ArraySource(pixels, raster), plan, restorer)[0])


def restore_dn(dn: np.ndarray, infer: Infer, plan: Plan, max_dn: float = MAX_DN) -> np.ndarray:
    """Restore (H, W) digital numbers of 0 to `max_dn` to whole ones, float32: what `restore` writes of integers."""
    return np.asarray(np.rint(restore_floats(dn, infer, plan, max_dn)))


def network_method(model: onnx.ModelProto, max_dn: int) -> Restore:
    """A network as a method: digital numbers of 0 to `max_dn` become whole ones, as `restore` writes them.

    Tiles are the default ones, or those the network is fixed to.
    """
    infer, _ = open_runtime(Runtime.onnxruntime, model, threads=0)
    tiling = tiling_of(model)

    def restore(dn: np.ndarray) -> np.ndarray:
        plan = make_plan((1, *dn.shape), tiling.fixed_px or TILE_PX, tiling.halo_px, tiling)
        return restore_dn(dn, infer, plan, max_dn)

    return restore
