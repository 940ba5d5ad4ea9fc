"""One run at a time on one output. The system holds the lock, so that one left by a killed process blocks nobody."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from profiles.errors import MachineError

NAME = "lock"


@contextmanager
def only_run(out: Path, folder: Path) -> Iterator[None]:
    """Hold `folder`, where a run keeps what it needs for `out`; in the end it is gone, unless rows were left in it.

    It locks nothing on Windows, nor on a disk that has no locks, as some of networks.

    Raises:
        MachineError: another run holds it, or it cannot be made.
    """
    handle = _take(out, folder)
    try:
        yield
    finally:
        with suppress(OSError):  # rows for --resume lie there
            if handle is not None and _leads_to(folder / NAME, handle):
                (folder / NAME).unlink()  # while it is ours: whoever opens it now finds out and begins again
            folder.rmdir()
        if handle is not None:
            os.close(handle)


def _take(out: Path, folder: Path) -> int | None:
    """The lock, as an open file; None where there are no locks."""
    if sys.platform == "win32":
        return None
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            handle = os.open(folder / NAME, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # the folder went with a run that ended just now
            continue
        except OSError as error:
            got, remedy = error.strerror or str(error), "choose another path"
            raise MachineError(str(folder), expected="a folder to write to", got=got, remedy=remedy) from error
        if not _lock(handle):
            os.close(handle)
            got, remedy = "another one at work", "wait for its end or choose another output"
            raise MachineError(str(out), expected="no other run on this output", got=got, remedy=remedy)
        if _leads_to(folder / NAME, handle):
            return handle
        os.close(handle)  # of a run that ended just now


def _lock(handle: int) -> bool:
    """Whether no other process holds the lock."""
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a disk without locks
        return True
    return True


def _leads_to(path: Path, handle: int) -> bool:
    """Whether the path is still that of the open file."""
    try:
        return os.path.samestat(path.stat(), os.fstat(handle))
    except FileNotFoundError:
        return False
