"""Weights fitted to what a convolution reads: its result errs less, in the spirit of the exact quadratic."""

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.gate import compare
from beers_deploy.quant.graph import Conv, Graph
from beers_deploy.quant.passes.fit_weights import FLOOR, Moments, descend, fit_weights, input_moments
from beers_deploy.quant.samples import Patches
from beers_deploy.quant.session import open_session, planes_of
from tests.quant.quick import quickly


def squared(whole: np.ndarray, wanted: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    error = whole - wanted
    return np.asarray(((error @ covariance) * error).sum(axis=1))


@given(st.integers(0, 2**32 - 1), st.integers(1, 7), st.integers(1, 12))
def test_no_channel_errs_more_than_rounded_to_nearest(seed: int, channels: int, size: int) -> None:
    generator = np.random.default_rng(seed)
    wanted = generator.uniform(-127, 127, (channels, size))
    windows = generator.normal(0, 1, (3 * size, size)) + generator.normal(0, 3, (3 * size, 1))
    covariance = windows.T @ windows / len(windows) + 1e-6 * np.eye(size)
    nearest = np.rint(wanted)
    found = descend(wanted, nearest, covariance)
    assert (squared(found, wanted, covariance) <= squared(nearest, wanted, covariance) + 1e-9).all()
    assert (found == np.rint(found)).all()
    assert np.abs(found).max() <= 128


def test_weights_that_meet_the_same_pixel_keep_their_sum() -> None:
    wanted = np.full((1, 9), 0.3)
    found = descend(wanted, np.zeros((1, 9)), np.ones((9, 9)) + 1e-3 * np.eye(9))
    assert found.sum() == 3  # nearest to 2.7; each by itself rounds to 0


def test_of_weights_that_meet_unrelated_values_the_nearest_stay() -> None:
    wanted = np.random.default_rng(2).uniform(-120, 120, (4, 18))
    assert (descend(wanted, np.rint(wanted), np.diag(np.arange(1.0, 19))) == np.rint(wanted)).all()


@given(st.integers(0, 2**32 - 1), st.floats(-4, -1), st.integers(1, 5))
def test_weights_of_a_channel_that_hardly_changes_stay_near(seed: int, exponent: float, still: int) -> None:
    generator = np.random.default_rng(seed)
    spread = np.where(np.arange(12) < still, 10.0**exponent, 1.0)
    seen, other = (generator.normal(0, 1, (400, 12)) + generator.normal(0, 2, (400, 1)) for _ in range(2))
    moments = Moments.of_none(12)
    moments.add((3 + spread * seen).astype(np.float32))
    wanted = generator.uniform(-100, 100, (24, 12))
    found = descend(wanted, np.rint(wanted), moments.covariance)
    assert np.abs(found - wanted).max() <= 4
    covariance = np.cov(spread * other, rowvar=False)
    errors = [squared(whole, wanted, covariance).mean() for whole in (found, np.rint(wanted))]
    assert errors[0] <= errors[1]


def test_moments_are_those_of_the_windows() -> None:
    windows = np.random.default_rng(0).normal(2, 1, (50, 4)).astype(np.float32)
    moments = Moments(np.zeros((4, 4)), np.zeros(4))
    for part in np.array_split(windows, 3):
        moments.add(part)
    assert_allclose(moments.mean, windows.mean(axis=0), rtol=1e-5)
    covariance = np.cov(windows.T, bias=True)
    floor = FLOOR * np.diag(covariance).mean() * np.eye(4)
    assert_allclose(moments.covariance, covariance + floor, rtol=1e-3, atol=1e-5)


def test_the_first_convolution_s_moments_are_those_of_the_planes(graph: Graph, patches: Patches) -> None:
    head = graph[0]
    moments = input_moments(graph, patches.degraded)[head.name]
    planes = np.concatenate([planes_of(image) for image in patches.degraded])
    centre = moments.mean.reshape(3, 3, 3)[:, 1, 1]
    assert_allclose(centre, planes.mean(axis=(0, 2, 3)), rtol=0.05, atol=2e-3)


def to_nearest(_graph: Graph, core: IntCore, *_: object) -> IntCore:
    """What stands in the place of the pass: each weight rounded by itself."""
    return core


def test_every_layer_errs_less_on_what_it_reads(
    float_onnx: onnx.ModelProto, patches: Patches, unseen: Patches, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("beers_deploy.quant.quantise.fit_weights", to_nearest)
    nearest = quickly(float_onnx, patches)
    fitted = fit_weights(nearest.graph, nearest.core, input_moments(nearest.graph, patches.degraded))
    other = input_moments(nearest.graph, unseen.degraded)
    for op, before, after in zip(nearest.graph, nearest.core.ops, fitted.ops, strict=True):
        if isinstance(op, Conv) and isinstance(before, IntConv) and isinstance(after, IntConv):
            moments = other[op.name]
            wanted = op.weight.reshape(len(op.weight), -1) * 2.0**before.weight_frac_bits
            errors = [
                squared(whole.weight.reshape(wanted.shape), wanted, moments.covariance) for whole in (before, after)
            ]
            assert errors[1].mean() < errors[0].mean(), op.name


def test_it_lowers_the_network_s_error_on_unseen_patches(
    float_onnx: onnx.ModelProto, patches: Patches, unseen: Patches, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, errors = open_session(float_onnx), []
    for fits in (True, False):
        if not fits:
            monkeypatch.setattr("beers_deploy.quant.quantise.fit_weights", to_nearest)
        errors.append(compare(session, open_session(quickly(float_onnx, patches).host), unseen.pairs).mae)
    assert errors[0] < errors[1]
