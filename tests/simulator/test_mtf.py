import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from model.simulator.mtf import gamma_from_mtf, mtf, transfer_function
from profiles.errors import OptionError

TWO_OVER_PI = 2 / math.pi


@given(st.floats(1e-4, TWO_OVER_PI))
def test_the_contrast_at_nyquist_is_the_one_asked_for(mtf_nyquist: float) -> None:
    at_nyquist = mtf(torch.tensor(0.5, dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64), mtf_nyquist)
    assert float(at_nyquist) == pytest.approx(mtf_nyquist, rel=1e-9)


@given(st.floats(1e-4, 0.6), st.floats(1e-4, 0.03))
def test_a_blurrier_sensor_has_a_larger_gamma(mtf_nyquist: float, more: float) -> None:
    assert gamma_from_mtf(mtf_nyquist) > gamma_from_mtf(mtf_nyquist + more)


def test_known_gammas() -> None:
    for mtf_nyquist, gamma in ((0.07, 4.415), (0.25, 1.869), (0.03, 6.110), (0.001, 12.91)):
        assert gamma_from_mtf(mtf_nyquist) == pytest.approx(gamma, abs=5e-3)
    assert gamma_from_mtf(TWO_OVER_PI) == 0


@pytest.mark.parametrize("impossible", [0.0, -0.1, 0.65, 1.0, math.nan, math.inf])
def test_an_amplifying_blur_is_refused(impossible: float) -> None:
    with pytest.raises(OptionError, match=r"0\.6366"):
        gamma_from_mtf(impossible)


def test_the_diagonal_is_darker_than_the_axis() -> None:
    half = torch.tensor(0.5, dtype=torch.float64)
    assert float(mtf(half, half, 0.07)) == pytest.approx(0.0179, abs=1e-4)


def test_the_sinc_keeps_its_sign_beyond_the_first_zero() -> None:
    f = torch.tensor([0.9, 1.1, 1.9, 2.1], dtype=torch.float64)
    assert torch.sign(mtf(f, torch.zeros(1, dtype=torch.float64), 0.25)).tolist() == [1, -1, -1, 1]


def test_the_mean_passes_unchanged() -> None:
    assert float(transfer_function(30, 42, 3, 0.07)[0, 0]) == 1.0
