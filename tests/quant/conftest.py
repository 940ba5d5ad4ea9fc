"""A small network with real structure, its ONNX graph, and patches from a drawn scene."""

import onnx
import pytest
import torch

from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.convbeers import ConvBEERS
from beers_deploy.model.variants import Variant
from beers_deploy.quant.graph import Graph, correction_graph, read_planes
from beers_deploy.quant.quantize import Quantized, quantize_model
from beers_deploy.quant.samples.patches import Patches
from tests.model.networks import plain
from tests.quant.quick import drawn


@pytest.fixture(scope="session")
def network() -> ConvBEERS:
    network = plain(Variant(blocks=2, features=8), seed=3)
    with torch.no_grad():
        for name, value in network.named_parameters():
            if name.endswith("bias"):
                value.normal_(0, 0.02, generator=torch.Generator().manual_seed(len(name)))
    return network


@pytest.fixture(scope="session")
def float_onnx(network: ConvBEERS) -> onnx.ModelProto:
    return to_onnx(network, {"variant": "test"})


@pytest.fixture(scope="session")
def graph(float_onnx: onnx.ModelProto) -> Graph:
    return read_planes(correction_graph(float_onnx))


@pytest.fixture(scope="session")
def patches() -> Patches:
    return drawn(6, seed=5, patch_px=128)


@pytest.fixture(scope="session")
def unseen() -> Patches:
    """Return patches of another scene than that of calibration."""
    return drawn(6, seed=78, scene=77, patch_px=80)


@pytest.fixture(scope="session")
def quantized(float_onnx: onnx.ModelProto, patches: Patches) -> Quantized:
    return quantize_model(float_onnx, patches, {"seed": "5"})
