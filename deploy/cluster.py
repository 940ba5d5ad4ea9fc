"""A Dask cluster: processes of this machine, or the workers of a scheduler elsewhere."""

import logging
import re
import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from multiprocessing import resource_tracker
from pkgutil import resolve_name
from typing import Any

from deploy import __version__
from deploy.cores import require_cores
from deploy.workers import Workers, lost_workers
from profiles.errors import MachineError, OptionError

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
