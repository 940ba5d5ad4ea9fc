"""A Dask cluster: processes of this machine, or the workers of a scheduler elsewhere."""

import logging
import re
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, Future, wait
from contextlib import ExitStack, contextmanager, suppress
from functools import lru_cache
from importlib import import_module
from importlib.metadata import version
from multiprocessing import resource_tracker
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, TypeVar

from deploy import __version__
from model.processor import require_cores
from profiles.errors import ImageError, MachineError, OptionError

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


ANSWER_S, JOIN_S = 10, 30
"""How long a scheduler may take to answer, and a first worker to be there."""
ADDRESS = re.compile(r"((tcp|tls|ucx|wss?)://)?(\[\S+\]|[^/:\s]+):\d+|inproc://\S+")


def check_choice(workers: int, scheduler: str | None) -> None:
    """Workers here or workers elsewhere, not both, and here no more than there are cores.

    Raises:
        OptionError: both or too many are asked for, or no address of a scheduler is one.
    """
    if scheduler and not ADDRESS.fullmatch(scheduler):
        remedy = "the scheduler prints it when it starts"
        raise OptionError("--scheduler", expected="an address such as tcp://host:8786", got=scheduler, remedy=remedy)
    if workers and scheduler:
        remedy = "a scheduler has workers of its own: leave out --workers"
        raise OptionError("--workers", expected="none beside --scheduler", got=str(workers), remedy=remedy)
    require_cores("--workers", workers)


@contextmanager
def open_cluster(workers: int, scheduler: str | None = None) -> Iterator[Workers]:
    """So many processes of this machine, gone when the block ends; or the workers of a scheduler elsewhere.

    Raises:
        MachineError: Dask is not installed, or no scheduler or worker answers.
    """
    with _quiet(), ExitStack() as stack:
        if scheduler is None:
            scheduler = stack.enter_context(local_cluster(workers)).scheduler_address
        client = stack.enter_context(_connect(str(scheduler)))
        _check_installed(client)
        yield Workers(client)


def local_cluster(workers: int) -> Any:
    """A distributed.LocalCluster of so many processes, a slot each, to be closed.

    Raises:
        MachineError: Dask is not installed.
    """
    # Dask's own idea of memory would pause or kill workers: ours are asked before they take any.
    options = {"processes": True, "threads_per_worker": 1, "memory_limit": 0, "silence_logs": logging.CRITICAL}
    no_page = {"dashboard_address": "127.0.0.1:0", "scheduler_kwargs": {"dashboard": False}}
    distributed = _import_distributed()
    with _no_interrupts_in_children():
        return distributed.LocalCluster(n_workers=workers, **options, **no_page)


@contextmanager
def _no_interrupts_in_children() -> Iterator[None]:
    """Ctrl-C reaches all processes of a terminal: of ours only this one shall answer, and close the others.

    Threads inherit the mask, and so do the processes that they start, later ones in place of dead ones included.
    """
    if sys.platform == "win32":  # which has no masks: every process of the console gets it
        yield
        return
    resource_tracker.ensure_running()  # begun later, it would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _quiet() -> Iterator[None]:
    """What goes wrong becomes one sentence of ours."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _connect(address: str) -> Any:
    try:
        client = _import_distributed().Client(address, timeout=ANSWER_S, set_as_default=False)
    except OSError as error:
        got, remedy = " ".join(str(error).split())[:120], "check that it runs and that the address is its own"
        raise MachineError(f"scheduler {address}", expected="an answer", got=got, remedy=remedy) from error
    try:
        client.wait_for_workers(1, timeout=JOIN_S)
    except OSError as error:
        client.close()
        raise lost_workers(f"none within {JOIN_S} s", f"start some with 'dask worker {address}'") from error
    return client


def _check_installed(client: Any) -> None:
    """Ask every worker for our version, by a function that any Python has: one of ours would kill it."""
    found = client.run(resolve_name, f"{__name__}:__version__", on_error="return")
    for worker, got in found.items():
        if got != __version__:
            expected, remedy = f"beers-deploy {__version__}", "install it on every machine"
            raise MachineError(f"worker {worker}", expected=expected, got=str(got).lower(), remedy=remedy)


def _import_distributed() -> Any:
    try:
        return import_module("distributed")
    except ImportError as error:
        got, remedy = "no package distributed", "pip install 'beers-deploy[dask]'"
        raise MachineError("--workers, --scheduler", expected="Dask installed", got=got, remedy=remedy) from error
