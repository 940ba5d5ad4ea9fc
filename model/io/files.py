"""Whole files or none, and never over what a run reads or writes elsewhere.

One rule for every output of every command: it is a regular file or a new name, no input, no other output, and nothing
that is shipped.
Symbolic links, pipes and devices are refused: what is renamed over them would stand in their place.
"""

import hashlib
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import combinations
from pathlib import Path

from beers_deploy.model.shipped import SHIPPED
from beers_deploy.profiles.errors import MachineError, OptionError
from beers_deploy.profiles.toml import HERE as PROFILES

TIFF_SUFFIXES = {".tif", ".tiff"}
IMAGE_SUFFIXES = TIFF_SUFFIXES | {".png", ".jpg", ".jpeg"}
READ_SUFFIXES = IMAGE_SUFFIXES | {".onnx", ".safetensors", ".pth"}
"""What a command takes from a folder that it reads; an earlier run's figures may lie there and be renewed."""
KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` when the block ends well, else remove it.

    Raises:
        MachineError: no regular file stands there, the folder cannot be made or written to, or the disk is full.
    """
    require_regular(path)
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


def claim_outputs(
    *outputs: Path | None, inputs: Iterable[Path | None] = (), folders: Iterable[Path | None] = ()
) -> None:
    """Refuse, before any work, an output that would destroy an input, another output or what is shipped.

    None asks for no output.

    Args:
        outputs: files that are to be written.
        inputs: files that are read, and folders from which files are; what does not exist is passed over. A hard
            link or a symbolic link to an input is that input.
        folders: are to be filled with images whose names are not known yet: no image that is read may lie there.
    """
    read = [file for path in inputs if path is not None for file in _files_of(path)]
    known, wanted = {_identity(file) for file in read}, [path for path in outputs if path is not None]
    for path in wanted:
        if _exists(path) and _identity(path) in known:
            raise _taken(path, "an input of this run")
        if _is_shipped(path):
            raise _taken(path, "a file of this installation, which every later run reads")
    homes = {_identity(file.parent) for file in read if file.suffix.lower() in IMAGE_SUFFIXES}
    for folder in folders:
        if folder is not None and _exists(folder) and _identity(folder) in homes:
            raise _taken(folder, "the folder of an input")
    for one, other in combinations(wanted, 2):
        if _overlap(one, other):
            raise _taken(other, f"a place that another output takes: {one}")


def require_writable(
    *paths: Path | None, inputs: Iterable[Path | None] = (), folders: Iterable[Path | None] = ()
) -> None:
    """Find out before long work, not after it, that an output may not or cannot be written; None asks for no output.

    Args:
        paths: files that are to be written.
        inputs: as of `claim_outputs`.
        folders: as of `claim_outputs`.

    Raises:
        OptionError: an output that is an input, or another output.
        MachineError: no regular file stands at a path, or its folder cannot be made or written to.
    """
    folders = list(folders)
    claim_outputs(*paths, inputs=inputs, folders=folders)
    for folder in folders:
        if folder is not None and os.path.lexists(folder) and not folder.is_dir():
            raise MachineError(str(folder), expected="a folder", got="something else", remedy="choose another path")
    for path in paths:
        require_regular(path)
    for path in paths:
        if path is not None:
            _probe(path)


def require_regular(path: Path | None) -> None:
    """Refuse an output at which a folder, a link, a pipe or a device stands; a regular file or nothing may."""
    if path is None or not os.path.lexists(path):
        return
    kind = stat.S_IFMT(path.lstat().st_mode)
    if kind != stat.S_IFREG:
        raise _unwritable(path, KINDS.get(kind, "no regular file"), expected="a regular file or a new name")


def _probe(path: Path) -> None:
    """Try to write into the nearest folder that exists: a new one would outlive a command that is refused later."""
    path = path.absolute()
    try:
        folder = next(parent for parent in path.parents if _stands(parent))
        for name in path.parent.relative_to(folder).parts:
            _stands(folder / name)  # a new folder's name may be too long for this disk
        probe = folder / f".{path.name}.{os.getpid()}.probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise _unwritable(path, error.strerror or str(error)) from error


def _stands(path: Path) -> bool:
    """Whether something stands there, a link to nothing included; what cannot be asked for is an error."""
    try:
        path.lstat()
    except FileNotFoundError:
        return False
    return True


def _exists(path: Path) -> bool:
    """Whether something is there, through links; what cannot be asked for, as a name that is too long, is not."""
    try:
        return path.exists()
    except OSError:
        return False


def _identity(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_dev, found.st_ino


def _is_shipped(path: Path) -> bool:
    """Whether a shipped network or profile stands there, through links."""
    shipped = [*SHIPPED.glob("*"), *PROFILES.rglob("*.toml")]
    return _exists(path) and _identity(path) in {_identity(file) for file in shipped}


def _files_of(path: Path) -> list[Path]:
    """An input as files: itself, or those of a folder that a command may read."""
    if path.is_dir():
        return [file for file in path.glob("*") if file.suffix.lower() in READ_SUFFIXES and _exists(file)]
    return [path] if _exists(path) else []


def _overlap(one: Path, other: Path) -> bool:
    """Whether two outputs are one file, or one would have to be the other's folder; some disks know no capitals.

    What is a folder already is refused as such, whatever is to be written into it.
    """
    a, b = (Path(os.path.realpath(path).casefold()) for path in (one, other))
    linked = _exists(one) and _exists(other) and _identity(one) == _identity(other)
    inside = (a in b.parents and not one.is_dir()) or (b in a.parents and not other.is_dir())
    return linked or a == b or inside


def _taken(path: Path, got: str) -> OptionError:
    return OptionError(
        str(path), expected="a place of its own for each output", got=got, remedy="choose another path"
    )


def _unwritable(path: Path, got: str, expected: str = "a place to write to") -> MachineError:
    return MachineError(str(path), expected=expected, got=got, remedy="choose another path")


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, whole or not at all, and the same bytes on every system: lines end as they do in it."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


def sha256(path: Path) -> str:
    """Hex digest of a file's bytes, read in pieces."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
