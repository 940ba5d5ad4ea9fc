"""A small network with real structure, its ONNX graph, and patches from a drawn scene."""

import numpy as np
import onnx
import pytest
import torch

from deploy.export import to_onnx
from model.convbeers import ConvBEERS, initialise
from model.simulator.procedural import procedural_scene
from model.variants import Variant
from profiles import load_sensor
from quant.calibration import Patches, draw_patches
from quant.graph import Graph, correction_graph, read_planes
from quant.quantise import Quantised, quantise_model


@pytest.fixture(scope="session")
def network() -> ConvBEERS:
    network = ConvBEERS(Variant(blocks=2, features=8))
    initialise(network, torch.Generator().manual_seed(3))
    with torch.no_grad():
        for name, value in network.named_parameters():
            if name.endswith("bias"):
                value.normal_(0, 0.02, generator=torch.Generator().manual_seed(len(name)))
    return network.eval()


@pytest.fixture(scope="session")
def float_onnx(network: ConvBEERS) -> onnx.ModelProto:
    return to_onnx(network, {"variant": "test"})


@pytest.fixture(scope="session")
def graph(float_onnx: onnx.ModelProto) -> Graph:
    return read_planes(correction_graph(float_onnx))


def drawn(scene: int, seed: int) -> Patches:
    ground = procedural_scene(900, 960, np.random.default_rng(scene))
    sensors = load_sensor("pleiades-degraded"), load_sensor("pleiades-reference")
    return draw_patches([ground], *sensors, count=6, seed=seed, patch_px=80)


@pytest.fixture(scope="session")
def patches() -> Patches:
    return drawn(1, 5)


@pytest.fixture(scope="session")
def unseen() -> Patches:
    """Of another scene than calibration's."""
    return drawn(77, 78)


@pytest.fixture(scope="session")
def quantised(float_onnx: onnx.ModelProto, patches: Patches) -> Quantised:
    return quantise_model(float_onnx, patches, {"seed": "5"})
