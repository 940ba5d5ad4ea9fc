"""Tests that the example networks compute the same in ONNX as in torch, at all legal sizes."""

from collections import Counter

import numpy as np
import onnx
import pytest
import torch
from torch import nn

from beers_deploy.quant.session import open_session
from examples.networks import NETWORKS, build, to_onnx
from tests.quant.quick import uniform

MAX_DIFFERENCE = 1e-5


def seeded_network(name: str) -> nn.Module:
    return build(name, torch.Generator().manual_seed(0))


def shapes(name: str) -> list[tuple[int, int, int, int]]:
    """Return odd and even multiples of the network's step."""
    example = NETWORKS[name]
    step = example.multiple_px
    return [(1, example.inputs, 9 * step, 10 * step), (2, example.inputs, 12 * step, 7 * step)]


def differences(
    network: nn.Module, model: onnx.ModelProto, sizes: list[tuple[int, int, int, int]]
) -> list[float]:
    session = open_session(model)
    lines = []
    for size in sizes:
        image = uniform(*size)
        with torch.inference_mode():
            expected = network(torch.from_numpy(image)).numpy()
        (output,) = session.run(None, {"input": image})
        assert output.shape == expected.shape
        lines.append(float(np.abs(output - expected).max()))
    return lines


@pytest.mark.parametrize("name", NETWORKS)
def test_the_exported_network_equals_torch_at_odd_and_even_sizes(name: str) -> None:
    network = seeded_network(name)
    assert max(differences(network, to_onnx(name, network), shapes(name))) <= MAX_DIFFERENCE


@pytest.mark.parametrize("name", ["dncnn", "mobile"])
def test_batch_normalisation_may_stay_unfolded_and_is_not_the_identity(name: str) -> None:
    network = seeded_network(name)
    model = to_onnx(name, network, fold=False)
    assert Counter(node.op_type for node in model.graph.node)["BatchNormalization"] == sum(
        isinstance(module, nn.BatchNorm2d) for module in network.modules()
    )
    assert max(differences(network, model, shapes(name))) <= MAX_DIFFERENCE
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.reset_running_stats()
    assert min(differences(network, model, shapes(name))) > 100 * MAX_DIFFERENCE
