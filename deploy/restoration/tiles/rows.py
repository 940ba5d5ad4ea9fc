"""The one tile loop. All code that restores an image by a network, from a file or an array, uses
it.

A `Source` provides a strip of rows, `Restorer.tile` runs the network on one tile of it, and
`Restorer.finish` applies the consistency step once the tiles around are available. `restore_rows`
yields finished rows of tiles in order: the next strip is read ahead, and several tiles are in work
at a time. `gathered` and `restore_floats` gather the rows of an image in memory.
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
from beers_deploy.quant.untrusted import times
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.plan import Plan, Span, TilePlace
from beers_deploy.restoration.tiles.engine import Restorer, Strip, Tile
from beers_deploy.restoration.tiles.exposures import ExposedNetwork

Steps = tuple[Consistency | None, ...]
"""The consistency step, one for all bands or one for each; empty if it is omitted, None for a band
without it.
"""


class RestoredRow(NamedTuple):
    """A finished row of tiles, or a strip of the traditional pipeline, with all bands.

    Attributes:
        pixels: the restored pixels (bands, rows, width) as they are stored.
        tally: counts and sums over these pixels and their raw ones.
    """

    pixels: np.ndarray
    tally: Tally


class NetworkRow(NamedTuple):
    """A row of tiles as the network returned it, before the consistency step.

    Attributes:
        span: the rows of the raw image that the tiles read and retain.
        strip: the raw rows from which the tiles were restored.
        pixels: the network's results (bands, rows, width), float32, NaN where pixels are missing.
        tally: the number of tiles and of runs of the network.
    """

    span: Span
    strip: Strip
    pixels: np.ndarray
    tally: Tally


@dataclass
class HeldRows:
    """A buffer of the network's results for adjacent rows of tiles, until the consistency step has
    used them. Rows and columns are those of the restored image.

    Attributes:
        top: the first row in the buffer.
        parts: pixels (bands, rows, width) of adjacent rows of tiles, from the top.
    """

    top: int
    parts: deque[np.ndarray] = field(default_factory=deque)

    @property
    def bottom(self) -> int:
        """The row after the last row in the buffer."""
        return self.top + int(sum(part.shape[1] for part in self.parts))

    def window(self, bands: slice, rows: slice, columns: slice) -> np.ndarray:
        """Return the pixels (bands, h, w) of some bands, rows and columns of the restored image."""
        start = self.top
        pieces = list[np.ndarray]()
        for part in self.parts:
            inside = slice(max(rows.start - start, 0), max(rows.stop - start, 0))
            pieces.append(part[bands, inside, columns])
            start += part.shape[1]
        return np.concatenate(pieces, axis=1)

    def forget_above(self, row: int) -> None:
        """Remove the rows above `row` from the buffer, so that their memory is released."""
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
    """Restore rows of tiles in order, with several tiles in work at a time.

    The network also runs on the rows of tiles next to these, as far as the consistency step reads
    them.

    Args:
        source: the image.
        restorer: restores single tiles of the image.
        rows: adjacent rows of tiles of the restorer's plan, from the top.
        tick: called once for each tile on which the network has run.
        at_once: the number of tiles in work at a time, each in a thread.

    Yields:
        The finished rows of tiles, in the order of `rows`.

    Raises:
        ImageError: a pixel is no digital number, or the network returns NaN or infinite values.
        ModelError: the network returns another shape than its file states.
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
    """Return the rows of tiles on which the network must run to finish `rows`: these, and those
    next to them that the consistency step reads.

    Args:
        restorer: restores single tiles of an image, and knows its plan.
        rows: adjacent rows of tiles of the plan, from the top.
    """
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
    return RestoredRow(pixels, tally)


def _gathered(
    tiles: Iterable[Tile], pixels: np.ndarray, plan: Plan, row: Span, tick: Callable[[], None]
) -> Tally:
    """Put the tiles of a row into `pixels` (bands, rows, width), and return their joint
    statistics.
    """
    tally = Tally()
    count = plan.tiling.channels_out
    for (group, _, columns), tile in zip(plan.places(row), tiles, strict=True):
        across = columns.keep_slice(scale=plan.scale)
        pixels[group * count : (group + 1) * count, :, across] = tile.pixels
        tally += tile.tally
        tick()
    return tally


def gathered(
    rows: Iterable[RestoredRow], shape: tuple[int, int, int], dtype: np.dtype[Any]
) -> tuple[np.ndarray, Tally]:
    """Put the restored rows of an image together in one array.

    Args:
        rows: all rows of tiles or strips of the image, from the top.
        shape: the shape of the restored image, (bands, H, W).
        dtype: the dtype of its pixels.

    Returns:
        The restored pixels (bands, H, W), and counts and sums over them and their raw pixels.
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
    network: ExposedNetwork,
    plan: Plan,
    max_dn: float,
    consistency: Steps = (),
) -> np.ndarray:
    """Restore an image of one band in memory, to floats that are not rounded.

    The pixels are those that `restore` writes for an image of floats.

    Args:
        dn: digital numbers (H, W) of 0 to `max_dn`. NaN is a missing pixel, and stays NaN.
        network: the network, perhaps with further versions of it for dark pixels.
        plan: how the image is cut into tiles.
        max_dn: the largest digital number, which is 1.0 to the network.
        consistency: the step that makes the result agree with the raw image at low spatial
            frequencies, as a tuple of one; empty to omit it.

    Returns:
        Restored digital numbers (H, W), float32.

    Raises:
        ModelError: the network returns another number of bands or another size than the image's.
        ImageError: a value is below 0 or above `max_dn`.
    """
    if plan.out_shape != (1, *dn.shape):
        raise ModelError(
            f"The network returns a result of {times(plan.out_shape)} for an image of "
            f"{times(dn.shape)}. Restore files with it, or arrays with beers_deploy.restore."
        )
    pixels = np.asarray(dn, np.float32)[None]
    _, height_px, width_px = pixels.shape
    raster = Raster(1, height_px, width_px, pixels.dtype)
    restorer = Restorer(raster, (network,), float(max_dn), plan, consistency=consistency)
    rows = restore_rows(ArraySource(pixels, raster), restorer, plan.rows, lambda: None)
    restored, _ = gathered(rows, plan.out_shape, raster.out_dtype)
    return np.asarray(restored[0])
