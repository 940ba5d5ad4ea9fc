"""Weights fitted to what a convolution reads: its result errs less, in the spirit of the exact
quadratic.
"""

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from beers_deploy.quant.core import build_core
from beers_deploy.quant.gate import compare
from beers_deploy.quant.graph import PLANES, Graph, graph_to_onnx, tensors
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.passes.fit_weights import FLOOR, Moments, descend, fit, fit_weights
from beers_deploy.quant.quantise import choose_frac_bits
from beers_deploy.quant.samples import Patches
from beers_deploy.quant.session import open_session, planes_of
from tests.quant.quick import quickly, with_relu6


def moments_of(*parts: np.ndarray) -> Moments:
    """Of windows (K, G, n) that lose nothing."""
    moments = Moments.of_none(*parts[0].shape[1:])
    for part in parts:
        moments.add(part, part)
    return moments


def squared(rounded: np.ndarray, target: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    error = rounded - target
    return np.asarray(((error @ covariance) * error).sum(axis=1))


@given(st.integers(0, 2**32 - 1), st.integers(1, 7), st.integers(1, 12))
def test_no_channel_errs_more_than_rounded_to_nearest(seed: int, channels: int, size: int) -> None:
    generator = np.random.default_rng(seed)
    target = generator.uniform(-127, 127, (channels, size))
    windows = generator.normal(0, 1, (3 * size, size)) + generator.normal(0, 3, (3 * size, 1))
    covariance = windows.T @ windows / len(windows) + 1e-6 * np.eye(size)
    nearest = np.rint(target)
    integers = descend(target, covariance)
    assert (
        squared(integers, target, covariance) <= squared(nearest, target, covariance) + 1e-9
    ).all()
    assert (integers == np.rint(integers)).all()
    assert np.abs(integers).max() <= 128


def test_weights_that_meet_the_same_pixel_keep_their_sum() -> None:
    target = np.full((1, 9), 0.3)
    integers = descend(target, np.ones((9, 9)) + 1e-3 * np.eye(9))
    # The sum is the integer nearest to 2.7. Each weight rounded separately would be 0.
    assert integers.sum() == 3


def test_of_weights_that_meet_unrelated_values_the_nearest_stay() -> None:
    target = np.random.default_rng(2).uniform(-120, 120, (4, 18))
    assert (descend(target, np.diag(np.arange(1.0, 19))) == np.rint(target)).all()


@given(st.integers(0, 2**32 - 1), st.floats(-4, -1), st.integers(1, 5))
def test_weights_of_a_channel_that_hardly_changes_stay_near(
    seed: int, exponent: float, still: int
) -> None:
    generator = np.random.default_rng(seed)
    spread = np.where(np.arange(12) < still, 10.0**exponent, 1.0)
    calm, other = (
        generator.normal(0, 1, (400, 12)) + generator.normal(0, 2, (400, 1)) for _ in range(2)
    )
    moments = moments_of((3 + spread * calm).astype(np.float32)[:, None])
    target = generator.uniform(-100, 100, (24, 12))
    integers = descend(target, moments.covariance[0])
    assert np.abs(integers - target).max() <= 4
    covariance = np.cov(spread * other, rowvar=False)
    errors = [
        squared(rounded, target, covariance).mean() for rounded in (integers, np.rint(target))
    ]
    assert errors[0] <= errors[1]


def test_moments_are_those_of_the_windows() -> None:
    windows = np.random.default_rng(0).normal(2, 1, (50, 4)).astype(np.float32)
    moments = moments_of(*np.array_split(windows[:, None], 3))
    assert_allclose(moments.mean[0], windows.mean(axis=0), rtol=1e-5)
    covariance = np.cov(windows.T, bias=True)
    floor = FLOOR * np.diag(covariance).mean() * np.eye(4)
    assert_allclose(moments.covariance[0], covariance + floor, rtol=1e-3, atol=1e-5)


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 5))
def test_each_group_is_fitted_to_what_it_reads_in_int8_and_to_its_float_mean(
    seed: int, groups: int, outputs: int
) -> None:
    generator = np.random.default_rng(seed)
    exact = generator.normal(0, 1, (500, groups, 6)) + generator.normal(2, 2, (500, groups, 1))
    in_int8 = np.floor(2 * exact) / 2
    unit = 2.0**-3
    weight = generator.uniform(-10, 10, (outputs * groups, 6, 1, 1)).astype(np.float32)
    moments = Moments.of_none(groups, 6)
    moments.add(in_int8.astype(np.float32), exact.astype(np.float32))
    fitted, bias_change = fit(weight, unit, moments)
    target, result = (values.reshape(groups, outputs, 6) for values in (weight, unit * fitted))
    deviation = np.einsum("kgn,gon->kgo", in_int8, result) - np.einsum(
        "kgn,gon->kgo", exact, target
    )
    assert_allclose(bias_change, deviation.mean(axis=0).ravel(), atol=1e-3)
    for group, group_target, covariance in zip(
        result / unit, target / unit, moments.covariance, strict=True
    ):
        assert (group == descend(group_target, covariance)).all()


@pytest.mark.parametrize("depthwise", [False, True])
def test_every_layer_errs_less(
    depthwise: bool, graph: Graph, patches: Patches, unseen: Patches
) -> None:
    graph = with_relu6(0.5) if depthwise else graph
    nearest = build_core(graph, choose_frac_bits(graph, patches.degraded))
    fitted = fit_weights(graph, nearest, patches.degraded)
    exact = open_session(graph_to_onnx(graph, tensors(graph)))
    errors = np.zeros((2, len(graph)))
    for image in unseen.degraded:
        expected = exact.run(None, {PLANES: planes_of(image)})
        for k, core in enumerate((nearest, fitted)):
            results, _ = run_core(core, core.ends.split(image))
            scaled = (results[op.output] * core.scale(op.output) for op in core.ops)
            errors[k] += [np.square(a - b).mean() for a, b in zip(scaled, expected, strict=True)]
    # The first layer reads the image, which is not rounded. With so few channels its error is down
    # to chance.
    behind = 1 if depthwise else 0
    assert (errors[1] < errors[0])[behind:].all()


def test_it_lowers_the_network_s_error_on_unseen_patches(
    float_onnx: onnx.ModelProto, patches: Patches, unseen: Patches, monkeypatch: pytest.MonkeyPatch
) -> None:
    def mae() -> float:
        return compare(
            open_session(float_onnx), open_session(quickly(float_onnx, patches).host), unseen.pairs
        ).mae

    fitted = mae()
    monkeypatch.setattr("beers_deploy.quant.quantise.fit_weights", lambda _graph, core, *_: core)
    assert fitted < mae()
