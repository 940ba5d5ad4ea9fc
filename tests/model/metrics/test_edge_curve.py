from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.model.metrics.edge_curve import (
    FREQUENCIES,
    MtfCurve,
    apart,
    measure_curve,
    search_curve,
)
from beers_deploy.model.metrics.edge_search import Edge, edge_in, find_edges
from beers_deploy.model.metrics.mtf_basis import (
    CORNERS,
    PARTS,
    at_distances,
    mtf_at,
    responses,
    weights_of,
)
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.metrics.uneven_edge import (
    NUMBERS,
    EdgePixels,
    FittedEdge,
    normal_equations,
)

NOISE_DN = 4.0
INDICES = [2, 5, 10]
"""Indices of 0.1, 0.25 and 0.5 cycles per pixel in FREQUENCIES."""
CURVES = {
    "exponential": np.exp(-4.0 * CORNERS),
    "gaussian": np.exp(-8.0 * CORNERS**2),
    "steep at first": np.exp(-3.6 * CORNERS**0.9),
}


def noise(values: np.ndarray) -> np.ndarray:
    return np.full(np.shape(values), NOISE_DN**2)


def draw_region(
    weights: np.ndarray,
    generator: np.random.Generator,
    texture: float,
) -> np.ndarray:
    """Draw a region (H, W) with an edge between sloping sides, and texture some pixels wide."""
    height = 23
    width = 19
    y, x = np.mgrid[:height, :width].astype(float)
    y -= (height - 1) / 2
    x -= (width - 1) / 2
    place_px = generator.uniform(-1, 1)
    slope = generator.uniform(-0.4, 0.4)
    distance = (x - place_px - slope * y) / np.hypot(1, slope)
    share = at_distances(responses()[0] @ weights, distance.ravel()).reshape(height, width)
    left = 400 + generator.normal(0, 4) * y / height
    right = 1400 + generator.normal(0, 4) * y / height
    grain = generator.normal(size=(height + 2, width + 2))
    shifts = product(range(3), repeat=2)
    smooth = sum(grain[i : i + height, j : j + width] for i, j in shifts) / 3
    pixels = left * (1 - share) + right * share + texture * 1000 * smooth
    return np.asarray(pixels + generator.normal(0, NOISE_DN, (height, width)))


def edges_of(weights: np.ndarray, count: int, seed: int, texture: float = 0.0) -> list[Edge]:
    generator = np.random.default_rng(seed)
    edges = []
    for number in range(count):
        edge = edge_in(draw_region(weights, generator, texture), noise, f"edge {number}")
        assert not isinstance(edge, Refusal)
        edges.append(edge)
    return edges


@pytest.mark.parametrize("name", CURVES)
def test_the_curve_is_found_whatever_its_shape(name: str) -> None:
    weights = weights_of(CURVES[name])
    curve = measure_curve(edges_of(weights, 9, seed=2), np.random.default_rng(0))
    assert isinstance(curve, MtfCurve)
    truth = mtf_at(FREQUENCIES, weights)
    assert curve.contrast[INDICES] == pytest.approx(truth[INDICES], rel=0.06)
    assert (np.diff(curve.contrast) <= 0).all()
    assert (curve.low <= curve.contrast).all()
    assert (curve.contrast <= curve.high).all()
    assert curve.missing_edges == 0


def test_texture_widens_the_interval_which_holds_the_truth() -> None:
    weights = weights_of(CURVES["exponential"])
    truth = mtf_at(FREQUENCIES, weights)[INDICES]
    widths = []
    covered = []
    for seed in range(4):
        for texture in (0.0, 0.05):
            curve = measure_curve(
                edges_of(weights, 3, 10 + seed, texture), np.random.default_rng(0)
            )
            assert isinstance(curve, MtfCurve)
            widths.append(curve.high[INDICES] / curve.low[INDICES])
            covered.append((curve.low[INDICES] <= truth) & (truth <= curve.high[INDICES]))
    assert np.mean(covered) >= 0.8
    assert (np.median(widths[1::2], axis=0) > np.median(widths[::2], axis=0)).all()


def test_edges_that_contradict_the_others_are_named() -> None:
    sharp = edges_of(weights_of(CURVES["exponential"]), 6, seed=3)
    soft = edges_of(weights_of(np.exp(-7.0 * CORNERS)), 1, seed=4)
    hedges = [
        (EdgePixels(pixels.values, pixels.variance, "the hedge"), line) for pixels, line in soft
    ]
    curve = measure_curve([*sharp, *hedges], np.random.default_rng(0))
    assert isinstance(curve, MtfCurve)
    assert curve.contradicting == ("the hedge",)


def test_search_keeps_the_sharpest_edges_and_leaves_hedges_out() -> None:
    """Among steps and twice as many softer edges, the curve of the steps is found."""
    weights = weights_of(CURVES["exponential"])
    mixed = edges_of(weights, 12, seed=5)
    for number, softness_px in enumerate(np.random.default_rng(6).uniform(0.6, 4, 24)):
        mixed += edges_of(weights_of(np.exp(-(4 + softness_px) * CORNERS)), 1, seed=20 + number)
    curve = search_curve(mixed, np.random.default_rng(0))
    assert isinstance(curve, MtfCurve)
    assert curve.contrast[INDICES] == pytest.approx(mtf_at(FREQUENCIES, weights)[INDICES], rel=0.1)
    few = search_curve(mixed[:2], np.random.default_rng(0))
    assert isinstance(few, Refusal)
    assert "2 straight edges" in few.reason


def test_noise_alone_has_no_edge() -> None:
    pixels = np.random.default_rng(0).normal(1000, NOISE_DN, (64, 70))
    assert find_edges(pixels, noise, 4095, "plain") == []
    assert isinstance(edge_in(pixels[:20, :20], noise, "plain"), Refusal)


@given(st.floats(1, 6), st.floats(1, 6), st.floats(0, 0.25), st.floats(0, 0.25))
def test_axes_are_separated_by_the_lean_of_their_edges(
    x: float, y: float, lean_x: float, lean_y: float
) -> None:
    """A leaning edge mixes the squared losses of both axes; `apart` returns those of each axis."""
    detector = np.sinc(FREQUENCIES)

    def mixed_curve(own: float, other: float, lean: float) -> MtfCurve:
        loss = np.sqrt((1 - lean) * own**2 + lean * other**2) * FREQUENCIES
        contrast = detector * np.exp(-loss)
        return MtfCurve(contrast, contrast, contrast, 5, (), lean)

    verdict = apart(mixed_curve(x, y, lean_x), mixed_curve(y, x, lean_y))
    assert verdict.contrast == pytest.approx(detector * np.exp(-x * FREQUENCIES), abs=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_an_edge_of_a_curve_asks_for_that_curve(seed: int) -> None:
    """An edge whose residuals are explained by its line and planes asks for no other curve."""
    generator = np.random.default_rng(seed)
    pixels: Any = None
    line: Any = None
    normal = generator.normal(size=(80, NUMBERS))
    curve = generator.normal(size=(80, PARTS))
    explained = normal @ generator.normal(size=NUMBERS)
    edge = FittedEdge(pixels, line, 1.0, 0.0, normal, curve, explained, np.zeros(71, int))
    weights = generator.random(PARTS)
    for counts in (None, np.array([2.0])):
        gram, moment = normal_equations(edge, weights, counts)
        np.testing.assert_allclose(moment, gram @ weights, atol=1e-6)
