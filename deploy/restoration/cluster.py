"""The workers of a Dask scheduler. They only compute; this process alone reads arguments and writes
results.
"""

import logging
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any, TypeVar

from beers_deploy.profiles.errors import MachineError, optional, printable, reason_of

ANSWER_S = 10
JOIN_S = 30
"""Seconds that a scheduler may take to answer, and that a first worker may take to appear."""
POLL_S = 5
WORKERLESS_S = 60
"""Seconds while waiting for a result: the interval at which workers are counted, and how long there
may be none.
"""
PACKAGES = ("beers-deploy", "numpy", "onnxruntime", "scipy")
"""The packages that workers compute with. Every worker must have the versions of this process,
because they determine the last bits.
"""

T = TypeVar("T")


class Cluster:
    """The workers that are connected to a Dask scheduler.

    Attributes:
        pool: an executor of `concurrent.futures` whose calls run on the workers.
    """

    def __init__(self, client: Any) -> None:
        # The client is of distributed, an optional package, so it has no type here.
        self._client = client
        self.pool: Executor = client.get_executor(pure=False)

    @property
    def slots(self) -> int:
        """The number of calls that run at once: the threads of all workers.

        Raises:
            MachineError: the connection to the scheduler is lost.
        """
        try:
            return sum(self._client.nthreads().values())
        except OSError as error:
            raise _cluster_error(UNCONNECTED, "Start it again") from error

    def share(self, value: T) -> T:
        """Send a value to the workers once, for use in many calls.

        The scheduler sends the value again if all workers that had it died.

        Args:
            value: any value that can be pickled.

        Returns:
            A future of Dask. A call of `pool` that is given this future as an argument receives the
            value.
        """
        # A call that is given this future receives its result.
        standing: T = self._client.submit(_itself, value, pure=False)
        return standing

    def result(self, call: "Future[T]") -> T:
        """Wait for a call on the workers, and return its result.

        Args:
            call: a future that `pool` returned.

        Raises:
            MachineError: there has been no worker for `WORKERLESS_S` seconds, or the connection to
                the scheduler is lost.
        """
        seen_s = time.monotonic()
        while True:
            try:
                return call.result(POLL_S)
            # A call may take any time, but a cluster without workers never finishes it.
            except TimeoutError:
                seen_s = time.monotonic() if self.slots else seen_s
                if time.monotonic() - seen_s > WORKERLESS_S:
                    raise _cluster_error(
                        f"The scheduler has had no workers for {WORKERLESS_S} s.", "Start some"
                    ) from None


def _itself(value: T) -> T:
    return value


@contextmanager
def open_cluster(scheduler: str | None) -> Iterator[Cluster | None]:
    """Connect to the workers of a Dask scheduler for as long as a run needs them.

    Args:
        scheduler: the address of the scheduler; None uses no workers.

    Yields:
        The workers, or None without an address.

    Raises:
        MachineError: the scheduler does not answer, has no workers, or workers have other versions
            of the packages that determine the result; or, within the context, the connection is
            lost or several workers die during the same call.
        MissingExtraError: the package distributed is not installed.
    """
    if scheduler is None:
        yield None
        return
    distributed = optional("distributed", "scheduler")
    with _quiet(), _connect(distributed, scheduler) as client:
        _require_same_versions(client)
        try:
            yield Cluster(client)
        except distributed.KilledWorker as error:
            raise _cluster_error(
                "Several workers died during the same call.",
                "Give them more memory, or use smaller tiles",
            ) from error
        except CancelledError as error:
            raise _cluster_error(UNCONNECTED, "Start it again") from error


UNCONNECTED = "The connection to the scheduler of the workers was lost."


def _cluster_error(fault: str, remedy: str) -> MachineError:
    return MachineError(f"{fault} {remedy}, and go on with `resume`.")


def _connect(distributed: Any, address: str) -> Any:
    try:
        # A client that has no valid address waits for 20 s when it is deleted, and fails then.
        distributed.comm.resolve_address(address)
        client = distributed.Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, ValueError) as error:
        reason = reason_of(error)
        raise MachineError(
            f"The scheduler {printable(address)} does not answer: {reason}. Give its address, such "
            "as tcp://host:8786."
        ) from error
    try:
        client.wait_for_workers(1, timeout=JOIN_S)
    except OSError as error:
        client.close()
        raise _cluster_error(
            f"No worker joined the scheduler within {JOIN_S} s.",
            f"Start some with 'dask worker {address}'",
        ) from error
    return client


def _require_same_versions(client: Any) -> None:
    """Raise MachineError unless every worker has the versions of this process. The function that
    is sent to them is of Python's standard library, because a function of this package would kill a
    worker that lacks the package.
    """
    for package in PACKAGES:
        here = version(package)
        for worker, there in client.run(version, package, on_error="return").items():
            if there != here:
                raise MachineError(
                    f"The worker {worker} must have {package} {here} as on this machine, got "
                    f"{printable(str(there))}. Install the same versions on every machine."
                )


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Dask's own messages, because errors become one sentence of ours."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
