"""Tests that drawn MTF curves are physically possible and have the requested Nyquist contrast."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.model.curves import FREQUENCIES, OBSCURATIONS, draw_table, pupil_contrast
from beers_deploy.model.departure import CURVES, departure, has_other_curve
from beers_deploy.model.family import SensorFamily, sensor_vector
from beers_deploy.model.io.tensors import read_conditioned
from beers_deploy.model.shipped import shipped_weights
from beers_deploy.model.variants import Kernels
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import READING, MtfTable
from tests.model.simulator.stages import NOMINAL, with_response

CONTRAST = st.floats(0.015, 0.15)


@given(CONTRAST, st.floats(0.4, 1), st.integers(0, 2**20))
def test_a_drawn_curve_has_the_requested_contrast_and_is_physically_possible(
    across: float, ratio: float, seed: int
) -> None:
    table = draw_table(across, ratio * across, np.random.default_rng(seed))
    assert table.at_nyquist == pytest.approx((across, ratio * across), rel=1e-6)
    for contrast in (table.across, table.along):
        values = np.array(contrast)
        assert values[0] == 1
        assert values.min() > 0
        assert (values <= np.sinc(FREQUENCIES) + READING).all()


@pytest.mark.parametrize("obscuration", OBSCURATIONS)
def test_a_pupil_has_its_closed_form(obscuration: float) -> None:
    """A clear pupil has the MTF 2 / pi (arccos s - s sqrt(1 - s^2)).

    An obscuration lowers the middle frequencies.
    """
    contrast = pupil_contrast(0.2, obscuration)
    assert contrast[-1] == pytest.approx(0.2, abs=1e-3)
    assert (np.diff(contrast) <= 1e-9).all()
    clear = pupil_contrast(0.2, 0.0)
    if obscuration:
        assert contrast[len(contrast) // 2] < clear[len(contrast) // 2]
        return
    shares = np.linspace(0, 1, 4001)
    closed = 2 / np.pi * (np.arccos(shares) - shares * np.sqrt(1 - shares**2))
    cutoff = float(np.interp(0.2, closed[::-1], shares[::-1]))
    np.testing.assert_allclose(
        contrast, np.interp(FREQUENCIES / 0.5 * cutoff, shares, closed), atol=0.005
    )


def with_curve(contrast: np.ndarray) -> Instrument:
    values = tuple(contrast.tolist())
    return with_response(NOMINAL, MtfTable(tuple(FREQUENCIES.tolist()), values, values))


@given(CONTRAST, st.floats(0.4, 1), st.integers(0, 2**20))
def test_no_drawn_sensor_departs_from_training(contrast: float, ratio: float, seed: int) -> None:
    table = draw_table(contrast, ratio * contrast, np.random.default_rng(seed))
    sensor = with_response(NOMINAL, table)
    assert "may restore worse" not in departure(sensor, "fitted")
    formula = replace(NOMINAL, mtf_nyquist=contrast, mtf_nyquist_along=ratio * contrast)
    assert departure(formula, "fitted") == departure(formula, "cut") == ""
    assert not has_other_curve(formula)


@pytest.mark.parametrize(
    ("bend", "behind_cut", "behind_fitted"),
    [
        (0.02, "", ""),
        (-0.1, f"{CURVES} was trained on such curves", f"{CURVES} is about level"),
        (0.1, f"{CURVES} was trained on such curves", f"{CURVES} is about level"),
        (-0.45, "may restore worse", "may restore worse"),
    ],
)
def test_a_curve_that_a_network_does_not_know_is_a_warning(
    bend: float, behind_cut: str, behind_fitted: str
) -> None:
    formula = (0.07 / np.sinc(0.5)) ** (FREQUENCIES / 0.5) * np.sinc(FREQUENCIES)
    hill = np.exp(-(((FREQUENCIES - 0.25) / 0.1) ** 2))
    sensor = with_curve(formula * (1 + bend * hill))
    assert has_other_curve(sensor) == bool(behind_cut)
    expected: dict[Kernels, str] = {"cut": behind_cut, "fitted": behind_fitted}
    for kernels, words in expected.items():
        message = departure(sensor, kernels)
        assert bool(message) == bool(words)
        assert words in message
        assert (CURVES in message) == (CURVES in words)


def test_the_recommended_network_is_shipped_and_was_trained_on_such_curves() -> None:
    assert read_conditioned(shipped_weights(CURVES)).kernels == "fitted"


def test_a_family_draws_other_curves_in_their_share_and_none_is_outside_the_ranges() -> None:
    family = SensorFamily(NOMINAL, other_curves=0.5)
    generator = np.random.default_rng(0)
    curves = [family.draw(generator) for _ in range(400)]
    assert np.mean([sensor.response is not None for sensor in curves]) == pytest.approx(
        0.5, abs=0.08
    )
    assert all(sensor_vector(sensor).outside == () for sensor in curves)
