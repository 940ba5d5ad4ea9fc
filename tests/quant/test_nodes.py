"""Tests that sizes behind windows, and moves of pixels, are those of onnx's own runtimes."""

from collections.abc import Sequence
from itertools import permutations, product
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from onnx import helper
from onnx.reference import ReferenceEvaluator

from beers_deploy.dpu.reading import sized_graph
from beers_deploy.quant.graph.pixel_shuffle import MOVES
from tests.quant.quick import run_model
from tests.quant.tiling.small_networks import Row, taps


@st.composite
def with_offset_windows(draw: st.DrawFn) -> Row:
    """Draw a transposed convolution, one with automatic padding, or a pool."""
    pairs = st.tuples(*[st.integers(1, 3)] * 2)
    kernel = draw(pairs)
    strides = draw(pairs)
    pads = draw(st.tuples(*[st.integers(0, 2)] * 4))
    moves: dict[str, Any] = {"strides": strides, "dilations": draw(pairs)}
    kind = draw(st.sampled_from(["ConvTranspose", "Conv", "MaxPool"]))
    if kind == "MaxPool":
        moves |= {"pads": [min(pad, k - 1) for pad, k in zip(pads, kernel * 2, strict=True)]}
        return Row().add(kind, kernel_shape=kernel, ceil_mode=int(draw(st.booleans())), **moves)
    if kind == "Conv":
        moves = {
            "strides": strides,
            "auto_pad": draw(st.sampled_from(["VALID", "SAME_UPPER", "SAME_LOWER"])),
        }
    else:
        moves |= {
            "pads": pads,
            "output_padding": [draw(st.integers(0, stride - 1)) for stride in strides],
        }
    return Row().add(kind, taps("w", 1, 1, *kernel), **moves)


@settings(max_examples=60)
@given(with_offset_windows(), st.integers(5, 13))
def test_sizes_are_the_runtimes_own(row: Row, side: int) -> None:
    model = row.model()
    shape = sized_graph(model, side).operations[0].out_shape
    # A window that is larger than its map has no size.
    assume(shape is not None)
    result = run_model(model, np.zeros((1, 1, side, side), np.float32))
    assert result.shape[1:] == shape


@pytest.mark.parametrize(
    ("kind", "numbers"),
    [
        *product(["Transpose"], permutations(range(4))),
        *product(["Reshape"], [[0, 6, -1], [-1, 3, 0, 10], [1, 3, 2, 20]]),
        ("Unsqueeze", [0]),
        ("Unsqueeze", [2]),
        ("Squeeze", [0]),
    ],
)
def test_moves_are_those_of_onnx(kind: str, numbers: Sequence[int]) -> None:
    image = np.arange(120).reshape(1, 6, 4, 5)
    feeds = {"x": image}
    if kind == "Transpose":
        node = helper.make_node(kind, ["x"], ["y"], perm=numbers)
    else:
        node = helper.make_node(kind, ["x", "s"], ["y"])
        feeds["s"] = np.array(numbers)
    (expected,) = list(ReferenceEvaluator(node).run(None, feeds))
    np.testing.assert_array_equal(MOVES[kind][1](image, list(numbers)), expected)
