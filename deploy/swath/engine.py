"""Row of tiles by row of tiles: one is read ahead and one written behind while the network works on others."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from deploy.swath.plan import Plan
from deploy.swath.reader import Source
from deploy.swath.restorer import Band, Restorer
from deploy.tiling import Span

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
    for (plane, column), (pixels, count) in zip(_places(plan), tiles, strict=True):
        result[plane, :, column.keep_start : column.keep_stop] = pixels
        known += count
        tick()
    return row, result, known


def _places(plan: Plan) -> list[tuple[int, Span]]:
    return [(plane, column) for plane in range(plan.bands) for column in plan.columns]


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
