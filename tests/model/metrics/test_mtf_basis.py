import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.model.metrics.mtf_basis import (
    CORNERS,
    PARTS,
    at_distances,
    mtf_at,
    responses,
    weights_of,
)

LOSSES = st.lists(st.floats(0, 2), min_size=PARTS - 1, max_size=PARTS - 1)


def falling(losses: list[float]) -> np.ndarray:
    """Return the weights of a curve whose logarithm falls by `losses` from corner to corner."""
    return weights_of(np.exp(-np.cumsum([0.0, *losses])))


@given(LOSSES)
def test_weights_give_the_curve_at_the_corners_and_fall_between(losses: list[float]) -> None:
    weights = falling(losses)
    assert weights.min() >= 0
    assert weights.sum() == pytest.approx(1)
    optics = np.exp(-np.cumsum([0.0, *losses]))
    assert mtf_at(CORNERS, weights) == pytest.approx(optics * np.sinc(CORNERS), abs=1e-12)
    fine = np.linspace(0, 1, 401)
    assert (np.diff(mtf_at(fine, weights)) <= 1e-12).all()
    assert (mtf_at(fine, weights) <= np.sinc(fine) + 1e-12).all()


def edge_response(distance: np.ndarray, gamma: float) -> np.ndarray:
    """Return a unit step at 0 blurred by the profile's MTF, as the sum of its Fourier integral."""
    step = 1 / 64
    f = (np.arange(8 * 64) + 0.5) * step
    waves = np.exp(-gamma * f) * np.sinc(f) / (np.pi * f) * step
    return np.asarray(0.5 + np.sin(2 * np.pi * np.outer(distance, f)) @ waves)


@pytest.mark.parametrize("gamma", [2.0, 4.4, 7.0])
def test_the_edge_is_that_of_the_profiles_formula(gamma: float) -> None:
    """The tolerance is for the corners, 0.05 cycles per pixel apart, and frequencies beyond 1."""
    distance = np.linspace(-9, 9, 73)
    weights = weights_of(np.exp(-gamma * CORNERS))
    edges, lines = responses()
    assert at_distances(edges @ weights, distance) == pytest.approx(
        edge_response(distance, gamma), abs=0.006
    )
    rise = at_distances(edges @ weights, distance + 0.05) - at_distances(
        edges @ weights, distance - 0.05
    )
    assert rise / 0.1 == pytest.approx(at_distances(lines @ weights, distance), abs=0.01)
