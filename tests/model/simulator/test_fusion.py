"""One fused pass computes what the effects would, one after the other, at full resolution."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.model.simulator.mtf import mtf, smear_response, transfer_function
from beers_deploy.model.simulator.sampling import sample, scene_spectrum
from beers_deploy.profiles.effects import Haze
from tests.model.simulator import stages

GAIN = 10.2375


def one_after_the_other(
    radiance: np.ndarray, ratio: int, mtf_nyquist: float, sigma: float, smear: float
) -> np.ndarray:
    """Blur, then smear, then shift, each with a transform of its own in float64; then pick every r-th pixel."""
    height, width = radiance.shape
    fy, fx = np.fft.fftfreq(height, 1 / ratio)[:, None], np.fft.rfftfreq(width, 1 / ratio)[None]
    shift = 2j * math.pi * (ratio - 1) / 2 / ratio
    image = radiance.astype(np.float64)
    for response in (
        mtf(fx, fy, mtf_nyquist, sigma),
        smear_response(fy, smear),
        np.exp(shift * fy) * np.exp(shift * fx),
    ):
        image = np.fft.irfft2(np.fft.rfft2(image) * response, s=(height, width))
    return image[::ratio, ::ratio]


@settings(max_examples=40)
@given(
    st.integers(1, 6), st.floats(0.01, 0.3), st.floats(0, 0.3), st.floats(0, 3),
    st.integers(10, 23), st.integers(10, 21), st.integers(0, 99),
)  # fmt: skip
def test_fused_equals_sequential(
    ratio: int, mtf_nyquist: float, sigma: float, smear: float, rows: int, columns: int, seed: int
) -> None:
    radiance = 300 * np.random.default_rng(seed).random((rows * ratio, columns * ratio), np.float32)
    transfer = transfer_function(*radiance.shape, ratio, mtf_nyquist, sigma, smear)
    fused = sample(scene_spectrum(radiance), transfer, radiance.shape[1], ratio)
    expected = one_after_the_other(radiance, ratio, mtf_nyquist, sigma, smear)
    assert np.abs(fused - expected).max() * GAIN < 0.02


@pytest.mark.parametrize("ratio", [1, 2, 3, 5, 8])
def test_haze_after_sampling_equals_haze_before_the_blur(ratio: int) -> None:
    """An affine change of the light commutes with a blur that keeps the mean: so it may wait for the small grid."""
    haze, radiance = Haze(0.7, 15.0), 300 * np.random.default_rng(0).random((17 * ratio, 23 * ratio), np.float32)
    transfer = transfer_function(*radiance.shape, ratio, 0.07, 0.2, 1.5)
    fused = stages.alone(haze, sample(scene_spectrum(radiance), transfer, radiance.shape[1], ratio))
    expected = one_after_the_other(stages.alone(haze, radiance.astype(np.float64)), ratio, 0.07, 0.2, 1.5)
    assert np.abs(fused - expected).max() * GAIN < 0.02
