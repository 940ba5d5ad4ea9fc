"""What the tests of the traditional pipeline share."""

from collections.abc import Iterator

import pytest
import skimage.data
import torch
from torch import Tensor


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """On images this small a second thread only waits."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def camera() -> Tensor:
    """The photograph of a man behind a camera, (512, 512) float32 grey levels."""
    return torch.from_numpy(skimage.data.camera()).float()
