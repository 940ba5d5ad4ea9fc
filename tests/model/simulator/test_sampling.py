"""Tests that one fused pass equals the effects one by one at full resolution, without a shift."""

import logging
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from beers_deploy.model.simulator.mtf import mtf, smear_response, transfer_function
from beers_deploy.model.simulator.sampling import resample, sample, scene_of, scene_spectrum
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.sensor import Sensor
from tests.model.simulator import stages


def scene(height: int, width: int, seed: int = 0) -> np.ndarray:
    return 20 + 100 * np.random.default_rng(seed).random((height, width), np.float32)


def one_after_the_other(
    radiance: np.ndarray, ratio: int, mtf_nyquist: float, sigma: float, smear: float
) -> np.ndarray:
    """Blur, smear and shift with a float64 transform each; then take every r-th pixel."""
    height, width = radiance.shape
    fy = np.fft.fftfreq(height, 1 / ratio)[:, None]
    fx = np.fft.rfftfreq(width, 1 / ratio)[None]
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
    st.integers(1, 8),
    st.floats(0.01, 0.3),
    st.floats(0, 0.3),
    st.floats(0, 3),
    st.integers(2, 23),
    st.integers(1, 21),
    st.integers(0, 99),
)
def test_fused_equals_sequential(
    ratio: int, mtf_nyquist: float, sigma: float, smear: float, rows: int, columns: int, seed: int
) -> None:
    radiance = 300 * np.random.default_rng(seed).random((rows * ratio, columns * ratio), np.float32)
    fused = stages.blurred(radiance, ratio, mtf_nyquist, sigma, smear)
    expected = one_after_the_other(radiance, ratio, mtf_nyquist, sigma, smear)
    assert np.abs(fused - expected).max() < 5e-4


@pytest.mark.parametrize("factor", [1, 16])
def test_counts_of_another_scale_are_warned_about(
    factor: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Counts of 12 bits in steps of 16 would all saturate, and teach a network nothing."""
    counts = np.full((8, 8), 900 * factor, np.uint16)
    with caplog.at_level(logging.WARNING):
        scene_of("counts.tif", counts, Sensor.load("pleiades-reference").nominal())
    assert ("counts.tif: 100 % of its pixels" in caplog.text) == (factor > 1)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_scene_with_a_pixel_without_a_value_is_refused(value: float) -> None:
    pixels = scene(9, 7)
    pixels[8, 3] = value
    with pytest.raises(ImageError, match="a has pixels that are NaN or infinite"):
        scene_of("a", pixels, Sensor.load("pleiades-reference").nominal())


def test_a_stack_of_scenes_is_sampled_one_by_one() -> None:
    scenes = np.stack([scene(39, 63, seed) for seed in range(3)])
    transfer = transfer_function(39, 63, 3, 0.07)
    stack = sample(scene_spectrum(scenes), transfer, 63, 3)
    assert stack.shape == (3, 13, 21)
    for one, image in zip(scenes, stack, strict=True):
        assert_allclose(stages.blurred(one, 3, 0.07), image, rtol=0, atol=1e-4)


def wave(height: int, width: int, cycles: tuple[int, int]) -> np.ndarray:
    """Return a plane wave over the whole scene, sampled at pixel centres."""
    y, x = ((np.arange(n) + 0.5) / n for n in (height, width))
    phase = 2 * math.pi * (cycles[0] * y[:, None] + cycles[1] * x) + 0.7
    return (100 + 30 * np.cos(phase)).astype(np.float32)


@pytest.mark.parametrize(("height", "width"), [(48, 70), (75, 90), (31, 41), (60, 84)])
@pytest.mark.parametrize("cycles", [(0, 0), (3, 5), (11, 2), (0, 13)])
def test_a_wave_that_both_grids_hold_is_the_same_wave(
    height: int, width: int, cycles: tuple[int, int]
) -> None:
    result = resample(wave(60, 84, cycles), height, width)
    assert_allclose(result, wave(height, width, cycles), rtol=0, atol=1e-3, strict=True)


@pytest.mark.parametrize(("height", "width"), [(96, 72), (40, 33), (96, 33)])
def test_rows_and_columns_are_resampled_alike(height: int, width: int) -> None:
    """A half spectrum counts its inner columns twice, but not that of the Nyquist frequency."""
    noise = scene(64, 48)
    result = resample(noise, height, width)
    assert_allclose(resample(noise.T, width, height), result.T, rtol=0, atol=1e-3)


def test_frequencies_beyond_the_new_grid_are_cut_not_aliased() -> None:
    result = resample(wave(60, 84, (0, 30)), 40, 40)
    assert_allclose(result, np.full((40, 40), 100.0, np.float32), rtol=0, atol=1e-3, strict=True)
