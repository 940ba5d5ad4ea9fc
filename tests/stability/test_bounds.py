"""Proofs: intervals that no image leaves, and sums that cannot overflow."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.stress.subject import Subject, infer_in, open_subject
from model.shipped import SHIPPED
from profiles.errors import BeersError, ModelError
from quant.bounds import bound_anywhere, bound_inside, compose, layer_bounds
from quant.core import IntConv
from quant.encodings import read_core
from quant.ends import Ends
from quant.graph import CORRECTION, Conv, Graph, correction_graph, split
from quant.integer import INT32_BITS, correction, run_core
from quant.onnx_file import load_onnx
from quant.quantise import Quantised
from quant.session import open_session, run

RADIUS_PX = 5
"""Of the fixture's network: one block."""


@pytest.fixture(scope="module")
def graph(float_onnx: onnx.ModelProto) -> Graph:
    return correction_graph(float_onnx)


def images(seed: int, shape: tuple[int, int], binary: bool) -> np.ndarray:
    drawn = np.random.default_rng(seed).random((1, 1, *shape))
    return np.rint(drawn) if binary else drawn


@settings(max_examples=30)
@given(seed=st.integers(0, 999), shape=st.tuples(st.integers(1, 24), st.integers(1, 24)), binary=st.booleans())
def test_no_image_leaves_the_float_bounds(seed: int, shape: tuple[int, int], binary: bool, graph: Graph) -> None:
    image = images(seed, shape, binary)
    restored, anywhere = infer_in(graph, torch.float64)(image), bound_anywhere(graph)
    assert anywhere.low <= restored.min()
    assert restored.max() <= anywhere.high
    inner = restored[..., RADIUS_PX:-RADIUS_PX, RADIUS_PX:-RADIUS_PX]
    if inner.size:
        inside = bound_inside(graph)
        assert inside.low <= inner.min()
        assert inner.max() <= inside.high


@settings(max_examples=20)
@given(seed=st.integers(0, 999), shape=st.tuples(st.integers(1, 12), st.integers(1, 12)), binary=st.booleans())
def test_no_image_leaves_the_bounds_at_half_resolution(
    seed: int, shape: tuple[int, int], binary: bool, coarse: Subject
) -> None:
    """There the pixels of a place are channels, each with its own bound; the largest is told."""
    assert not isinstance(coarse.graph, BeersError)
    image = images(seed, (2 * shape[0], 2 * shape[1]), binary)
    restored, anywhere = infer_in(coarse.graph, torch.float64)(image), bound_anywhere(coarse.graph)
    inside = bound_inside(coarse.graph)
    assert anywhere.low <= restored.min()
    assert restored.max() <= anywhere.high
    assert anywhere.low <= inside.low < inside.high <= anywhere.high
    np.testing.assert_allclose(restored, coarse.float32.infer()(image.astype(np.float32)), atol=1e-5)


def test_the_bound_inside_is_the_tighter_one_and_neither_is_loose_without_reason(graph: Graph) -> None:
    anywhere, inside = bound_anywhere(graph), bound_inside(graph)
    assert anywhere.low <= inside.low
    assert inside.high <= anywhere.high
    assert inside.gain <= anywhere.gain
    assert inside.gain < 20  # a new network is nearly the identity


def test_the_gain_is_reached_where_a_network_is_linear() -> None:
    """Of one convolution the bound is exact: an image of the weights' signs reaches it."""
    model = load_onnx_of_one_convolution()
    bound = bound_inside(correction_graph(model))
    infer = infer_in(correction_graph(model), torch.float64)
    signs = np.sign(KERNEL + IDENTITY)[None, None]
    apart = infer(0.5 + 0.5 * signs)[0, 0, 1, 1] - infer(0.5 - 0.5 * signs)[0, 0, 1, 1]
    assert apart == pytest.approx(bound.gain, rel=1e-6)
    assert bound.high - bound.low == pytest.approx(bound.gain, rel=1e-6)


def test_a_bound_that_forgets_the_negative_weights_would_be_left(graph: Graph) -> None:
    forgetful = tuple(replace(op, weight=np.maximum(op.weight, 0)) if isinstance(op, Conv) else op for op in graph)
    bound = bound_anywhere(forgetful)
    worst = [infer_in(graph, torch.float64)(images(seed, (16, 16), True)).min() for seed in range(20)]
    assert min(worst) < bound.low


def test_composed_convolutions_are_one() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.standard_normal((3, 2, 3, 3)), rng.standard_normal((4, 3, 3, 3))
    image = torch.from_numpy(rng.standard_normal((1, 2, 9, 9)))
    one = torch.nn.functional.conv2d(image, torch.from_numpy(compose(second, first)))
    two = torch.nn.functional.conv2d(
        torch.nn.functional.conv2d(image, torch.from_numpy(first)), torch.from_numpy(second)
    )
    torch.testing.assert_close(one, two)


def test_no_image_leaves_the_integer_bounds(quantised: Quantised) -> None:
    bounds = {bound.name: bound for bound in layer_bounds(quantised.core)}
    for seed in range(6):
        planes = split(images(seed, (17, 23), seed % 2 == 0).astype(np.float32))
        for report in run_core(quantised.core, planes)[1]:
            bound = bounds[report.name]
            assert report.peak_bits <= bound.bits < INT32_BITS
            assert bound.saturates or report.saturated == 0


def test_an_accumulator_that_overflows_is_found(quantised: Quantised) -> None:
    op = next(op for op in quantised.core.ops if isinstance(op, IntConv))
    huge = replace(op, bias=np.full(len(op.bias), 2**31, np.int64), bias_frac_bits=op.weight_frac_bits + 7)
    core = replace(quantised.core, ops=(huge, *quantised.core.ops[1:]))
    assert layer_bounds(core)[0].bits >= INT32_BITS


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*-int8-*.onnx")), ids=lambda path: path.stem)
def test_shipped_accumulators_cannot_overflow(path: Path) -> None:
    core = read_core(load_onnx(path))
    assert max(bound.bits for bound in layer_bounds(core)) < INT32_BITS


def test_a_core_is_read_back_from_its_file(quantised: Quantised) -> None:
    core = read_core(quantised.host)
    image = images(3, (19, 26), False).astype(np.float32)
    whole = Ends(gains=2).merge(correction(core, split(image), half_even=True), core.scale(CORRECTION))
    np.testing.assert_array_equal(np.clip(image + whole, 0, 1), run(open_session(quantised.host), image))


def test_another_spelling_has_no_core(quantised: Quantised, float_onnx: onnx.ModelProto) -> None:
    for model in (float_onnx, quantised.board):
        with pytest.raises(ModelError, match="power-of-two"):
            read_core(model)


def test_a_pair_in_the_wrong_order_is_refused(pair: list[object]) -> None:
    with pytest.raises(ModelError, match="float model first"):
        open_subject(pair[1], pair[0], "")  # type: ignore[arg-type]


KERNEL = np.array([[0.1, -0.2, 0.0], [0.3, 0.4, -0.5], [0.0, 0.2, -0.1]])
IDENTITY = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0]])


def load_onnx_of_one_convolution() -> onnx.ModelProto:
    from onnx import helper, numpy_helper

    from quant.onnx_file import image_info, make_model

    weight = numpy_helper.from_array(KERNEL[None, None].astype(np.float32), "w")
    conv = helper.make_node("Conv", ["image", "w"], ["c"], name="c", pads=[1] * 4, kernel_shape=[3, 3])
    add = helper.make_node("Add", ["image", "c"], ["restored"], name="restored")
    ends = [image_info("image", 1, None)], [image_info("restored", 1, None)]
    return make_model(helper.make_graph([conv, add], "one", *ends, [weight]), {})
