"""Tests of the interval of a restored pixel: its half-widths and its stored form."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.model.family import noise_over_full_scale
from beers_deploy.model.interval import LEAST_DETAIL, MIDDLE_NOISE, PixelInterval
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.instrument import pixel_noise
from tests.model.exponents import EXPONENTS
from tests.model.simulator.stages import NOMINAL

INTERVAL = PixelInterval(EXPONENTS, {50: 0.7, 90: 1.8}, 40)
MAX_DN = float(NOMINAL.max_dn)


def test_half_widths_follow_the_formula_and_the_units() -> None:
    """The half-widths equal the formula pixel by pixel, and scale with the pixel values."""
    generator = np.random.default_rng(3)
    pixels = generator.integers(0, 4096, (9, 11)).astype(np.uint16)
    known = np.ones(pixels.shape, bool)
    half = INTERVAL.for_sensor(NOMINAL, MAX_DN, 90).of(pixels, known)
    window = pixels[3:6, 4:7].astype(np.float64)
    dark, growth, square, _ = pixel_noise(NOMINAL, MAX_DN)
    light = window.mean()
    sigma = math.sqrt(dark + growth * light + square * light**2)
    middle = noise_over_full_scale(NOMINAL) * MAX_DN
    n = math.log(middle / MAX_DN / MIDDLE_NOISE)
    t = math.log(sigma / middle)
    # The MTF of this sensor is that of the middle, so that m is 0.
    growth = (window.std() / sigma) ** (0.4 + 0.02 * n + 0.05 * t)
    expected = 1.8 * sigma * growth * math.exp(0.1 * n + 0.15 * t)
    assert half[4, 5] == pytest.approx(expected, rel=1e-6)
    assert half.dtype == np.float32
    # The same image in other units, here fractions of full scale.
    scaled = INTERVAL.for_sensor(NOMINAL, 1.0, 90).of(pixels / MAX_DN, known)
    assert_allclose(scaled * MAX_DN, half, rtol=1e-5)


def test_windows_need_one_pixel_of_context_and_leave_missing_pixels_out() -> None:
    generator = np.random.default_rng(4)
    pixels = generator.integers(0, 4096, (20, 20)).astype(np.float32)
    known = np.ones(pixels.shape, bool)
    width = INTERVAL.for_sensor(NOMINAL, MAX_DN, 90)
    whole = width.of(pixels, known)
    assert_array_equal(width.of(pixels[6:15], known[6:15])[1:-1], whole[7:14])
    # Negative control: without context the outer rows differ.
    assert (width.of(pixels[6:15], known[6:15])[0] != whole[6]).any()
    known[10, 10] = False
    corrupted = [pixels.copy() for _ in range(3)]
    for image, value in zip(corrupted, (0.0, MAX_DN, np.nan), strict=True):
        image[10, 10] = value
    first, *others = (width.of(image, known) for image in corrupted)
    assert np.isnan(first[10, 10])
    assert np.isfinite(first).sum() == first.size - 1
    for half in others:
        assert_array_equal(half, first)
    far = np.ones(pixels.shape, bool)
    far[9:12, 9:12] = False
    assert_array_equal(first[far], whole[far])


def test_flat_ground_has_a_width_and_none_exceeds_full_scale() -> None:
    flat = np.full((5, 5), 1000, np.uint16)
    width = INTERVAL.for_sensor(NOMINAL, MAX_DN, 90)
    half = width.of(flat, np.ones(flat.shape, bool))
    dark, growth, *_ = pixel_noise(NOMINAL, MAX_DN)
    sigma = math.sqrt(dark + growth * 1000)
    least = EXPONENTS.half_widths(width.conditions, np.array(sigma), np.array(LEAST_DETAIL))
    assert half[2, 2] == pytest.approx(1.8 * least)
    huge = replace(width, quantile=1e6)
    assert huge.of(flat, np.ones(flat.shape, bool)).max() == MAX_DN


def test_a_stored_interval_is_read_back() -> None:
    assert PixelInterval.from_json(INTERVAL.to_json(), "a.onnx") == INTERVAL
    assert "\n" not in INTERVAL.to_json()


RECORD = json.loads(INTERVAL.to_json())


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        '"a\\u001b[31m"',
        json.dumps({**RECORD, "quantiles": {}}),
        json.dumps({**RECORD, "quantiles": {"90": 1e9}}),
        json.dumps({**RECORD, "quantiles": {"91": 1.0}}),
        json.dumps({**RECORD, "acquisitions": "many"}),
        json.dumps({**RECORD, "exponents": {**RECORD["exponents"], "detail": 1e300}}),
        json.dumps({**RECORD, "exponents": {**RECORD["exponents"], "other": 1}}),
        INTERVAL.to_json().replace("0.4", "NaN"),
    ],
)
def test_a_damaged_interval_is_refused_in_one_sentence(text: str) -> None:
    with pytest.raises(ModelError, match=r"^The interval in the metadata of a\.onnx is damaged"):
        PixelInterval.from_json(text, "a.onnx")
