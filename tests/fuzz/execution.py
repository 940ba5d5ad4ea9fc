"""One execution: a damaged file in a folder of its own, read under limits of time and memory."""

import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Literal
from unittest.mock import patch

from profiles.errors import BeersError

CPU_S = 5.0
MEMORY_BYTES = 1 << 30
FREE_BYTES = 1 << 28
"""What the machine seems to have free: parsers that ask may take much of it."""


Outcome = Literal["read", "refused"]
"""What may happen: the file was read, or refused by a sentence."""


class TooLongError(BaseException):
    """Raised by the timer; a BaseException, so that no parser takes it for a fault of the file."""


@dataclass(frozen=True)
class Finding:
    """What went wrong, in one line, and in full."""

    kind: str
    detail: str


def execute(parse: Callable[[Path], object], content: bytes, path: Path) -> Finding | Outcome:
    """Write `content` to `path` and read it."""
    outcome: Outcome = "read"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    try:
        with _limited_time():
            parse(path)
    except BeersError as error:
        outcome = "refused"
        message = str(error)
        if "\n" in message or len(message) > 4000 or not message.isprintable():
            return Finding("no sentence", message[:2000])
    except TooLongError:
        return Finding(f"more than {CPU_S:g} s", traceback.format_exc())
    except Exception as error:  # noqa: BLE001 - whatever it is, it is what is looked for
        return Finding(f"{type(error).__name__}", traceback.format_exc())
    left = sorted(p.relative_to(path.parent.parent) for p in path.parent.parent.rglob("*"))
    if left != [Path(path.parent.name), path.relative_to(path.parent.parent)] or path.read_bytes() != content:
        return Finding("wrote", f"{left}")
    return outcome


@contextmanager
def little_memory() -> Iterator[None]:
    """The machine seems to have little free memory."""
    with patch("psutil.virtual_memory", lambda: SimpleNamespace(available=FREE_BYTES, total=FREE_BYTES)):
        yield


def limit_memory() -> None:
    """For good, in a process of its own, on Linux: no more address space than it has now, and MEMORY_BYTES."""
    if sys.platform != "linux":
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


@contextmanager
def _limited_time() -> Iterator[None]:
    """By the process's own time, so that a busy machine makes no finding; Windows has no such timer."""
    if sys.platform == "win32":
        with warnings.catch_warnings(action="ignore"):
            yield
        return

    def ring(*_: object) -> None:
        raise TooLongError

    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, CPU_S)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
