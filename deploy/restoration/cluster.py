"""The workers of a Dask scheduler: they compute, and this process alone reads arguments and writes
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
"""How long a scheduler may take to answer, and a first worker to be there."""
POLL_S = 5
WORKERLESS_S = 60
"""While a result is waited for: how often workers are counted, and how long there may be none."""
PACKAGES = ("beers-deploy", "numpy", "onnxruntime", "scipy")
"""Workers compute with these, so every worker must have the versions of this process: they decide
the last bits.
"""

T = TypeVar("T")


class Cluster:
    """The workers that are connected to a scheduler.

    Attributes:
        pool: an executor of `concurrent.futures` whose calls run on them.
    """

    def __init__(self, client: Any) -> None:
        # The client is of distributed, an optional package, so it has no type here.
        self._client = client
        self.pool: Executor = client.get_executor(pure=False)

    @property
    def slots(self) -> int:
        """Calls that run at once: the threads of all workers."""
        try:
            return sum(self._client.nthreads().values())
        except OSError as error:
            raise _lost(UNCONNECTED, "Start it again") from error

    def share(self, value: T) -> T:
        """What stands for a value in calls: it is sent once, and again where all workers that held
        it died.
        """
        # A call that is given this future receives its result.
        standing: T = self._client.submit(_itself, value, pure=False)
        return standing

    def result(self, call: "Future[T]") -> T:
        """What a call returns, as soon as it has."""
        seen_s = time.monotonic()
        while True:
            try:
                return call.result(POLL_S)
            # A call may take any time, but a cluster without workers never finishes it.
            except TimeoutError:
                seen_s = time.monotonic() if self.slots else seen_s
                if time.monotonic() - seen_s > WORKERLESS_S:
                    raise _lost(
                        f"The scheduler has had no workers for {WORKERLESS_S} s.", "Start some"
                    ) from None


def _itself(value: T) -> T:
    return value


@contextmanager
def open_cluster(scheduler: str | None) -> Iterator[Cluster | None]:
    """The workers of a scheduler by its address; None where no address is given."""
    if scheduler is None:
        yield None
        return
    distributed = optional("distributed", "scheduler")
    with _quiet(), _connect(distributed, scheduler) as client:
        _require_same_versions(client)
        try:
            yield Cluster(client)
        except distributed.KilledWorker as error:
            raise _lost(
                "Several workers died during the same call.",
                "Give them more memory, or use smaller tiles",
            ) from error
        except CancelledError as error:
            raise _lost(UNCONNECTED, "Start it again") from error


UNCONNECTED = "The connection to the scheduler of the workers was lost."


def _lost(fault: str, remedy: str) -> MachineError:
    return MachineError(f"{fault} {remedy}, and go on with `resume`.")


def _connect(distributed: Any, address: str) -> Any:
    try:
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
        raise _lost(
            f"No worker joined the scheduler within {JOIN_S} s.",
            f"Start some with 'dask worker {address}'",
        ) from error
    return client


def _require_same_versions(client: Any) -> None:
    """Ask every worker by a function that any Python has: one of ours would kill a worker without
    our package.
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
    """Without Dask's own messages: what goes wrong becomes one sentence of ours."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
