"""Fixtures of the tests of the traditional pipeline."""

import pytest
import skimage.data
import torch
from torch import Tensor


@pytest.fixture(scope="session")
def camera() -> Tensor:
    """Return the photograph of a man behind a camera, (512, 512) float32 grey levels."""
    return torch.from_numpy(skimage.data.camera()).float()
