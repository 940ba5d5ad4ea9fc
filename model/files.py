"""Whole files or none: outputs are written under a temporary name and renamed at the end."""

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from profiles.errors import MachineError


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` when the block ends well, else remove it.

    Raises:
        MachineError: the folder cannot be made or written to, or the disk is full.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
        mode = temporary.stat().st_mode
        yield temporary
        temporary.chmod(mode)  # safetensors makes files that only their owner can read
        temporary.replace(path)
    except OSError as error:
        raise _unwritable(path, error.strerror or str(error)) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def require_writable(*paths: Path | None) -> None:
    """Find out before long work, not after it, that an output cannot be written; None asks for no output.

    Raises:
        MachineError: a path is a folder, or its folder cannot be made or written to.
    """
    for path in paths:
        if path is None:
            continue
        if path.is_dir():
            raise _unwritable(path, "a folder")
        probe = path.with_name(f".{path.name}.{os.getpid()}.probe")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise _unwritable(path, error.strerror or str(error)) from error


def _unwritable(path: Path, got: str) -> MachineError:
    return MachineError(str(path), expected="a place to write to", got=got, remedy="choose another path")


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, whole or not at all, and the same bytes on every system: lines end as they do in it."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


def sha256(path: Path) -> str:
    """Hex digest of a file's bytes, read in pieces."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
