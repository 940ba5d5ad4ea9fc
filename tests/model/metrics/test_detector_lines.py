"""Tests that lines of another gain are found with their gain, and lines of a scene are not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from beers_deploy.model.metrics.detector_lines import constant_columns, join_blocks, measure_lines
from beers_deploy.model.metrics.detector_stripes import Stripes, judge_lines

LEAST = 0.003
SIGMA_PX = {"25 %": 0.53, "15 %": 0.62, "5 %": 0.78}
"""The sigma of a Gaussian blur by its MTF at Nyquist."""
seeds = st.integers(0, 2**20)


def judged(image: np.ndarray, rows_px: int = 64) -> Stripes:
    """Judge the columns of an image in blocks of rows."""
    blocks = [
        image[top : top + rows_px].astype(np.float32) for top in range(0, len(image), rows_px)
    ]
    return judge_lines(
        join_blocks([measure_lines(block, np.isfinite(block)) for block in blocks]), LEAST
    )


def noisy(image: np.ndarray, generator: np.random.Generator, noise: float = 4.0) -> np.ndarray:
    return np.asarray(np.rint(image + generator.normal(0, noise, image.shape)), np.float32)


@settings(max_examples=15)
@given(seeds, st.integers(16, 180), st.floats(50, 3000), st.sampled_from([2.0, 4.0, 40.0]))
def test_flat_ground_has_no_lines(seed: int, width: int, level: float, noise: float) -> None:
    faults = judged(noisy(np.full((512, width), level), np.random.default_rng(seed), noise))
    assert not faults.significant
    assert not faults.off
    assert not faults.dead


@settings(max_examples=15)
@given(seeds, st.integers(250, 500), st.floats(0.006, 0.03))
def test_the_spread_of_the_gains_is_measured(seed: int, width: int, rms: float) -> None:
    generator = np.random.default_rng(seed)
    gains = 1 + rms * generator.standard_normal(width)
    faults = judged(noisy(600 * gains * np.ones((512, 1)), generator))
    assert faults.significant
    assert faults.spread == pytest.approx(rms, rel=0.5)


@pytest.mark.parametrize("rms", [0.0, 0.001])
def test_the_interval_of_the_spread_holds_it_in_95_percent_of_images(rms: float) -> None:
    """Where the lines are alike, too: there a spread below its error is drawn half of the time."""
    held = 0
    for seed in range(60):
        generator = np.random.default_rng(seed)
        gains = 1 + rms * generator.standard_normal(300)
        low, high = judged(noisy(600 * gains * np.ones((256, 1)), generator)).spread_interval
        held += low <= rms <= high
    assert held >= 54  # 57 are expected, with a standard deviation of 1.7


@settings(max_examples=20)
@given(seeds, st.integers(4, 95), st.sampled_from([-0.2, -0.02, 0.01, 0.3]))
def test_a_single_column_is_found_with_its_gain(seed: int, column: int, gain: float) -> None:
    image = np.full((512, 100), 600.0)
    image[:, column] *= 1 + gain
    (line,) = judged(noisy(image, np.random.default_rng(seed))).off
    assert line.index == column
    assert line.gain == pytest.approx(gain, abs=0.004)


@pytest.mark.parametrize("sigma_px", SIGMA_PX.values(), ids=list(SIGMA_PX))
@pytest.mark.parametrize("width_px", [1, 2, 5, 40])
@pytest.mark.parametrize("shift_px", [0, 1, 2])
def test_a_blurred_road_along_the_columns_is_a_scene(
    sigma_px: float, width_px: int, shift_px: int
) -> None:
    # One sample is a third of a pixel, so that the road can begin within a pixel.
    fine = np.full((512, 300), 600.0)
    fine[:, 150 + shift_px : 150 + shift_px + 3 * width_px] = 900
    blurred = gaussian_filter(fine, (0, 3 * sigma_px), mode="nearest")
    image = blurred[:, 1::3]
    assert not judged(noisy(image, np.random.default_rng(shift_px))).off


@settings(max_examples=10)
@given(seeds, st.sampled_from([0.0, 7.0, 4095.0]), st.integers(1, 98))
def test_a_dead_column_is_found_and_its_neighbours_are_not(
    seed: int, value: float, column: int
) -> None:
    image = noisy(np.full((512, 100), 600.0), np.random.default_rng(seed))
    image[:, column] = value
    faults = judged(image)
    assert faults.dead == (column,)
    assert not {line.index for line in faults.off} & {column - 1, column, column + 1}


def test_a_margin_and_a_constant_image_are_no_dead_columns() -> None:
    image = noisy(np.full((64, 50), 600.0), np.random.default_rng(0))
    image[:, :5] = 0
    image[:, -1] = 0
    assert not constant_columns(image).any()
    assert not constant_columns(np.full((64, 50), 7.0)).any()
    image[:, 20:22] = 3
    assert np.flatnonzero(constant_columns(image)).tolist() == [20, 21]
    image[:, 30] = np.nan
    assert np.flatnonzero(constant_columns(image)).tolist() == [20, 21]


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (5, 5), (3, 200), (200, 3), (64, 7)])
@pytest.mark.parametrize("value", [0.0, 5.0, np.nan])
def test_images_too_small_or_empty_have_no_faults(shape: tuple[int, int], value: float) -> None:
    faults = judged(np.full(shape, value))
    assert (faults.significant, faults.off, faults.dead) == (False, (), ())
