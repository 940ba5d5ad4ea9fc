"""Networks small enough for every test, with random weights large enough to show a seam."""

from pathlib import Path

import pytest
import torch

from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.convbeers import save_network
from beers_deploy.model.variants import Variant
from beers_deploy.quant.onnx_file import save_onnx
from tests.model.networks import behind_a_bank, plain


@pytest.fixture(scope="session")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a float network of one block, 8 features and a receptive radius of 5 px."""
    network = plain(Variant(blocks=1, features=8))
    with torch.no_grad():
        for value in network.parameters():
            value.mul_(2.0)
    path = tmp_path_factory.mktemp("model") / "small.onnx"
    save_onnx(to_onnx(network, {}), path)
    return path


@pytest.fixture
def conditioned(tmp_path: Path) -> Path:
    """Write weights of a small conditioned network, as `train --conditioned` does."""
    network = behind_a_bank(Variant(blocks=2, features=8), 0.05)
    save_network(tmp_path / "conditioned.safetensors", network, {"degraded": "many"})
    return tmp_path / "conditioned.safetensors"
