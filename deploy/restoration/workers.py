"""Rows of tiles restored by the workers of a Dask cluster: the same plan, the same bytes as in one process.

The run's process plans and writes; `Work` is sent to each worker once, which keeps image and network open between
rows. `rows_of_workers` yields their rows in order.
"""

import os
import uuid
import weakref
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import onnx

from deploy.cluster import PIECES_PER_SLOT, here, open_cluster, slots_here, unreachable
from deploy.host_state import peak_memory
from deploy.restoration.engine import RestoredRow, Restorer, Say, Tick, restore_row
from deploy.restoration.options import Options
from deploy.restoration.plan import Plan, Span, check_memory, is_bulky, restored_bytes, rows_bytes
from deploy.restoration.radiometry import FullScale
from deploy.restoration.runtime import Packed, open_packed, pack
from deploy.restoration.source import Source, fingerprint, open_source
from profiles.errors import MachineError

JOBS_KEPT = 2
"""That a process keeps open: runs may share a cluster, and one that was killed closes nothing."""


@dataclass(frozen=True)
class Work:
    """What workers are to do in one run.

    Attributes:
        key: tells this run from others on the same cluster.
        image: its path, the same for all workers.
        seen: the image's fingerprint, to know another file of that name.
        network: to be opened.
        runtime: name and version of what runs it where the run began; another might give other bytes.
        scale: the pixel value that is 1.0 to the network, settled where the run began.
    """

    key: str
    image: Path
    seen: tuple[int, str]
    plan: Plan
    options: Options
    network: Packed
    runtime: str
    scale: FullScale


@dataclass(frozen=True)
class Piece:
    """A restored row of tiles, and its worker's memory.

    Attributes:
        row: of tiles.
        most_bytes: what the worker will take at most.
        peak_gb: what it took; None where its system does not count it.
    """

    row: RestoredRow
    most_bytes: int
    peak_gb: float | None


class StoppedError(Exception):
    """The run is over: nobody waits for this row."""


class Opened:
    """An image and a network ready for rows."""

    def __init__(self, work: Work) -> None:
        self.work, self.reading, self.stopped, self.most_bytes = work, Lock(), False, 0
        stack = ExitStack()
        weakref.finalize(self, stack.close)  # when the last row that needs it is done
        self.source = stack.enter_context(_reachable(work))
        self._check_memory(begun=False)
        infer, runtime = open_packed(work.network)
        if runtime != work.runtime:
            raise MachineError(here(), expected=work.runtime, got=runtime, remedy="install the same everywhere")
        scale, tiling = work.scale, work.plan.tiling
        raster, name = self.source.raster, str(work.image)
        self.restorer = Restorer(raster, infer, scale.value, tiling, name, not scale.assumed)

    def restore(self, row: Span) -> Piece:
        """Restore one row of tiles.

        Raises:
            ImageError: unreadable rows, values outside 0 to full scale, or a network that gives NaN.
            MachineError: memory.
            StoppedError: the run is over.
        """
        with self.reading:
            strip = self.restorer.read(self.source, row.start, row.stop)
        restored = restore_row(strip, row, self.work.plan, self.restorer, self._tick)
        if not self.most_bytes:
            self.most_bytes = self._check_memory(begun=True)
        return Piece(restored, self.most_bytes, peak_memory().value)

    def _tick(self) -> None:
        if self.stopped:
            raise StoppedError

    def _check_memory(self, begun: bool) -> int:
        source, plan, options = self.source, self.work.plan, self.work.options
        rows = slots_here() * rows_bytes(source, plan, begun)
        return check_memory(rows, options.memory_bytes, is_bulky(source, plan), options.workers + 1)


_opened: dict[str, Opened] = {}
_opening = Lock()


def restore_piece(work: Work, row: Span) -> Piece:
    """Restore one row of tiles in a worker.

    Raises:
        ImageError: the image cannot be read here, is another one, or has values outside 0 to full scale.
        MachineError: memory, or another runtime than where the run began.
        ModelError: the network did not arrive as it was sent.
    """
    with _opening:
        if work.key not in _opened:
            while len(_opened) >= JOBS_KEPT:
                del _opened[next(iter(_opened))]
            _opened[work.key] = Opened(work)
        opened = _opened[work.key]
    return opened.restore(row)


def forget(key: str) -> None:
    """Close what a run left open; a row still in work ends at its next tile."""
    with _opening:
        opened = _opened.pop(key, None)
    if opened is not None:
        opened.stopped = True


@contextmanager
def _reachable(work: Work) -> Iterator[Source]:
    """The image, if it is the one that the run began with."""
    try:
        seen = fingerprint(work.image)
    except OSError as error:
        raise unreachable(work.image, error.strerror or str(error)) from error
    if seen != work.seen:
        raise unreachable(work.image, "another file of that name")
    with open_source(work.image, work.options.trust_index) as source:
        yield source


ROWS_HERE = 2
"""One being written, one on its way to be."""


def make_work(
    image: Path, plan: Plan, network: onnx.ModelProto, runtime: str, options: Options, scale: FullScale
) -> Work:
    """What the workers of one run are to do.

    Those of this machine share its cores; elsewhere a slot is taken to be worth one.
    """
    share = (os.cpu_count() or 1) // options.workers if options.workers else 1
    packed = pack(network, options.runtime, options.threads or max(share, 1))
    return Work(uuid.uuid4().hex, image.absolute(), fingerprint(image), plan, options, packed, runtime, scale)


def rows_of_workers(
    work: Work, source: Source, say: Say, peaks_gb: list[float], rows: Sequence[Span], tick: Tick
) -> Generator[RestoredRow, None, None]:
    """Rows restored by workers, in order, several under way at a time.

    Args:
        work: of the run.
        source: the image, as it is here.
        say: told the memory, once the first row is done.
        peaks_gb: gets each row's worker's peak memory; 0 where its system does not count it.
        rows: of tiles.
        tick: told how many tiles are done, and called while waiting; may raise.

    Raises:
        ImageError: as here, or an image that a worker cannot read.
        MachineError: memory, Dask or its workers.
    """
    options, plan = work.options, work.plan
    with open_cluster(options.workers, options.scheduler) as workers:
        waiting = (PIECES_PER_SLOT * workers.slots + ROWS_HERE) * restored_bytes(source, plan)
        check_memory(waiting, options.memory_bytes, bulky=False, share=options.workers + 1)
        pieces = workers.in_order(restore_piece, workers.share(work), rows, lambda: tick(0))
        try:
            with closing(pieces):
                for piece in pieces:
                    if not peaks_gb:
                        most = f"about {piece.most_bytes / 1e9:.2f} GB in each worker"
                        say(f"memory: {most} (measured on a first row, and the rows to come)")
                    peaks_gb.append(piece.peak_gb or 0)
                    yield piece.row
                    tick(plan.row_tiles)
        finally:
            workers.everywhere(forget, work.key)
