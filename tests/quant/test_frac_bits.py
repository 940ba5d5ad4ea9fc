import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.errors import ProfileError
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.core import SHIFTS, target_shifts
from beers_deploy.quant.frac_bits import best_frac_bits, quantize, unclipped_frac_bits


@given(st.floats(1e-6, 1e6))
def test_the_coarsest_scale_clips_nothing_and_one_finer_does(max_abs: float) -> None:
    frac_bits = unclipped_frac_bits(max_abs)
    assert max_abs * 2.0**frac_bits <= 127 < max_abs * 2.0 ** (frac_bits + 1)


@given(st.integers(0, 2**31), st.floats(1e-4, 1e3))
def test_the_best_scale_has_the_least_squared_error(seed: int, scale: float) -> None:
    values = (np.random.default_rng(seed).standard_normal(400) * scale).astype(np.float32)
    best = best_frac_bits(values)

    def error(frac_bits: int) -> float:
        restored = np.clip(np.rint(values * 2.0**frac_bits), -128, 127) / 2.0**frac_bits
        return float(((values - restored) ** 2).sum())

    assert error(best) <= min(error(best + k) for k in (-2, -1, 1, 2)) * (1 + 1e-5)


def test_an_outlier_is_clipped_rather_than_coarsening_the_rest_and_zeros_have_a_scale() -> None:
    values = np.concatenate([np.linspace(-1, 1, 10_001), [4.0]])
    assert best_frac_bits(values) > unclipped_frac_bits(4.0)
    assert best_frac_bits(np.zeros(3)) == 0


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.5, 1), (-0.5, -1), (1.5, 2), (126.5, 127), (300.0, 127), (-300.0, -128)],
)
def test_constants_round_half_away_from_zero_and_saturate(value: float, expected: int) -> None:
    assert quantize(np.array([value]), 0)[0] == expected


def test_the_windows_are_those_of_the_target() -> None:
    """The built-in windows, for callers without a board, are those of the shipped profile."""
    assert target_shifts(TargetProfile.load("vck190")) == SHIFTS
    with pytest.raises(ProfileError, match="shift_"):
        target_shifts(TargetProfile.load("host-cpu"))
