"""Workers of a Dask cluster: results in order, only a few pieces of work under way at a time.

A worker that dies changes nothing: Dask gives its pieces to another, and what was sent once is made again.
"""

import socket
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, Future, wait
from contextlib import contextmanager, suppress
from functools import lru_cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

from deploy import __version__
from profiles.errors import ImageError, MachineError

PIECES_PER_SLOT = 2
"""One in work and one on its way; a slot is a thread of a worker."""
POLL_S = 0.3
WORKERLESS_S = 60
"""Longer than a restarted worker needs to come back."""
PACKAGES = ("numpy", "onnxruntime", "torch")
"""They decide the last bits of a result."""

T = TypeVar("T")
Item = TypeVar("Item")


class Workers:
    """Workers that are there."""

    def __init__(self, client: Any) -> None:  # distributed.Client, an optional package
        self._client = client

    def share(self, value: object) -> object:
        """A value sent once, for pieces of work to take; should every worker that holds it die, it is made again."""
        return self._client.submit(_itself, value, pure=False)

    def in_order(
        self, function: Callable[..., T], shared: object, items: Iterable[Item], tick: Callable[[], None]
    ) -> Generator[T, None, None]:
        """Yield function(shared, item) of each item, in order; `tick` is called while waiting, and may raise.

        Raises:
            BeersError: as the function raised it.
            MachineError: workers that die over the same piece, none left, or the scheduler gone.
        """
        waiting, under_way = deque(items), deque[Future[T]]()
        pool = self._client.get_executor(pure=False)
        try:
            while waiting or under_way:
                while waiting and len(under_way) < PIECES_PER_SLOT * max(self.slots, 1):
                    under_way.append(pool.submit(_checked, versions(), function, shared, waiting.popleft()))
                yield self._result(under_way.popleft(), tick)
        finally:
            pool.shutdown(wait=False)

    def everywhere(self, function: Callable[..., None], *arguments: object) -> None:
        """Call a function in every worker that answers, even while it works on a piece."""
        with suppress(OSError):
            self._client.run(function, *arguments, on_error="ignore")

    @property
    def slots(self) -> int:
        """Pieces that are worked on at once."""
        try:
            return sum(self._client.nthreads().values())
        except OSError as error:
            raise _disconnected() from error

    def _result(self, piece: "Future[T]", tick: Callable[[], None]) -> T:
        seen_s = time.monotonic()
        while not wait([piece], POLL_S).done:
            tick()
            seen_s = time.monotonic() if self.slots else seen_s
            if time.monotonic() - seen_s > WORKERLESS_S:
                raise lost_workers(f"none for {WORKERLESS_S} s", "start some, and go on with --resume")
        with _in_a_sentence():
            return piece.result()


def slots_here() -> int:
    """In a worker: pieces that this process works on at once."""
    return int(import_module("distributed").get_worker().state.nthreads)


def here() -> str:
    """A worker's name for messages."""
    return f"worker {socket.gethostname()}"


def unreachable(path: Path, got: str) -> ImageError:
    """The error of a worker that does not find an image, or finds another."""
    remedy = "put it where every worker sees it under this path, such as a shared folder"
    return ImageError(f"{path} on {here()}", expected="an image that every worker can read", got=got, remedy=remedy)


@contextmanager
def _in_a_sentence() -> Iterator[None]:
    """One sentence for the ways in which a cluster loses a piece of work.

    Raises:
        MachineError: any of them.
    """
    killed = import_module("distributed").KilledWorker
    try:
        yield
    except killed as error:
        got = f"{error.allowed_failures + 1} that died over one piece"
        raise lost_workers(got, "give them more memory or smaller pieces, and go on with --resume") from error
    except CancelledError as error:
        raise _disconnected() from error


def _disconnected() -> MachineError:
    return lost_workers("no connection to their scheduler", "start it again, and go on with --resume")


def lost_workers(got: str, remedy: str) -> MachineError:
    """The error of a cluster that cannot go on."""
    return MachineError("workers", expected="some that live to the end", got=got, remedy=remedy)


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """What results depend on, besides the processor."""
    return {"beers-deploy": __version__, **{name: version(name) for name in PACKAGES}}


def _checked(expected: dict[str, str], function: Callable[..., T], *arguments: object) -> T:
    """In a worker: call the function, if the packages here are those of the process that asks for it."""
    found = versions()
    if found != expected:
        differ = [name for name in found if found[name] != expected[name]]
        got, wanted = (", ".join(f"{name} {which[name]}" for name in differ) for which in (found, expected))
        remedy = "install the same versions on every machine"
        raise MachineError(here(), expected=wanted, got=got, remedy=remedy)
    return function(*arguments)


def _itself(value: T) -> T:
    return value
