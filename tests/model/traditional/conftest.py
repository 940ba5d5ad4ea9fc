"""What the tests of the traditional pipeline share."""

import pytest
import skimage.data
import torch
from torch import Tensor


@pytest.fixture(scope="session")
def camera() -> Tensor:
    """The photograph of a man behind a camera, (512, 512) float32 grey levels."""
    return torch.from_numpy(skimage.data.camera()).float()
