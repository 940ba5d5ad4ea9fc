"""Tests that convolutions read the image itself where they read mixtures of its channels."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.quant.simplify.simplify import simplify
from tests.quant.quick import assert_same
from tests.quant.simplify.networks import CHANNELS, SAME, network_from

IMAGE = np.random.default_rng(4).uniform(0, 1, (1, CHANNELS, 9, 13)).astype(np.float32)
MIXING = (
    "Gather<axis=1>({}, swapped)",
    "Neg({})",
    "Mul({}, image)",
    "Div({}, three)",
    "Add({}, x)",
    "Sub(x, {})",
    "Conv({}, mixes)",
)
"""Operators that mix the channels of each pixel; the braces stand for the tensor in front."""
READING = (
    f"{SAME}({{}}, w, b)",
    "Conv<pads=[1,1,1,1], group=4>({}, deep, b)",
    "Conv<pads=[0,1,2,0], group=2, strides=[2,1]>({}, halves)",
)


@settings(max_examples=40)
@given(st.lists(st.sampled_from(MIXING), min_size=1, max_size=4), st.sampled_from(READING))
def test_a_convolution_of_a_mixture_reads_the_image(mixing: list[str], reading: str) -> None:
    tensors = ["x", *(f"m{k}" for k in range(len(mixing)))]
    nodes = [
        f"{after} = {operator.format(before)}"
        for operator, (before, after) in zip(mixing, pairwise(tensors), strict=True)
    ]
    nodes.append(f"y = {reading.format(tensors[-1])}")
    model = network_from(
        " ".join(nodes), swapped=[2, 0, 3, 1], mixes=np.eye(4)[..., None, None] - 0.3
    )
    short = simplify(model, "a.onnx")
    assert [node.op_type for node in short.graph.node] == ["Conv"]
    assert_same(model, short, IMAGE, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("in_front", ["m = Add(x, image)", "m = Conv(x, mixes, b)", "m = Relu(x)"])
def test_zeros_of_a_padding_are_not_shifted(in_front: str) -> None:
    """The border of a mixture with a bias is zero, and not the bias."""
    model = network_from(f"{in_front} y = {SAME}(m, w)", mixes=np.ones((4, 4, 1, 1)))
    short = simplify(model, "a.onnx")
    assert len(short.graph.node) == 2
    assert_same(model, short, IMAGE, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("channels", "reads_image"), [(16, True), (17, False)])
def test_an_image_of_many_channels_does_not_make_a_layer_slower(
    channels: int, reads_image: bool
) -> None:
    model = network_from(
        f"m = Gather<axis=1>(x, two) y = {SAME}(m, narrow)",
        ends=f"float[N,{channels},H,W] x => float[N,C,H2,W2] y",
        narrow=np.ones((3, 1, 3, 3)),
    )
    short = simplify(model, "a.onnx")
    assert len(short.graph.node) == (1 if reads_image else 2)
