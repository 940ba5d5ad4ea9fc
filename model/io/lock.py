"""Allow one run at a time on one output. The system holds the lock, so that a killed process does
not block others.
"""

import errno
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from beers_deploy.profiles.errors import MachineError


def part_folder(out: Path) -> Path:
    """Return the folder next to `out` in which a run stores its temporary files."""
    return out.with_name(f".{out.name}.part")


NAME = "lock"
GRACE_S = 0.2
"""The time to wait for a run that is just ending. It removes the lock file, and the waiting run
creates a new one.
"""
ENOTSUPP = 524
"""An error number of Linux, in addition to ENOTSUP, that some network file systems return."""
NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, ENOTSUPP)


@contextmanager
def only_run(out: Path) -> Iterator[None]:
    """Lock and create the folder of a run's temporary files, so that no second run writes the same
    `out`; remove the folder at the end.

    The folder remains if it still contains rows. Parent folders that were created for it are
    removed too, unless something was written there. On a disk without locks, such as some network
    disks, nothing is locked.
    """
    folder = part_folder(out)
    created = [parent for parent in folder.parents if not parent.exists()]
    lock = _take(out, folder)
    try:
        yield
    finally:
        # Removed while the lock is held: another run that has opened it detects that and begins
        # again. Windows cannot remove an open file: there it is removed by the release.
        with suppress(OSError):
            (folder / NAME).unlink()
        with suppress(OSError):
            lock.release()
        # A folder that holds rows for --resume is not empty, and stays.
        with suppress(OSError):
            for place in (folder, *created):
                place.rmdir()


def _take(out: Path, folder: Path) -> BaseFileLock:
    """Acquire the lock and return it; if the file system has no locks, it is not acquired."""
    # A file without a lock on it would outlive a killed run, so there is none if the system has no
    # locks.
    if folder.is_symlink():
        raise MachineError(
            f"{folder} must be a folder of this program, but it is a symbolic link. Remove it, or "
            "choose another output."
        )
    lock = FileLock(folder / NAME, timeout=GRACE_S, thread_local=False, fallback_to_soft=False)
    until_s = time.monotonic() + GRACE_S
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except Timeout as error:
            raise MachineError(
                f"Another run is at work on the output {out}. Wait until it ends, or choose "
                "another output."
            ) from error
        except OSError as error:
            if isinstance(error, FileNotFoundError) and time.monotonic() < until_s:
                continue  # The folder went with a run that ended just now.
            if error.errno not in NO_LOCKS:
                reason = error.strerror or str(error)
                raise MachineError(
                    f"The folder {folder} cannot be written: {reason}. Choose another path."
                ) from error
        return lock
