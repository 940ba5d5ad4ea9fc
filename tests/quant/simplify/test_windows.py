"""Tests that large kernels and crops become windows that every target computes."""

from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from beers_deploy.quant.graph import read_network, refusal
from beers_deploy.quant.onnx.graph import OnnxGraph
from beers_deploy.quant.simplify.convolutions import (
    LARGE_POSITIONS,
    MOST_POSITIONS,
    split_large_kernel,
)
from beers_deploy.quant.simplify.simplify import simplify
from tests.quant.quick import copied, run_model
from tests.quant.simplify.networks import network_from

CHANNELS = 3
ENDS = f"float[N,{CHANNELS},H,W] x => float[N,C,h,w] y"


def drawn(generator: np.random.Generator, *shape: int, deviation: float = 1) -> np.ndarray:
    """Draw normally distributed float32 weights of a shape."""
    return generator.normal(0, deviation, shape).astype(np.float32)


def assert_same(model: onnx.ModelProto, short: onnx.ModelProto, rows: int, columns: int) -> None:
    """Check that two networks are equal but for the rounding of float32."""
    generator = np.random.default_rng(rows)
    pixels = generator.random((2, CHANNELS, rows, columns), np.float32)
    before = run_model(model, pixels)
    after = run_model(short, pixels)
    largest = np.abs(before).max()
    assert_allclose(after, before, atol=1e-5 * largest)


def pairs(low: int, high: int) -> st.SearchStrategy[tuple[int, int]]:
    """Draw a number from `low` to `high` for each of two axes."""
    sides = st.integers(low, high)
    return st.tuples(sides, sides)


@settings(max_examples=40)
@given(
    kernel=pairs(1, 16),
    pads=st.lists(st.integers(0, 8), min_size=4, max_size=4),
    strides=pairs(1, 3),
    dilations=pairs(1, 2),
    outputs=st.integers(1, 4),
    is_depthwise=st.booleans(),
    size=pairs(31, 40),
)
def test_a_large_kernel_is_several_small_ones_and_their_sum(
    kernel: tuple[int, int],
    pads: list[int],
    strides: tuple[int, int],
    dilations: tuple[int, int],
    outputs: int,
    is_depthwise: bool,
    size: tuple[int, int],
) -> None:
    """A large kernel becomes convolutions of a few of its rows each, and one that adds them.

    The result stays the same, and no part has more positions than every target computes. Parts that
    begin or end inside the map read a cropped one.
    """
    generator = np.random.default_rng(kernel)
    outputs = CHANNELS if is_depthwise else outputs
    groups = CHANNELS if is_depthwise else 1
    weight = drawn(generator, outputs, CHANNELS // groups, *kernel)
    bias = drawn(generator, outputs)
    window = f"pads={pads}, strides={list(strides)}, dilations={list(dilations)}, group={groups}"
    model = network_from(f"y = Conv<{window}>(x, w, b)", ends=ENDS, w=weight, b=bias)
    # The pass runs alone, because `simplify` adds a border to a network without padding.
    short = copied(model)
    graph = OnnxGraph(short)
    graph.rewrite(split_large_kernel)
    graph.save()
    rows, columns = kernel
    if rows * columns > LARGE_POSITIONS:
        convs = [node for node in graph.nodes if node.op_type == "Conv"]
        for conv in convs:
            part = graph.constants[conv.inputs[1]]
            assert np.prod(part.shape[2:]) <= MOST_POSITIONS
        assert len(convs) > 1
    assert_same(model, short, *size)


@pytest.mark.parametrize("pads", ["pads=[4,4,4,4]", 'auto_pad="SAME_UPPER"'])
def test_srresnets_kernels_of_9_x_9_are_two_and_a_sum(pads: str) -> None:
    """SRResNet's first layer becomes two parts, their concatenation, and the convolution that sums
    them, also as TensorFlow pads it.

    The last one keeps the name of the layer and has its ReLU, so that reports name what users know.
    """
    weight = drawn(np.random.default_rng(0), CHANNELS, CHANNELS, 9, 9)
    model = network_from(f"[head] c = Conv<{pads}>(x, w) y = Relu(c)", ends=ENDS, w=weight)
    short = simplify(model, "a.onnx")
    names = [op.name for op in read_network(short).graph]
    assert names == ["head.rows_0", "head.rows_1", "head.rows", "head"]
    assert_same(model, short, 9, 11)


@settings(max_examples=25)
@given(
    border=pairs(0, 6),
    size=pairs(16, 22),
    pad=st.integers(0, 1),
)
def test_a_crop_is_a_convolution_that_reads_one_pixel(
    border: tuple[int, int], size: tuple[int, int], pad: int
) -> None:
    """A Slice that crops both ends of an axis disappears, and the result stays the same.

    Unlike the Slice, a convolution needs no size of the image.
    """
    cut = {axis: px for axis, px in zip((2, 3), border, strict=True) if px}
    assume(cut)
    weight = drawn(np.random.default_rng(0), CHANNELS, CHANNELS, 3, 3)
    places = np.array(list(cut.values()))
    constants: dict[str, Any] = {"w": weight, "starts": places, "stops": -places, "axes": list(cut)}
    nodes = f"s = Slice(x, starts, stops, axes) y = Conv<pads={[pad] * 4}>(s, w)"
    model = network_from(nodes, ends=ENDS, **constants)
    short = simplify(model, "a.onnx")
    kinds = [node.op_type for node in short.graph.node]
    assert "Slice" not in kinds
    if kinds[0] != "Pad":
        assert_same(model, short, *size)


def test_a_u_net_without_padding_crops_its_skip_and_gets_a_mirrored_border() -> None:
    """A U-Net of unpadded convolutions is accepted, and its result is as large as its image.

    Published ones, such as waifu2x's, are of this kind. Inside of the border nothing changes.
    """
    generator = np.random.default_rng(0)
    sides = {"w": 3, "halved": 2, "double": 4}
    constants: dict[str, Any] = {
        name: drawn(generator, CHANNELS, CHANNELS, side, side, deviation=0.3)
        for name, side in sides.items()
    }
    constants["begin"] = np.array([4, 4])
    constants["stop"] = -constants["begin"]
    nodes = """
        a = Conv(x, w)
        less = Conv<strides=[2,2]>(a, halved)
        c = Conv(less, w)
        d = ConvTranspose<strides=[2,2], pads=[3,3,3,3]>(c, double)
        s = Slice(a, begin, stop, axes)
        e = Add(s, d)
        y = Conv(e, w)
    """
    model = network_from(nodes, ends=ENDS, **constants)
    short = simplify(model, "a.onnx")
    assert refusal(short) == ""
    assert read_network(short).border_px == 6
    pixels = generator.random((1, CHANNELS, 40, 44), np.float32)
    expected = run_model(model, pixels)
    whole = run_model(short, pixels)
    inner = whole[:, :, 6:-6, 6:-6]
    assert_allclose(inner, expected, atol=1e-5)
