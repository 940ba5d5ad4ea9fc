"""What is read of a file of weights is a copy: Windows replaces no file that is held, such as a checkpoint."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from torch import Tensor

from beers_deploy.model.io.tensors import read_tensors, write_tensors
from beers_deploy.model.metrics import perceptual

LARGE = np.arange(20_000, dtype=np.float32).reshape(100, 200)
TENSORS = {"small": np.arange(3, dtype=np.float32), "large": LARGE}

Read = Callable[[Path], Mapping[str, np.ndarray | Tensor]]


def is_copy(read: Read, path: Path) -> bool:
    """Whether tensors keep their values when somebody writes into their file, which is then replaced."""
    write_tensors(path, TENSORS, {})
    size = path.stat().st_size
    found = read(path)
    with path.open("r+b") as file:
        file.write(bytes(size))
    kept = all(np.array_equal(np.asarray(found[name]), value) for name, value in TENSORS.items())
    write_tensors(path, TENSORS, {})
    return kept


@pytest.mark.parametrize(
    "read", [lambda path: read_tensors(path)[0], lambda path: perceptual.read_tensors(path, TENSORS)]
)
def test_what_was_read_does_not_change_with_its_file(read: Read, tmp_path: Path) -> None:
    assert is_copy(read, tmp_path / "w.safetensors")
