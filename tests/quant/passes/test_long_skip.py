"""Tests that a split long skip keeps the float network and makes its sums small."""

from dataclasses import replace

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.quant.graph import (
    CORRECTION,
    IMAGE,
    PLANES,
    Activation,
    Add,
    Conv,
    Graph,
    graph_to_onnx,
    read_planes,
)
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.passes.long_skip import split_long_skip
from beers_deploy.quant.passes.selection import ALL
from beers_deploy.quant.quantize import Quantized, quantize_model
from beers_deploy.quant.session import open_session
from beers_deploy.quant.simplify.simplify import simplify
from beers_deploy.quant.structure import saturated_shares
from tests.quant.quick import patches_of, random_conv, run_model, waves
from tests.quant.simplify.networks import parsed
from tests.quant.test_odd_networks import SAME

FEATURES = 5


def skipping(seed: int, channels: int = 1, head: int = 3, tail: int = 3) -> Graph:
    """Build a network whose body reads the features of the head and is added to them."""
    generator = np.random.default_rng(seed)
    wide = (FEATURES, FEATURES, 3, 3)
    first = random_conv(generator, IMAGE, "head", (FEATURES, channels, head, head))
    body = random_conv(generator, "head", "inner", wide, Activation.relu)
    last = random_conv(generator, "sum", CORRECTION, (2, FEATURES, tail, tail))
    return read_planes((first, body, Add("add", ("inner", "head"), "sum"), last))


def run(graph: Graph, names: list[str], channels: int = 1) -> list[np.ndarray]:
    generator = np.random.default_rng(3)
    planes = generator.integers(-128, 128, (1, 3 * channels, 7, 12)) / np.float32(128)
    session = open_session(graph_to_onnx(graph, names, 3 * channels))
    return list(session.run(None, {PLANES: planes.astype(np.float32)}))


@settings(max_examples=50)
@given(
    seed=st.integers(0, 2**32 - 1),
    channels=st.integers(1, 4),
    head=st.sampled_from([1, 3, 5]),
    tail=st.sampled_from([1, 3]),
)
def test_the_float_network_is_unchanged_even_at_the_border(
    seed: int, channels: int, head: int, tail: int
) -> None:
    graph = skipping(seed, channels, head, tail)
    split = split_long_skip(graph)
    assert len(split) == len(graph) + 3
    (before,) = run(graph, [CORRECTION], channels)
    (after,) = run(split, [CORRECTION], channels)
    assert_allclose(after, before, atol=2e-5 * np.abs(before).max())


def test_the_sum_no_longer_follows_the_brightness_of_the_ground() -> None:
    split = split_long_skip(skipping(0))
    session = open_session(graph_to_onnx(split, ["sum.head"], 3))
    inner = []
    for level in (0.1, 0.9):
        planes = np.full((1, 3, 9, 9), level, np.float32)
        inner.append(session.run(None, {PLANES: planes})[0][..., 2:-2, 2:-2])
    assert_allclose(inner[0], inner[1], atol=1e-4)


def test_a_head_that_nothing_else_reads_is_replaced() -> None:
    first, body, *others = skipping(0)
    graph = (first, replace(body, input=PLANES, weight=body.weight[:, :3]), *others)  # type: ignore[type-var, attr-defined]
    split = split_long_skip(graph)
    assert "head" not in {op.output for op in split}
    (before,) = run(graph, [CORRECTION])
    (after,) = run(split, [CORRECTION])
    assert_allclose(after, before, atol=2e-4)


def graphs_without_long_skip() -> dict[str, Graph]:
    first, body, add, last = skipping(0)
    assert isinstance(add, Add)
    assert isinstance(first, Conv)
    again = random_conv(np.random.default_rng(1), "sum", "other", (2, FEATURES, 1, 1))
    apart = Add("end", ("other", CORRECTION + ".1"), CORRECTION)
    return {
        "activation of the sum": (first, body, replace(add, activation=Activation.relu), last),
        "activation of the head": (replace(first, activation=Activation.relu), body, add, last),
        "twice the head": (first, body, replace(add, inputs=("head", "head")), last),
        "two readers": (first, body, add, again, replace(last, output=CORRECTION + ".1"), apart),  # type: ignore[type-var]
        "depthwise": (first, body, add, replace(last, groups=FEATURES)),  # type: ignore[type-var]
        "even": (replace(first, weight=first.weight[..., :2, :2]), body, add, last),
    }


@pytest.mark.parametrize("name", graphs_without_long_skip())
def test_other_sums_are_left_alone(name: str) -> None:
    graph = graphs_without_long_skip()[name]
    assert split_long_skip(graph) is graph


def bright() -> onnx.ModelProto:
    """Build a network whose features contain the image, which is far larger than the details."""
    generator = np.random.default_rng(3)
    first = generator.uniform(-0.1, 0.1, (8, 1, 3, 3))
    inner = generator.uniform(-0.3, 0.3, (8, 8, 3, 3))
    last = generator.uniform(-0.3, 0.3, (1, 8, 3, 3))
    # Each feature is the image with some detail, and the tail cancels the image.
    first[:, :, 1, 1] += 1
    last -= last.mean(1, keepdims=True)
    nodes = f"""
        head = {SAME}(x, first) inner = {SAME}(head, inner_w) body = Relu(inner)
        sum = Add(body, head) tail = {SAME}(sum, last) correction = Mul(tail, small)
        y = Add(x, correction)
    """
    constants = {"first": first, "inner_w": inner, "last": last, "small": 0.02}
    ends = "float[N,1,H,W] x => float[N,1,H,W] y"
    return simplify(parsed(nodes, ends, constants=constants), "bright")


def test_int8_errs_less(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("beers_deploy.quant.quantize.activates_sums", lambda _: True)
    model = bright()
    *images, held_out = (0.1 + 0.8 * each for each in waves(5))
    in_float = run_model(model, held_out)
    split, whole = (
        quantize_model(model, patches_of(images), {}, passes=replace(ALL, long_skip=each))
        for each in (True, False)
    )
    errors = [np.abs(run_model(int8.host, held_out) - in_float).mean() for int8 in (split, whole)]
    assert errors[0] < 0.8 * errors[1]
    assert_pixel_is_exact(split)


def assert_pixel_is_exact(int8: Quantized) -> None:
    """Check that the pixel's channels hold all 12 bits, and that full scale is not reported."""
    every_dn = np.arange(4096, dtype=np.float32).reshape(1, 1, 64, 64) / 4095
    planes = int8.core.host_part.encode(every_dn)
    tensors, _ = run_core(int8.core, planes)
    coarse, remainder, _ = planes[0].astype(np.int16)
    (name,) = (name for name in tensors if name.endswith(".pixel"))
    assert_array_equal(tensors[name][0], [coarse, 4 * remainder])
    assert tensors[name].max() == 127
    counted = saturated_shares(int8.host, [every_dn])
    assert counted
    assert not [each for each in counted if each.endswith((".pixel", ".join"))]
