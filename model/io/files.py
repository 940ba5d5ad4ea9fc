"""Write files completely or not at all, and never over a file that a run reads or writes elsewhere.

One rule applies to every output of every command: it is a regular file or a new name, no input and
no other output. Symbolic links, pipes and devices are rejected, because a file renamed over them
would replace them.
"""

import hashlib
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

from beers_deploy.profiles.errors import MachineError, OptionError, printable

TIFF_SUFFIXES = {".tif", ".tiff"}
IMAGE_SUFFIXES = TIFF_SUFFIXES | {".png", ".jpg", ".jpeg"}
READ_SUFFIXES = IMAGE_SUFFIXES | {".onnx", ".safetensors", ".pth"}
"""The suffixes of files that a command reads from a folder. Results of an earlier run may lie in
the same folder and be overwritten.
"""

URL = re.compile(r"[a-z][a-z0-9+.-]+:/|/vsi", re.IGNORECASE)
"""The beginning of a URL, of which a path retains one slash, or of a virtual path of GDAL.

A URL would become folders of these names, and rasterio would take either for a place on a network.
"""


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to `path`; rename it to `path` if the block succeeds, otherwise
    remove it.
    """
    require_regular(path)
    temporary = _part_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
        mode = temporary.stat().st_mode
        yield temporary
        # safetensors makes files that only their owner can read.
        temporary.chmod(mode)
        temporary.replace(path)
    except OSError as error:
        raise _unwritable(path, error.strerror or str(error)) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def require_writable(
    *paths: Path | None, inputs: Iterable[Path | None] = (), folders: Iterable[Path | None] = ()
) -> None:
    """Raise an error before long work if an output may not or cannot be written; None means no
    output.

    Args:
        paths: files that are to be written.
        inputs: files that are read, and folders from which files are read; a path that does not
            exist is ignored. A hard link or a symbolic link to an input is that input.
        folders: folders that are to be filled with images whose names are not known yet; no image
            that is read may lie there.
    """
    outputs = [path for path in paths if path is not None]
    image_folders = [path for path in folders if path is not None]
    _require_apart(outputs, image_folders, inputs)
    for folder in image_folders:
        if os.path.lexists(folder) and not folder.is_dir():
            raise MachineError(f"{folder} is not a folder. Choose another path.")
    for output in outputs:
        require_regular(output)
        # Written in the nearest existing folder: a new one would remain if the command fails later.
        path = output.absolute()
        folder = next(parent for parent in path.parents if os.path.lexists(parent))
        try:
            with TemporaryDirectory(dir=folder) as probe:
                place = probe / path.relative_to(folder)
                place.parent.mkdir(parents=True, exist_ok=True)
                _part_of(place).touch()
        except OSError as error:
            raise _unwritable(path, error.strerror or str(error)) from error


def _require_apart(
    outputs: list[Path], image_folders: list[Path], inputs: Iterable[Path | None]
) -> None:
    """Raise an error if an output is an input or another output, or a folder to be filled contains
    inputs.
    """
    sources = [path for path in inputs if path is not None]
    # Path.is_dir would raise where a folder may not be entered.
    folders = list(filter(os.path.isdir, sources))
    files = [path for path in sources if path not in folders]
    for folder in folders:
        # The files in it that a command may read.
        files += [file for file in folder.glob("*") if file.suffix.lower() in READ_SUFFIXES]
    images = [file for file in files if file.suffix.lower() in IMAGE_SUFFIXES]
    # A path that does not exist has no identity, and cannot collide with another.
    identities = {_identity(file) for file in files} - {None}
    homes = {_identity(image.parent) for image in images} - {None}
    for places, occupied, use in (
        (outputs, identities, "is an input of this run"),
        (image_folders, homes, "is the folder of an input"),
    ):
        for path in places:
            if _identity(path) in occupied:
                raise _taken(path, use)
    for one, other in combinations(outputs, 2):
        # Some disks know no capitals.
        if os.path.realpath(one).casefold() == os.path.realpath(other).casefold():
            raise _taken(other, f"is the path of another output, {one}")


def require_regular(path: Path) -> None:
    """Raise MachineError if an output is an existing folder, link, pipe or device, or no file of
    this machine.
    """
    if URL.match(path.as_posix()):
        raise MachineError(
            f"{printable(str(path))} is not on this machine, where an output must be. Write a "
            "file, and copy it there."
        )
    if os.path.lexists(path) and (path.is_symlink() or not path.is_file()):
        kind = "is not a regular file"
        if path.is_symlink():
            kind = "is a symbolic link"
        elif path.is_dir():
            kind = "is a folder"
        raise MachineError(
            f"{path} {kind}, but an output must be a regular file or a new name. Choose another "
            "path."
        )


def _part_of(path: Path) -> Path:
    """Return the path at which a file is written before it is whole."""
    return path.with_name(f".{path.name}.{os.getpid()}.part")


def _identity(path: Path) -> tuple[int, int] | None:
    """Return device and inode of a file, which all its names share; None if it cannot be read."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _taken(path: Path, use: str) -> OptionError:
    return OptionError(
        f"{path} {use}, but each output needs a place of its own. Choose another path."
    )


def _unwritable(path: Path, reason: str) -> MachineError:
    return MachineError(
        f"{printable(str(path))} cannot be written: {reason.rstrip('.')}. Choose another path."
    )


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, whole or not at all, and the same bytes on every system: lines end as
    they do in it.
    """
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


def sha256(path: Path) -> str:
    """Compute the hex digest of a file, read in pieces."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
