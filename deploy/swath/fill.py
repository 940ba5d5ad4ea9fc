"""The rows that a spool still lacks, restored here or by workers."""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import count

from deploy.progress import steps
from deploy.swath.engine import restore_rows, write_behind
from deploy.swath.memory import check_memory, is_bulky, rows_bytes
from deploy.swath.plan import Plan
from deploy.swath.reader import Source
from deploy.swath.restorer import Restorer
from deploy.swath.spool import Spool
from deploy.tiling import Span
from model.training.interrupts import held_back
from profiles.errors import BeersError, ImageError, MachineError

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
