"""Tests of exposure: the factors that a sensor allows, and the pixels that get each factor."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.stride_tricks import sliding_window_view
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from beers_deploy.model.exposure import (
    EDGE_RADIUS_PX,
    FACTORS,
    FINEST,
    GAIN_NOISE,
    HEADROOM,
    INTEGER_FACTORS,
    INTEGER_NOISE,
    INTEGER_STEP,
    MOST_FACTORS,
    NOISE_BEYOND,
    SHARPEST,
    SHARPEST_IN_DARK,
    UNCHANGED,
    brightened,
    choose_factors,
    exposures_for,
    factors_for,
    noise_excess,
)
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from tests.model.simulator.stages import NOMINAL

FULL_SCALE = 4095.0


def noisier(times: float) -> Instrument:
    """Return the nominal sensor with `times` its noise."""
    return replace(NOMINAL, alpha=NOMINAL.alpha * times**2, beta=NOMINAL.beta * times**2)


@given(st.floats(0.05, 20))
def test_factors_begin_with_1_rise_and_stay_within_training(times: float) -> None:
    factors = factors_for(noisier(times))
    assert factors[0] == 1
    assert list(factors) == sorted(set(factors))
    assert set(factors) <= {1, *FACTORS}
    assert len(factors) <= 1 + MOST_FACTORS
    sensor = noisier(times)
    assert all(noise_excess(sensor, factor) <= NOISE_BEYOND for factor in factors[1:])
    if factors[-1] < max(FACTORS):
        assert noise_excess(sensor, 2 * factors[-1]) > NOISE_BEYOND


@pytest.mark.parametrize(
    ("name", "factors"),
    [("pleiades-degraded", (1, 4, 8)), ("dior-medium", (1, 2, 4)), ("dior-high", (1,))],
)
def test_the_factors_of_shipped_sensors(name: str, factors: tuple[int, ...]) -> None:
    assert factors_for(Sensor.load(name).nominal()) == factors


@given(st.floats(0.05, 20))
def test_an_integer_network_has_the_gain_of_training_and_is_finer_by_the_rest(
    times: float,
) -> None:
    """The gain has as much of a factor as the training range allows. The highest factor is the
    largest at which the noise is not too much, and the lower one is INTEGER_STEP times smaller.
    """
    sensor = noisier(times)
    dimmed, unchanged, *exposures = exposures_for(sensor, int8=True)
    assert (dimmed.factor, dimmed.gain) == (0.5, 1)
    assert unchanged == UNCHANGED
    factors = [exposure.factor for exposure in exposures]
    assert set(factors) <= set(INTEGER_FACTORS)
    for exposure in exposures:
        assert exposure.gain * exposure.finer == exposure.factor
        assert exposure.gain == 1 or noise_excess(sensor, exposure.gain) <= GAIN_NOISE
        if exposure.finer > 1:
            assert exposure.finer <= FINEST
            assert noise_excess(sensor, exposure.factor) <= INTEGER_NOISE
            assert exposure.gain == 8 or noise_excess(sensor, 2 * exposure.gain) > GAIN_NOISE
    highest = max(factors, default=1)
    if highest < max(INTEGER_FACTORS) and all(exposure.finer < FINEST for exposure in exposures):
        assert noise_excess(sensor, 2 * highest) > INTEGER_NOISE
    if len(factors) > 1:
        assert factors == [factors[1] / INTEGER_STEP, factors[1]]


@given(st.floats(0.05, 20))
def test_a_float_network_has_the_whole_factor_as_gain(times: float) -> None:
    exposures = exposures_for(noisier(times), int8=False)
    assert all(exposure.finer == 1 for exposure in exposures)
    assert tuple(exposure.factor for exposure in exposures) == factors_for(noisier(times))


@pytest.mark.parametrize("factor", FACTORS)
def test_a_brightened_sensor_has_more_gain_and_is_otherwise_the_same(factor: int) -> None:
    sensor = Sensor.load("pleiades-variable")
    other = brightened(sensor, factor)
    changed = {
        item.name
        for item in fields(sensor)
        if getattr(sensor, item.name) != getattr(other, item.name)
    }
    assert changed == {"gain_dn_per_radiance"}
    assert other.gain_dn_per_radiance.low == factor * sensor.gain_dn_per_radiance.low
    assert other.nominal().mtf_axes == sensor.nominal().mtf_axes
    assert other.noise(50.0) == sensor.noise(50.0)


def image_of(seed: int, height: int, width: int) -> NDArray[np.float32]:
    """Draw dark ground with some bright pixels, in integer digital numbers."""
    generator = np.random.default_rng(seed)
    pixels = generator.integers(0, 300, (height, width)).astype(np.float32)
    bright = generator.random((height, width)) < 0.02
    pixels[bright] = generator.integers(0, 4096, bright.sum())
    return pixels


sides = st.integers(1, 60)


@settings(max_examples=60)
@given(st.integers(0, 999), sides, sides, st.integers(1, 14), st.sampled_from([0.0, 120.0]))
def test_a_pixel_gets_the_highest_factor_that_leaves_headroom(
    seed: int, height: int, width: int, radius_px: int, offset: float
) -> None:
    """The reference is a loop over pixels.

    HEADROOM and the limits of edges hold within their radii, unless a pixel gets the smallest
    factor.
    """
    image = image_of(seed, height, width)
    factors = (0.5, 1, 4, 8)
    selected = choose_factors(image, factors, radius_px, FULL_SCALE, offset)
    near = sliding_window_view(np.pad(image, 1, "edge"), (3, 3)).mean((2, 3), dtype=np.float64)
    sharp = np.abs(image - near)
    for row, column in np.random.default_rng(seed).integers(0, (height, width), (20, 2)):
        around = image[max(row - radius_px, 0) : row + radius_px + 1, max(column - radius_px, 0) :]
        brightest = float(around[:, : min(column, radius_px) + radius_px + 1].max())
        reach_px = min(EDGE_RADIUS_PX, radius_px - 1)
        edges = sharp[max(row - reach_px, 0) : row + reach_px + 1, max(column - reach_px, 0) :]
        sharpest = float(edges[:, : min(column, reach_px) + reach_px + 1].max())
        fitting = [
            factor
            for factor in factors[1:]
            if (factor == 1 or (brightest - offset) * factor + offset <= HEADROOM * FULL_SCALE)
            and sharpest * factor <= (SHARPEST if factor == 1 else SHARPEST_IN_DARK) * FULL_SCALE
        ]
        assert selected[row, column] == max(fitting, default=0.5)


@settings(max_examples=60)
@given(st.data(), st.integers(0, 999), sides, sides, st.integers(1, 14))
def test_a_part_chooses_as_the_whole_image_does(
    data: st.DataObject, seed: int, height: int, width: int, radius_px: int
) -> None:
    image = image_of(seed, height, width)
    factors = (1, 2, 4)
    top = data.draw(st.integers(0, height - 1))
    left = data.draw(st.integers(0, width - 1))
    bottom = data.draw(st.integers(top + 1, height))
    right = data.draw(st.integers(left + 1, width))
    row = max(top - radius_px, 0)
    column = max(left - radius_px, 0)
    part = image[row : bottom + radius_px, column : right + radius_px]
    in_part = choose_factors(part, factors, radius_px, FULL_SCALE, 0.0)[
        top - row :, left - column :
    ]
    in_image = choose_factors(image, factors, radius_px, FULL_SCALE, 0.0)[top:bottom, left:right]
    assert_array_equal(in_part[: bottom - top, : right - left], in_image)


def test_the_offset_is_no_light() -> None:
    """A factor multiplies the signal above the offset, so an offset copy gets the same factors."""
    image = np.arange(0, 1200, dtype=np.float32)[None]
    plain = choose_factors(image, (1, 4, 8), 0, FULL_SCALE, 0.0)
    assert np.unique(plain).tolist() == [1, 4, 8]
    shifted = choose_factors(image + 100, (1, 4, 8), 0, FULL_SCALE + 100 / HEADROOM, 100.0)
    assert_array_equal(shifted, plain)
