"""Load weights that a model stores in a separate file: from the model's own folder only.

Exporters write such a file for large networks, and torch's newer exporter for all. Only
initializers are loaded. `quant.untrusted.check_content` runs afterwards on everything, and rejects
other tensors that are stored elsewhere.
"""

import hashlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from google.protobuf.message import DecodeError
from onnx import ModelProto, TensorProto

from beers_deploy.model.io.files import sha256
from beers_deploy.profiles.errors import ModelError, printable
from beers_deploy.profiles.user_files.whole import read_whole, unreadable
from beers_deploy.quant.untrusted import FILE_BYTES, VALUE_BYTES, check_size


def take_in(model: ModelProto, path: Path) -> None:
    """Load the weights that a model stores in a separate file into the model itself.

    Args:
        model: the parsed model, which is changed in place.
        path: the model's file. Weights are loaded from its folder, or from folders within it.

    Raises:
        ModelError: the weights are missing, too large, or elsewhere.
    """
    used_bytes = 0
    for tensor in model.graph.initializer:
        if tensor.data_location == TensorProto.EXTERNAL:
            content = _content(tensor, path, FILE_BYTES - used_bytes)
            used_bytes += len(content)
            tensor.ClearField("external_data")
            tensor.ClearField("data_location")
            tensor.raw_data = content


def network_sha256(path: Path) -> str:
    """Compute the SHA-256 of a network's file and of the separate files that hold its weights."""
    digest = sha256(path)
    if path.suffix != ".onnx":
        return digest
    model = ModelProto()
    try:
        model.ParseFromString(read_whole(path, FILE_BYTES))
    except (DecodeError, OSError, ValueError):
        # It is no network, which the reader of the file reports.
        return digest
    apart = [tensor for tensor in model.graph.initializer if tensor.external_data]
    files = sorted({_weights_file(tensor, path) for tensor in apart})
    if not files:
        return digest
    digests = "".join([digest, *map(sha256, files)])
    return hashlib.sha256(digests.encode()).hexdigest()


@contextmanager
def unchanged(path: Path) -> Iterator[str]:
    """Guard the reading of a network's file, and yield the file's SHA-256.

    The digest is that of the bytes that are read within the block, because the file is checked
    again at the end. It is empty if there is no file, about which the reader raises an error.

    Args:
        path: the network's file.

    Raises:
        ModelError: the file changed within the block.
    """
    before = network_sha256(path) if path.is_file() else ""
    yield before
    if before and network_sha256(path) != before:
        raise ModelError(
            f"{path} changed while it was read. Wait until it is written, then run this again."
        )


def _entries(tensor: TensorProto) -> dict[str, str]:
    return {entry.key: entry.value for entry in tensor.external_data}


def _content(tensor: TensorProto, path: Path, limit_bytes: int) -> bytes:
    """Read the bytes of one tensor, of the number that its sizes require, or raise ModelError."""
    entries = _entries(tensor)
    check_size(tensor.name, tensor.dims, str(path))
    if tensor.data_type not in VALUE_BYTES or min(tensor.dims, default=0) < 0:
        raise _refused(tensor, path, "their type is not one of plain numbers")
    size = math.prod(tensor.dims) * VALUE_BYTES[tensor.data_type]
    if size > limit_bytes:
        raise _refused(tensor, path, f"the model would be more than {FILE_BYTES} bytes in all")
    texts = entries.get("offset", "0"), entries.get("length", str(size))
    start, length = (
        int(text) if text.isascii() and text.isdigit() and len(text) < 19 else None
        for text in texts
    )
    file = _weights_file(tensor, path)
    if start is None or length != size or start + size > file.stat().st_size:
        raise _refused(
            tensor, path, f"{file.name!r} does not hold the {size} bytes of these weights"
        )
    with file.open("rb") as stream:
        stream.seek(start)
        return stream.read(size)


def _weights_file(tensor: TensorProto, path: Path) -> Path:
    """Return the regular file of the weights, in the model's folder or below and reached by no
    link.

    Raises ModelError for any other location.
    """
    location = _entries(tensor).get("location", "")
    # Files that were written on Windows have backslashes between folders.
    parts = PurePosixPath(location.replace("\\", "/")).parts
    if (
        not parts
        or location.startswith(("/", "\\"))
        or ".." in parts
        or ":" in location
        or "\0" in location
    ):
        raise _refused(tensor, path, f"{location!r} is outside the model's folder")
    # A link in any folder on the way could lead out of the model's own folder.
    places = [path.parent.joinpath(*parts[: number + 1]) for number in range(len(parts))]
    if any(place.is_symlink() for place in places):
        raise _refused(tensor, path, f"{location!r} is a link")
    if reason := unreadable(places[-1]):
        raise _refused(tensor, path, f"{location!r} cannot be read ({reason})")
    return places[-1]


def _refused(tensor: TensorProto, path: Path, reason: str) -> ModelError:
    return ModelError(
        f"{path} stores the weights {printable(repr(tensor.name))} in another file, which is "
        f"refused, because {printable(reason)}. Copy its data file into the model's folder, or "
        "save both as one file."
    )
