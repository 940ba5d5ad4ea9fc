"""Rows of tiles restored by the workers of a cluster: the same plan, the same bytes as here."""

import os
import uuid
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from pathlib import Path

import onnx

from deploy.cluster import open_cluster
from deploy.swath.engine import Restored, write_behind
from deploy.swath.fill import Say, Tick, filling, rows_left
from deploy.swath.job import fingerprint
from deploy.swath.memory import check_memory, restored_bytes
from deploy.swath.options import Options
from deploy.swath.plan import Plan
from deploy.swath.reader import Source
from deploy.swath.runtime import pack
from deploy.swath.spool import Spool
from deploy.swath.worker import Piece, Work, forget, restore_piece
from deploy.tiling import Span
from deploy.workers import PIECES_PER_SLOT

ROWS_HERE = 2
"""One being written, one on its way to be."""


def make_work(
    image: Path, plan: Plan, network: onnx.ModelProto, runtime: str, options: Options, full_scale: float
) -> Work:
    """What the workers of one run are to do.

    Those of this machine share its cores; elsewhere a slot is taken to be worth one.
    """
    share = (os.cpu_count() or 1) // options.workers if options.workers else 1
    packed = pack(network, options.runtime, options.threads or max(share, 1))
    return Work(uuid.uuid4().hex, image.absolute(), fingerprint(image), plan, options, packed, runtime, full_scale)


def fill_spread(spool: Spool, source: Source, work: Work, say: Say) -> float | None:
    """Finish the spool's rows by workers; returns the peak memory of the largest one in GB.

    Raises:
        ImageError: as here, or an image that a worker cannot read; the rows are thrown away.
        MachineError: memory, disk, Dask or its workers; finished rows stay.
        KeyboardInterrupt: stopped; finished rows stay.
    """
    peaks_gb: list[float] = []

    def told(piece: Piece) -> None:
        if not peaks_gb:
            most = f"{piece.most_bytes / 1e9:.2f} GB at most in each worker"
            say(f"memory: {most} (measured on a first row, and the rows to come)")
        peaks_gb.append(piece.peak_gb or 0)

    with filling(spool, work.plan, str(work.image), say) as tick:
        if rows := rows_left(spool, work.plan):
            with closing(spread_rows(work, source, rows, tick, told)) as restored:
                write_behind(restored, spool.append)
    return max(peaks_gb, default=0) or None


def spread_rows(
    work: Work, source: Source, rows: Sequence[Span], tick: Tick, told: Callable[[Piece], None]
) -> Generator[Restored, None, None]:
    """Restore rows of tiles in order, several under way at a time; `told` is handed each before it is yielded."""
    options, plan = work.options, work.plan
    with open_cluster(options.workers, options.scheduler) as workers:
        waiting = (PIECES_PER_SLOT * workers.slots + ROWS_HERE) * restored_bytes(source, plan)
        check_memory(waiting, options.memory_bytes, bulky=False, share=options.workers + 1)
        pieces = workers.in_order(restore_piece, workers.share(work), rows, lambda: tick(0))
        try:
            with closing(pieces):
                for row, piece in zip(rows, pieces, strict=True):
                    told(piece)
                    yield row, piece.pixels, piece.known
                    tick(len(plan.columns) * plan.bands)
        finally:
            workers.everywhere(forget, work.key)
