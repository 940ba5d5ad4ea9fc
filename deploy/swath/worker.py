"""What a worker does with a row of tiles. Image and network stay open between rows, in each process."""

import weakref
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import numpy as np

from deploy.host_state import peak_memory
from deploy.swath.engine import restore_row
from deploy.swath.job import fingerprint
from deploy.swath.memory import check_memory, is_bulky, rows_bytes
from deploy.swath.options import Options
from deploy.swath.plan import Plan
from deploy.swath.reader import Source, open_source
from deploy.swath.restorer import Restorer
from deploy.swath.runtime import Packed, open_packed
from deploy.tiling import Span
from deploy.workers import here, slots_here, unreachable
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
        full_scale: the pixel value that is 1.0 to the network, settled where the run began.
    """

    key: str
    image: Path
    seen: tuple[int, str]
    plan: Plan
    options: Options
    network: Packed
    runtime: str
    full_scale: float


@dataclass(frozen=True)
class Piece:
    """A restored row of tiles, (bands, rows, width), and the most memory that its worker will take and took."""

    pixels: np.ndarray
    known: int
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
        scale, radius_px = work.full_scale, work.plan.radius_px
        self.restorer = Restorer(self.source.raster, infer, scale, radius_px, str(work.image))

    def restore(self, row: Span) -> Piece:
        """Restore one row of tiles."""
        with self.reading:
            band = self.restorer.read(self.source, row.start, row.stop)
        pixels, known = restore_row(band, row, self.work.plan, self.restorer, self._tick)
        if not self.most_bytes:
            self.most_bytes = self._check_memory(begun=True)
        return Piece(pixels, known, self.most_bytes, peak_memory().value)

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
    """One row of tiles.

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
    with open_source(work.image) as source:
        yield source
