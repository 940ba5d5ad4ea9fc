"""Row of tiles by row of tiles: from pixels as stored to the rows that an output still lacks.

One row is read ahead and one written behind while the network works on others. Missing pixels are filled for the
network, and put back. What a halo below the receptive radius costs is measured on one tile.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import count

import numpy as np

from deploy.restoration.arrays import Infer, restore_window
from deploy.restoration.output import Spool
from deploy.restoration.plan import Plan, Span, check_memory, is_bulky, rows_bytes
from deploy.restoration.source import ArraySource, Raster, Source, fill_missing
from model.io.images import MAX_DN, remedy_outside
from model.progress import held_back, steps
from profiles.errors import BeersError, ImageError, MachineError

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


Restored = tuple[Span, np.ndarray, int]
"""A row of tiles, its kept rows (bands, rows, width), and how many of their pixels are known."""
Kept = tuple[np.ndarray, int]
"""A tile's kept pixels, and how many of them are known."""
Sink = Callable[[Span, np.ndarray, int], None]


def restore_rows(
    source: Source, plan: Plan, restorer: Restorer, rows: Sequence[Span], tick: Callable[[], None], at_once: int = 1
) -> Generator[Restored, None, None]:
    """Restore rows of tiles, `at_once` tiles at a time; `tick` is called once a tile, in their order.

    A row is begun before the one before it is finished, so that no thread waits for the last tile of a row.
    """
    with ThreadPoolExecutor(1) as ahead, ThreadPoolExecutor(at_once) as lanes:
        coming = [ahead.submit(restorer.read, source, row.start, row.stop) for row in rows[:1]]
        begun: deque[tuple[Span, Iterator[Kept]]] = deque()
        try:
            for k, row in enumerate(rows):
                band = coming.pop().result()
                coming += [ahead.submit(restorer.read, source, nxt.start, nxt.stop) for nxt in rows[k + 1 : k + 2]]
                begun.append((row, kept_tiles(band, row, plan, restorer, lanes.map)))
                if len(begun) > 1:
                    yield joined(*begun.popleft(), plan, restorer, tick)
            while begun:
                yield joined(*begun.popleft(), plan, restorer, tick)
        finally:
            lanes.shutdown(cancel_futures=True)


def restore_row(
    band: Band, row: Span, plan: Plan, restorer: Restorer, tick: Callable[[], None]
) -> tuple[np.ndarray, int]:
    """The kept pixels of one row of tiles, (bands, rows, width), and how many of them are known."""
    _, result, known = joined(row, kept_tiles(band, row, plan, restorer, map), plan, restorer, tick)
    return result, known


def kept_tiles(
    band: Band, row: Span, plan: Plan, restorer: Restorer, mapped: Callable[..., Iterator[Kept]]
) -> Iterator[Kept]:
    """The kept pixels of the tiles of one row, in the order of `_places`; `mapped` says who computes them."""
    return mapped(lambda place: restorer.kept(band, place[0], row, place[1]), _places(plan))


def joined(row: Span, tiles: Iterable[Kept], plan: Plan, restorer: Restorer, tick: Callable[[], None]) -> Restored:
    """One row of its tiles."""
    shape = (plan.bands, row.keep_stop - row.keep_start, plan.width_px)
    result, known = np.empty(shape, restorer.raster.out_dtype), 0
    for (plane, column), (pixels, known_here) in zip(_places(plan), tiles, strict=True):
        result[plane, :, column.keep_start : column.keep_stop] = pixels
        known += known_here
        tick()
    return row, result, known


def _places(plan: Plan) -> list[tuple[int, Span]]:
    return [(plane, column) for plane in range(plan.bands) for column in plan.columns]


def restore_array(source: Source, plan: Plan, restorer: Restorer, at_once: int = 1) -> np.ndarray:
    """All rows of an image, (bands, height, width) of `raster.out_dtype`, `at_once` tiles at a time.

    Raises:
        ImageError: values outside 0 to full scale, or a network that gives NaN.
    """
    result = np.empty(restorer.raster.shape, restorer.raster.out_dtype)
    for row, pixels, _ in restore_rows(source, plan, restorer, plan.rows, lambda: None, at_once):
        result[:, row.keep_start : row.keep_stop] = pixels
    return result


def restore_dn(dn: np.ndarray, infer: Infer, plan: Plan, max_dn: float = MAX_DN) -> np.ndarray:
    """Restore (H, W) digital numbers of 0 to `max_dn` to whole ones, float32: what `restore` writes of integers.

    Raises:
        ImageError: values outside 0 to `max_dn`, or a network that gives NaN.
    """
    return np.asarray(np.rint(restore_floats(dn, infer, plan, max_dn)))


def restore_floats(dn: np.ndarray, infer: Infer, plan: Plan, max_dn: float = MAX_DN) -> np.ndarray:
    """Restore (H, W) digital numbers of 0 to `max_dn` to float32, not rounded: what `restore` writes of floats.

    NaN is a missing pixel, and stays.

    Raises:
        ImageError: values outside 0 to `max_dn`, or a network that gives NaN.
    """
    pixels = np.asarray(dn, np.float32)[None]
    _, height_px, width_px = pixels.shape
    raster = Raster(1, height_px, width_px, pixels.dtype)
    restorer = Restorer(raster, infer, float(max_dn), plan.radius_px)
    return np.asarray(restore_array(ArraySource(pixels, raster), plan, restorer)[0])


def write_behind(restored: Iterable[Restored], sink: Sink) -> None:
    """Hand rows over to `sink`, each while the next is made; never more than one waits."""
    with ThreadPoolExecutor(1) as behind:
        writing: Future[None] | None = None
        for row in restored:
            if writing is not None:
                writing.result()
            writing = behind.submit(sink, *row)
        if writing is not None:
            writing.result()


Say = Callable[[str], None]
Tick = Callable[[int], None]
"""Told how many tiles are done since; stops the run where somebody asked to."""
RUNS_UNTIL_STEADY = 2
"""Of each tile in work at a time: then a runtime takes no more memory."""


def rows_left(spool: Spool, plan: Plan) -> list[Span]:
    """Rows of tiles that are not finished."""
    return [row for row in plan.rows if row.keep_start >= spool.rows]


def fill_here(
    spool: Spool,
    source: Source,
    plan: Plan,
    restorer: Restorer,
    at_once: int,
    budget_bytes: int | None,
    say: Say,
) -> None:
    """Finish the spool's rows in this process, `at_once` tiles at a time.

    Raises:
        ImageError: unreadable rows, values out of range, or no known pixel at all; the rows are thrown away.
        MachineError: memory or disk; finished rows stay.
        KeyboardInterrupt: stopped; finished rows stay.
    """
    rows = rows_left(spool, plan)
    tiles, steady = count(1), min(RUNS_UNTIL_STEADY * at_once, len(rows) * len(plan.columns) * plan.bands)
    with filling(spool, plan, restorer.name, say) as tick:

        def done() -> None:
            if next(tiles) == steady:
                needed = rows_bytes(source, plan, begun=True)
                peak = check_memory(needed, budget_bytes, is_bulky(source, plan))
                say(f"memory: {peak / 1e9:.2f} GB at most (measured on the first tiles, and the rows to come)")
            tick(1)

        with closing(restore_rows(source, plan, restorer, rows, done, at_once)) as restored:
            write_behind(restored, spool.append)


@contextmanager
def filling(spool: Spool, plan: Plan, name: str, say: Say) -> Iterator[Tick]:
    """Progress, and what becomes of the rows when something stops them.

    Raises:
        ImageError: in the end no pixel of the image is known.
    """
    tiles = len(rows_left(spool, plan)) * len(plan.columns) * plan.bands
    with _kept_for_resuming(spool, say), steps("restoring", tiles) as bar, held_back() as interrupt:

        def tick(done: int) -> None:
            if done:
                bar.advance(done)
            if interrupt.asked:
                raise KeyboardInterrupt

        yield tick
        if not spool.known:
            got, remedy = "NaN or nodata everywhere", "check that it is the right file"
            raise ImageError(name, expected="some pixels with values", got=got, remedy=remedy)


@contextmanager
def _kept_for_resuming(spool: Spool, say: Say) -> Iterator[None]:
    """Finished rows outlive a stop and a full disk, not an image or a network that no later run could finish."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"stopped at row {spool.rows} of {spool.shape[1]}; the same command with --resume goes on")
        raise
    except BeersError as error:
        if not spool.rows or not isinstance(error, MachineError):
            spool.remove()
        raise


def seam_error_dn(source: Source, plan: Plan, restorer: Restorer) -> tuple[float, float]:
    """Largest and mean difference of a tile in the middle from the exact result, in digital numbers.

    The same kept pixels are restored twice: from the tile's own window, and from one with the whole radius around.
    """
    rows, columns = plan.rows[len(plan.rows) // 2], plan.columns[len(plan.columns) // 2]
    wide = [_widened(rows, plan.radius_px, plan.height_px), _widened(columns, plan.radius_px, plan.width_px)]
    start, stop = min(rows.start, wide[0].start), max(rows.stop, wide[0].stop)
    band = restorer.read(source, start, stop)
    cheap, _ = restorer.kept(band, 0, rows, columns)
    exact, _ = restorer.kept(band, 0, *wide)
    error = np.abs(np.nan_to_num(cheap.astype(np.float64)) - np.nan_to_num(exact.astype(np.float64)))
    return float(error.max()), float(error.mean())


def _widened(span: Span, radius_px: int, size_px: int) -> Span:
    """The same kept pixels with the whole radius around them, as far as the image goes."""
    start, stop = max(span.keep_start - radius_px, 0), min(span.keep_stop + radius_px, size_px)
    return Span(start, stop, span.keep_start, span.keep_stop)
