"""A network small enough for every test, of random weights that are large enough to show a seam."""

from pathlib import Path

import pytest
import torch

from deploy.export import to_onnx
from model.convbeers import BankedConvBEERS, ConvBEERS, initialise, save_network
from model.variants import Variant
from quant.onnx_file import save_onnx


@pytest.fixture(scope="session")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A float network of one block, 8 features and a receptive radius of 5 px."""
    network = ConvBEERS(Variant(blocks=1, features=8))
    initialise(network, torch.Generator().manual_seed(0))
    with torch.no_grad():
        for value in network.parameters():
            value.mul_(2.0)
    path = tmp_path_factory.mktemp("model") / "small.onnx"
    save_onnx(to_onnx(network, {}), path)
    return path


@pytest.fixture
def conditioned(tmp_path: Path) -> Path:
    """Weights of a small conditioned network, as `train --conditioned` leaves them."""
    network, generator = BankedConvBEERS(Variant(blocks=2, features=8)), torch.Generator().manual_seed(0)
    initialise(network, generator)
    torch.nn.init.normal_(network.bias.weight, 0.0, 0.05, generator)
    save_network(tmp_path / "conditioned.safetensors", network, {"degraded": "many"})
    return tmp_path / "conditioned.safetensors"
