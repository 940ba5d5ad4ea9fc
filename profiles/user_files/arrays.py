"""Read NumPy files from untrusted sources, without unpickling, and tensors of torch.

Any damage of a file is reported as one reason.
"""

from pathlib import Path
from typing import Any

import numpy as np

from beers_deploy.profiles.errors import ImageError, reason_of
from beers_deploy.profiles.user_files.whole import unreadable

ZIP = b"PK"
"""The first bytes of a ZIP archive, which a truncated archive has too."""
ALONE = ""
"""The name under which the array of a .npy file is returned."""


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Load the arrays of a .npz or .npy file.

    The content determines which of the two a file is, not its name.

    Args:
        path: the path of the file.

    Returns:
        A dictionary from the name of an array to the array. A .npy file has one array, under the
        name `ALONE` (the empty text); it is memory-mapped, so that its pixels are read only when
        they are used.

    Raises:
        ValueError: the file cannot be read, holds no arrays, or holds damaged ones; the message is
            the reason.
    """
    reason = unreadable(path)
    if reason is not None:
        raise ValueError(reason)
    try:
        with path.open("rb") as stream:
            is_archive = stream.read(len(ZIP)) == ZIP
        if not is_archive:
            return {ALONE: np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))}
        # NumPy leaves a broken archive open, so the stream is closed here.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {name: np.asarray(archive[name]) for name in archive.files}
    except (AttributeError, ImportError, NameError):
        # NumPy was called with an argument that it does not have, whatever the file contains.
        raise
    except MemoryError:
        raise ValueError("an array does not fit into memory") from None
    # Each decompressor and the parser of NumPy's header raise classes of their own.
    except Exception as error:
        # NumPy's own message advises to load any other file unsafely.
        raise ValueError("it has another format, or is damaged") from error


def array_of(tensor: Any, name: str) -> np.ndarray:
    """Return the values of a tensor of torch, on any device, with or without a gradient.

    Args:
        tensor: the tensor.
        name: the name of the parameter, for the message.

    Raises:
        ImageError: NumPy has no such array, for example of bfloat16 or of a sparse tensor.
    """
    try:
        return np.asarray(tensor.detach().cpu().numpy())
    except (RuntimeError, TypeError) as error:
        raise ImageError(
            f"`{name}` has a tensor that NumPy does not read: {reason_of(error)}. Convert it, for "
            "example with .float() or .to_dense()."
        ) from error
