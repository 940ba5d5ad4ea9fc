from pathlib import Path

import onnx
import pytest
import torch

from deploy.export import parity, to_onnx
from model.convbeers import ConvBEERS, Variant, initialise
from quant.onnx_file import fixed_tile_px, metadata, save_onnx


@pytest.fixture(scope="module")
def network() -> ConvBEERS:
    network = ConvBEERS(Variant(blocks=2, features=8))
    initialise(network, torch.Generator().manual_seed(0))
    return network.eval()


@pytest.mark.parametrize("tile_px", [None, 40])
def test_torch_and_onnxruntime_agree(network: ConvBEERS, tile_px: int | None, tmp_path: Path) -> None:
    path = tmp_path / "float.onnx"
    save_onnx(to_onnx(network, {"variant": "test"}, tile_px), path)
    assert parity(network, path, tile_px or 33) < 1e-6
    assert fixed_tile_px(onnx.load(path)) == tile_px


def test_parity_notices_other_weights(network: ConvBEERS, tmp_path: Path) -> None:
    path = tmp_path / "float.onnx"
    save_onnx(to_onnx(network, {}), path)
    other = ConvBEERS(network.variant)
    initialise(other, torch.Generator().manual_seed(1))
    assert parity(other.eval(), path, 33) > 1e-4


def test_the_file_names_its_variant(network: ConvBEERS) -> None:
    assert metadata(to_onnx(network, {"variant": "test"}))["variant"] == "test"


def test_a_relu_stands_behind_every_first_convolution(network: ConvBEERS) -> None:
    kinds = [node.op_type for node in to_onnx(network, {}).graph.node]
    assert kinds.count("Relu") == network.variant.blocks
    assert kinds.count("Add") == network.variant.blocks + 2
