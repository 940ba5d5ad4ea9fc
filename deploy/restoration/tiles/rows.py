"""The one tile loop. All code that restores an image by a network, from a file or an array, uses
it.

A `Source` provides a strip of rows, `Restorer.tile` runs the network on one tile of it, and
`Restorer.finish` applies the consistency step once the tiles around are available. `restore_rows`
yields finished rows of tiles in order: the next strip is read ahead, and several tiles are in work
at a time. `gathered`, `restore_floats` and `restore_dn` gather the rows of an image in memory.
`restoration.run` writes those of a file.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from itertools import zip_longest
from typing import Any, NamedTuple

import numpy as np

from beers_deploy.model.consistency.step import Consistency
from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.source import ArraySource, Source
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.untrusted import times
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.plan import Plan, Span, TilePlace
from beers_deploy.restoration.runtime import Infer
from beers_deploy.restoration.tiles.engine import Restorer, Strip, Tile
from beers_deploy.restoration.tiles.exposures import ExposedNetwork

Steps = tuple[Consistency | None, ...]
"""The consistency step, one for all bands or one for each; empty if it is omitted, None for a band
without it.
"""


class RestoredRow(NamedTuple):
    """A row of tiles: its `span` in the image, the restored `pixels` (bands, rows, width), and
    their statistics.
    """

    span: Span
    pixels: np.ndarray
    tally: Tally


class NetworkRow(NamedTuple):
    """A row of tiles as the network returned it: `pixels` (bands, rows, width) float32, NaN where
    they are missing.
    """

    span: Span
    strip: Strip
    pixels: np.ndarray
    tally: Tally


@dataclass
class HeldRows:
    """Rows that the network returned, as far up as the next row of tiles to finish needs them.

    Rows and columns are those of the restored image.
    """

    top: int = 0
    parts: deque[np.ndarray] = field(default_factory=deque)

    @property
    def bottom(self) -> int:
        """The row after the last one."""
        return self.top + int(sum(part.shape[1] for part in self.parts))

    def window(self, bands: slice, rows: slice, columns: slice) -> np.ndarray:
        """Return the pixels (bands, h, w) of some rows and columns."""
        start = self.top
        pieces = list[np.ndarray]()
        for part in self.parts:
            inside = slice(max(rows.start - start, 0), max(rows.stop - start, 0))
            pieces.append(part[bands, inside, columns])
            start += part.shape[1]
        return np.concatenate(pieces, axis=1)

    def forget_above(self, row: int) -> None:
        """Release the rows above `row`."""
        while self.parts and self.top + self.parts[0].shape[1] <= row:
            self.top += self.parts.popleft().shape[1]
        if self.parts and self.top < row:
            # A view would keep the whole part in memory.
            self.parts[0] = self.parts[0][:, row - self.top :].copy()
            self.top = row


def restore_rows(
    source: Source,
    restorer: Restorer,
    rows: Sequence[Span],
    tick: Callable[[], None],
    at_once: int = 1,
) -> Generator[RestoredRow, None, None]:
    """Restore rows of tiles in order, `at_once` tiles at a time. `tick` is called once for each
    tile.

    The network also runs on rows of tiles before the first one, as far as the consistency step
    reaches.
    """
    if not rows:
        return
    plan = restorer.plan
    reach_px = restorer.reach_px
    first = rows[0].keep_start
    network_rows = rows_to_run(restorer, rows)
    # One thread reads, because a source keeps the segments that it decoded for the next rows.
    with ThreadPoolExecutor(1) as reader, ThreadPoolExecutor(at_once) as pool:
        try:
            waiting = deque[NetworkRow]()
            scale = plan.scale
            buffer = HeldRows(network_rows[0].keep_start * scale)
            for row in _network_rows(source, restorer, network_rows, (reader, pool), tick):
                buffer.parts.append(row.pixels)
                if first <= row.span.keep_start < rows[-1].keep_stop:
                    waiting.append(row)
                while waiting and buffer.bottom >= scale * min(
                    waiting[0].span.keep_stop + reach_px, plan.height_px
                ):
                    done_px = waiting[0].span.keep_stop
                    # A variable for the row would hold it in memory while the next is computed.
                    yield _finished(waiting.popleft(), buffer, restorer, pool)
                    buffer.forget_above((done_px - reach_px) * scale)
        finally:
            # Otherwise the tiles of two rows would still be restored after an error.
            pool.shutdown(cancel_futures=True)


def rows_to_run(restorer: Restorer, rows: Sequence[Span]) -> list[Span]:
    """Return the rows of tiles that the network must run on to finish `rows`."""
    if not rows:
        return []
    start = rows[0].keep_start - restorer.reach_px
    stop = rows[-1].keep_stop + restorer.reach_px
    return [row for row in restorer.plan.rows if row.keep_stop > start and row.keep_start < stop]


def _network_rows(
    source: Source,
    restorer: Restorer,
    rows: Sequence[Span],
    pools: tuple[Executor, Executor],
    tick: Callable[[], None],
) -> Iterator[NetworkRow]:
    """Run the network on rows of tiles.

    A row is started before the previous one is finished, so that no thread waits.
    """
    reader, pool = pools
    plan = restorer.plan

    def finished(row: Span, strip: Strip, tiles: Iterable[Tile]) -> NetworkRow:
        rows_px = (row.keep_stop - row.keep_start) * plan.scale
        pixels = np.empty((plan.out_shape[0], rows_px, plan.out_shape[2]), np.float32)
        return NetworkRow(row, strip, pixels, _gathered(tiles, pixels, plan, row, tick))

    coming = reader.submit(restorer.read, source, rows[0])
    begun = deque[tuple[Span, Strip, Iterator[Tile]]]()
    for row, following in zip_longest(rows, rows[1:]):
        strip = coming.result()
        # The next strip is read while the network runs on this one.
        if following:
            coming = reader.submit(restorer.read, source, following)
        begun.append((row, strip, pool.map(partial(restorer.tile, strip), plan.places(row))))
        if len(begun) > 1:
            yield finished(*begun.popleft())
    yield finished(*begun.popleft())


def _finished(row: NetworkRow, buffer: HeldRows, restorer: Restorer, pool: Executor) -> RestoredRow:
    """Finish a row of tiles, tile by tile, once all that they need is available."""
    plan = restorer.plan
    count = plan.tiling.channels_out
    reach_px = restorer.reach_px
    scale = plan.scale
    top = max(row.span.keep_start - reach_px, 0)
    rows = slice(top * scale, (row.span.keep_stop + reach_px) * scale)

    def finish(place: TilePlace) -> Tile:
        bands = slice(place.group * count, (place.group + 1) * count)
        left = max(place.columns.keep_start - reach_px, 0)
        across = slice(left * scale, (place.columns.keep_stop + reach_px) * scale)
        return restorer.finish(row.strip, buffer.window(bands, rows, across), (top, left), place)

    pixels = np.empty(row.pixels.shape, restorer.raster.out_dtype)
    tiles = pool.map(finish, plan.places(row.span))
    tally = row.tally + _gathered(tiles, pixels, plan, row.span, lambda: None)
    return RestoredRow(row.span, pixels, tally)


def _gathered(
    tiles: Iterable[Tile], pixels: np.ndarray, plan: Plan, row: Span, tick: Callable[[], None]
) -> Tally:
    """Put the tiles of a row into `pixels` (bands, rows, width), and return their joint
    statistics.
    """
    tally = Tally()
    count = plan.tiling.channels_out
    for (group, _, columns), tile in zip(plan.places(row), tiles, strict=True):
        across = slice(columns.keep_start * plan.scale, columns.keep_stop * plan.scale)
        pixels[group * count : (group + 1) * count, :, across] = tile.pixels
        tally += tile.tally
        tick()
    return tally


def gathered(
    rows: Iterable[RestoredRow], shape: tuple[int, int, int], dtype: np.dtype[Any]
) -> tuple[np.ndarray, Tally]:
    """Gather all restored rows of an image, from the top.

    Args:
        rows: the rows of tiles or strips, in order.
        shape: the shape of the restored image, (bands, H, W).
        dtype: the dtype of its pixels.

    Returns:
        The pixels, and their statistics.
    """
    pixels = np.empty(shape, dtype)
    tally = Tally()
    top = 0
    for row in rows:
        stop = top + row.pixels.shape[1]
        pixels[:, top:stop] = row.pixels
        tally += row.tally
        top = stop
    return pixels, tally


def restore_floats(
    dn: np.ndarray,
    network: Infer | ExposedNetwork,
    plan: Plan,
    max_dn: float = MAX_DN,
    consistency: Steps = (),
) -> np.ndarray:
    """Restore (H, W) digital numbers of 0 to `max_dn` to float32, not rounded, as `restore` writes
    floats.

    NaN is a missing pixel, and stays NaN.
    """
    if plan.out_shape != (1, *dn.shape):
        raise ModelError(
            f"The network returns a result of {times(plan.out_shape)} for an image of "
            f"{times(dn.shape)}. Restore files with it, or arrays with beers_deploy.restore."
        )
    pixels = np.asarray(dn, np.float32)[None]
    _, height_px, width_px = pixels.shape
    raster = Raster(1, height_px, width_px, pixels.dtype)
    exposed = network if isinstance(network, ExposedNetwork) else ExposedNetwork({1: network})
    restorer = Restorer(raster, (exposed,), float(max_dn), plan, consistency=consistency)
    rows = restore_rows(ArraySource(pixels, raster), restorer, plan.rows, lambda: None)
    restored, _ = gathered(rows, plan.out_shape, raster.out_dtype)
    return np.asarray(restored[0])


def restore_dn(
    dn: np.ndarray,
    network: Infer | ExposedNetwork,
    plan: Plan,
    max_dn: float = MAX_DN,
    consistency: Steps = (),
) -> np.ndarray:
    """Restore (H, W) digital numbers of 0 to `max_dn` to integers in float32, as `restore` writes
    integers.
    """
    return np.asarray(np.rint(restore_floats(dn, network, plan, max_dn, consistency)))
