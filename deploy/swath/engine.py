"""Row of tiles by row of tiles: one is read ahead and one written behind while the network works on a third."""

from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from deploy.swath.plan import Plan
from deploy.swath.reader import Source
from deploy.swath.restorer import Band, Restorer
from deploy.tiling import Span

Restored = tuple[Span, np.ndarray, int]
"""A row of tiles, its kept rows (bands, rows, width), and how many of their pixels are known."""
Sink = Callable[[Span, np.ndarray, int], None]


def restore_rows(
    source: Source, plan: Plan, restorer: Restorer, rows: Sequence[Span], tick: Callable[[], None]
) -> Generator[Restored, None, None]:
    """Restore rows of tiles, each read while the one before is in work; `tick` is called once a tile."""
    with ThreadPoolExecutor(1) as ahead:
        coming = [ahead.submit(restorer.read, source, row.start, row.stop) for row in rows[:1]]
        for k, row in enumerate(rows):
            band = coming.pop().result()
            coming += [ahead.submit(restorer.read, source, nxt.start, nxt.stop) for nxt in rows[k + 1 : k + 2]]
            yield row, *restore_row(band, row, plan, restorer, tick)


def restore_row(
    band: Band, row: Span, plan: Plan, restorer: Restorer, tick: Callable[[], None]
) -> tuple[np.ndarray, int]:
    """The kept pixels of one row of tiles, (bands, rows, width), and how many of them are known."""
    shape = (plan.bands, row.keep_stop - row.keep_start, plan.width_px)
    result, known = np.empty(shape, restorer.raster.out_dtype), 0
    for plane in range(plan.bands):
        for column in plan.columns:
            pixels, count = restorer.kept(band, plane, row, column)
            result[plane, :, column.keep_start : column.keep_stop] = pixels
            known += count
            tick()
    return result, known


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
