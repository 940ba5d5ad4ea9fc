"""Read whole files that a user names, and tell why a path cannot be read."""

import stat
from pathlib import Path

LFS_POINTER = b"version https://git-lfs"
QUOTED = 80
"""The maximum number of characters that a message shows of a line or a key."""
TOO_DEEP = "too many levels of nesting"
"""The reason for which a TOML or JSON text is refused when its parser runs out of stack."""


def read_whole(path: Path, limit_bytes: int) -> bytes:
    """Read all bytes of a file that is not larger than expected.

    Raises:
        ValueError: the path is no regular file, a Git LFS pointer, or larger than `limit_bytes`.
        OSError: the file does not exist or cannot be opened.
    """
    status = path.stat()
    if reason := unreadable(path):
        raise ValueError(reason)
    if status.st_size > limit_bytes:
        raise ValueError(f"it has more than {limit_bytes} bytes")
    return path.read_bytes()


def unreadable(path: Path) -> str | None:
    """Return the reason why a path cannot be read as a file, as a phrase for a message, or None if
    it can be read.

    Git LFS stores a pointer in place of each large file that was not fetched: 130 bytes of text
    under the name of the file.
    """
    try:
        mode = path.stat().st_mode
        # Opening a pipe would wait for its other end.
        if not stat.S_ISREG(mode):
            return "it is a folder" if stat.S_ISDIR(mode) else "it is not a regular file"
        with path.open("rb") as stream:
            if stream.read(len(LFS_POINTER)) == LFS_POINTER:
                return "it is a Git LFS pointer to the file, which 'git lfs pull' fetches"
    except FileNotFoundError:
        return "no such file"
    # One reason is a name that is too long, another that its user may not read it.
    except OSError as error:
        return error.strerror or str(error)
    return None
