import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.model.simulator.mtf import mtf
from beers_deploy.profiles.errors import OptionError

TWO_OVER_PI = 2 / math.pi
FREQUENCIES = st.floats(-3, 3)


@given(st.floats(1e-4, TWO_OVER_PI), FREQUENCIES, FREQUENCIES)
def test_it_is_the_formula_of_the_paper(mtf_nyquist: float, fx: float, fy: float) -> None:
    """The sinc of a pixel keeps its sign, and a circular decay gives the contrast at Nyquist."""
    decay = (mtf_nyquist / TWO_OVER_PI) ** (2 * math.hypot(fx, fy))
    expected = decay * np.sinc(fx) * np.sinc(fy)
    assert float(mtf(fx, fy, mtf_nyquist)) == pytest.approx(expected, rel=1e-9, abs=0)


def grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    fy, fx = (np.fft.fftfreq(side, 1 / 3) for side in (height, width))
    return fx[None, :], fy[:, None]


@given(st.floats(1e-3, 0.5), st.floats(1e-3, 0.5), st.sampled_from([0.0, 0.2]))
def test_each_axis_keeps_the_contrast_stated_for_it(
    across: float, along: float, sigma_px: float
) -> None:
    assert float(mtf(0.5, 0.0, (across, along), sigma_px)) == pytest.approx(across, rel=1e-9)
    assert float(mtf(0.0, 0.5, (across, along), sigma_px)) == pytest.approx(along, rel=1e-9)


@given(st.floats(1e-4, 0.5), st.integers(2, 31), st.integers(2, 31))
def test_two_equal_axes_are_one_to_the_last_bit(
    mtf_nyquist: float, height: int, width: int
) -> None:
    fx, fy = grid(height, width)
    assert np.array_equal(mtf(fx, fy, (mtf_nyquist, mtf_nyquist)), mtf(fx, fy, mtf_nyquist))


@given(st.floats(0.01, 0.5), st.integers(2, 31), st.integers(2, 31))
def test_the_formula_of_two_axes_meets_that_of_one(
    mtf_nyquist: float, height: int, width: int
) -> None:
    """Axes that differ in the last digits use the other branch, which must give the same MTF."""
    fx, fy = grid(height, width)
    near = mtf(fx, fy, (mtf_nyquist, mtf_nyquist * (1 + 1e-12)))
    np.testing.assert_allclose(near, mtf(fx, fy, mtf_nyquist), rtol=1e-10, atol=1e-14)


IMPOSSIBLE = [0.0, -0.1, 0.65, 1.0, math.nan, math.inf]


@pytest.mark.parametrize("blur", [*IMPOSSIBLE, (0.07, 0.0), (0.7, 0.07), (0.07, math.nan)])
def test_an_amplifying_blur_is_refused(blur: float | tuple[float, float]) -> None:
    with pytest.raises(OptionError, match=r"0\.6366"):
        mtf(*grid(5, 7), blur)
