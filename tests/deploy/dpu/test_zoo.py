from itertools import pairwise

import pytest

from deploy.dpu.board import load_dpu
from deploy.dpu.checker.placement import place
from deploy.dpu.zoo.builder import Builder
from deploy.dpu.zoo.networks import NETWORKS, network, published_rates

RATES = published_rates()


@pytest.mark.parametrize("rate", RATES, ids=lambda rate: f"{rate.network}-{rate.configuration}")
def test_operations_are_the_published_ones(rate: object) -> None:
    """A network written down wrongly would hardly have the published number of operations."""
    assert isinstance(rate, type(RATES[0]))
    assert sum(op.operations for op in network(rate.network).operations) == pytest.approx(rate.operations, rel=0.04)


# Parameters without biases and batch norms, from the papers or their repositories.
WEIGHTS = {
    "resnet-18": 11.68e6,
    "resnet-50 v1.5": 25.50e6,
    "vgg-16": 138.34e6,
    "squeezenet 1.1": 1.23e6,
    "mobilenet v1": 4.21e6,
    "inception v3": 23.80e6,
    "yolo v3 coco": 61.90e6,
    "yolo v5 n": 1.86e6,
    "efficientnet edgetpu s": 5.39e6,
}


@pytest.mark.parametrize(("name", "weights"), WEIGHTS.items())
def test_weights_are_the_published_ones(name: str, weights: float) -> None:
    assert sum(op.weight_bytes for op in network(name).operations) == pytest.approx(weights, rel=0.01)


def test_every_network_has_a_rate_and_every_rate_a_network() -> None:
    assert {rate.network for rate in RATES} == set(NETWORKS)
    assert len(NETWORKS) >= 20
    assert len(RATES) >= 60
    assert all(rate.source and rate.fps > 0 for rate in RATES)


@pytest.mark.parametrize("name", NETWORKS)
def test_every_operation_reads_what_is_there(name: str) -> None:
    made = dict(network(name).inputs)
    for op in network(name).operations:
        assert tuple(made[tensor] for tensor in op.inputs) == op.in_shapes
        assert op.out_shape is not None
        assert min(op.out_shape) > 0
        made[op.output] = op.out_shape
        if op.kind == "add":
            assert len(set(op.in_shapes)) == 1
    assert set(network(name).outputs) <= set(made)


@pytest.mark.parametrize("name", ["resnet-50", "vgg-16", "yolo v3", "inception v3", "superpoint"])
def test_networks_of_the_zoo_pass_the_rules(name: str) -> None:
    """AMD compiled them for this DPU: a rule that refuses them is wrong."""
    failed = place(network(name), load_dpu("vck190")).failed
    assert [(node.op.name, node.broken) for node in failed] == []


@pytest.mark.parametrize("side", [224, 225, 17])
@pytest.mark.parametrize("stride", [1, 2, 3])
def test_shapes_follow_the_two_paddings(side: int, stride: int) -> None:
    b = Builder(side, side + 2)
    same, valid = (b.conv(b.image, 5, 3, stride, padding=padding) for padding in ("same", "valid"))
    assert same.shape == (5, -(-side // stride), -(-(side + 2) // stride))
    assert valid.shape == (5, (side - 3) // stride + 1, (side - 1) // stride + 1)


def test_a_builder_keeps_the_order() -> None:
    b = Builder(8, 8)
    net = b.network(b.repeat(b.conv(b.image, 4), 3, lambda x: b.conv(x, 4)))
    assert all(later.inputs == before.outputs for before, later in pairwise(net.operations))
