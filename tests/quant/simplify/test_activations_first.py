"""Tests that activations move past operators that only move values, into convolutions."""

import numpy as np
import onnx
import pytest

from beers_deploy.quant.simplify.activations_first import activations_first
from tests.quant.quick import assert_same
from tests.quant.simplify.networks import parsed

CHANNELS = 8
IMAGE = np.random.default_rng(0).normal(0, 4, (2, 1, 10, 14)).astype(np.float32)
WINDOW = "kernel_shape=[3,3], pads=[1,1,1,1], strides=[2,1]"
MOVES = {
    "Concat": "Concat<axis=1>({}, b)",
    "DepthToSpace": "DepthToSpace<blocksize=2>({})",
    "MaxPool": f"MaxPool<{WINDOW}>({{}})",
    "AveragePool": f"AveragePool<{WINDOW}>({{}})",
    "nearest": 'Resize<mode="nearest">({}, , twice)',
    "linear": 'Resize<mode="linear">({}, , twice)',
}
"""Operators that move or average the values of one tensor; the braces stand for its name."""
ACTIVATIONS = {
    "Relu": "Relu({})",
    "LeakyRelu": "LeakyRelu({})",
    "Clip": "Clip({}, zero, six)",
    "HardSwish": "HardSwish({})",
}


def network(*kinds: str, activation: str = "Relu", more: str = "") -> onnx.ModelProto:
    """Build two convolutions, operators that move values, an activation and a last convolution.

    Args:
        kinds: keys of MOVES.
        activation: a key of ACTIVATIONS.
        more: a second result.
    """
    tensors = ["a", *(f"t{k}" for k in range(1, len(kinds) + 1))]
    moves = [
        f"{to} = {MOVES[kind].format(source)}"
        for kind, source, to in zip(kinds, tensors[:-1], tensors[1:], strict=True)
    ]
    active = ACTIVATIONS[activation].format(tensors[-1])
    nodes = f"""
        a = Conv(image, a_w)
        b = Conv(image, b_w)
        {" ".join(moves)}
        active = {active}
        restored = Conv(active, c_w)
    """
    channels = CHANNELS * 2 ** kinds.count("Concat") // 4 ** kinds.count("DepthToSpace")
    generator = np.random.default_rng(1)
    constants = {
        "a_w": generator.normal(0, 1, (CHANNELS, 1, 1, 1)),
        "b_w": generator.normal(0, 1, (CHANNELS, 1, 1, 1)),
        "c_w": generator.normal(0, 1, (1, channels, 1, 1)),
        "twice": [1.0, 1.0, 2.0, 2.0],
        "zero": 0.0,
        "six": 6.0,
    }
    results = f"float[N,1,P,Q] restored{more and f', float[N,C,R,S] {more}'}"
    return parsed(nodes, f"float[N,1,H,W] image => {results}", constants=constants)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize(
    "kinds", [["Concat"], ["DepthToSpace"], ["nearest"], ["MaxPool"], ["Concat", "nearest"]]
)
def test_an_activation_reaches_its_convolutions(kinds: list[str], activation: str) -> None:
    model = network(*kinds, activation=activation)
    before = model.SerializeToString()
    moved = activations_first(model)
    assert model.SerializeToString() == before
    assert_same(model, moved, IMAGE)
    writers = {node.output[0]: node.op_type for node in moved.graph.node}
    reads = [writers[n.input[0]] for n in moved.graph.node if n.op_type == activation]
    if activation == "HardSwish" and "MaxPool" in kinds:
        assert reads == ["MaxPool"]
        assert moved is model
    else:
        assert set(reads) == {"Conv"}


STAYING = {
    "behind means over windows": network("AveragePool"),
    "behind means of neighbours": network("linear"),
    "where its convolution is read elsewhere": network("DepthToSpace", more="a"),
}


@pytest.mark.parametrize("place", STAYING)
def test_an_activation_stays(place: str) -> None:
    assert activations_first(STAYING[place]) is STAYING[place]
