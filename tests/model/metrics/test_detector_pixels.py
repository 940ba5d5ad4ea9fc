"""Tests that dead and hot pixels are found, but no stars, texture or clipped noise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from beers_deploy.model.metrics.detector_pixels import PATCH_PX, wrong_pixels

SIDE_PX = 90
LEVEL = 500.0
NOISE = 5.0
seeds = st.integers(0, 2**20)


def ground(seed: int, side_px: int = SIDE_PX) -> np.ndarray:
    return np.random.default_rng(seed).normal(LEVEL, NOISE, (side_px, side_px))


def positions(image: np.ndarray) -> list[tuple[int, ...]]:
    return [tuple(place) for place in wrong_pixels(np.rint(image).astype(np.float32), 1.0).tolist()]


@settings(max_examples=25)
@given(
    seeds,
    st.integers(PATCH_PX, SIDE_PX - PATCH_PX - 1),
    st.integers(PATCH_PX, SIDE_PX - PATCH_PX - 1),
)
def test_dead_and_hot_pixels_are_found_and_nothing_else(seed: int, row: int, column: int) -> None:
    for value in (0, LEVEL + 100 * NOISE, 4095):
        image = ground(seed)
        image[row, column] = value
        assert positions(image) == [(row, column)]


@settings(max_examples=25)
@given(seeds, st.floats(0.6, 2), st.floats(50, 5000), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_a_star_is_not_a_hot_pixel(
    seed: int, sigma_px: float, peak: float, down_px: float, right_px: float
) -> None:
    rows, columns = np.mgrid[:SIDE_PX, :SIDE_PX]
    distance = (rows - 45 - down_px) ** 2 + (columns - 45 - right_px) ** 2
    star = peak * np.exp(-distance / (2 * sigma_px**2))
    image = np.random.default_rng(seed).normal(LEVEL + star, np.sqrt(NOISE**2 + star / 20))
    assert positions(np.minimum(image, 4095)) == []


@settings(max_examples=15)
@given(seeds, st.floats(0.7, 3), st.floats(0, 60))
def test_blurred_texture_is_a_scene(seed: int, sigma_px: float, contrast: float) -> None:
    rough = gaussian_filter(
        np.random.default_rng(seed).standard_normal((SIDE_PX, SIDE_PX)), sigma_px
    )
    assert positions(ground(seed + 1) + contrast * rough / rough.std()) == []


@pytest.mark.parametrize("end", [0.0, 500.0])
@pytest.mark.parametrize("beyond", [0.5, 1.5, 3.0])
def test_noise_that_reaches_over_an_end_of_the_range_is_noise(end: float, beyond: float) -> None:
    sign = 1 if end else -1
    image = np.random.default_rng(1).normal(end + sign * beyond * NOISE, NOISE, (400, 400))
    assert positions(np.clip(image, 0, 500)) == []


@pytest.mark.parametrize("value", [np.nan, 7.0])
@pytest.mark.parametrize("shape", [(1, 1), (9, 9), (8, 40), (40, 8), (10, 11)])
def test_small_constant_or_missing_images_have_none(shape: tuple[int, int], value: float) -> None:
    assert not len(wrong_pixels(np.full(shape, value, np.float32)))


def test_a_pixel_next_to_missing_ones_is_not_judged() -> None:
    image = ground(3).astype(np.float32)
    image[40, 40] = 4095
    image[40, 41] = np.nan
    image[60, 60] = 4095
    image[62:64, 63] = np.nan
    assert wrong_pixels(image, 1.0).tolist() == [[60, 60]]
