"""Tests of smoothing: noise in the dark goes, and bright pixels, edges and the mean stay."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from beers_deploy.model.consistency.smooth import LIGHT, SMOOTH_PX, Smoothing
from beers_deploy.profiles.effects import Offset
from beers_deploy.profiles.instrument import pixel_noise
from tests.model.consistency.images import FULL_SCALE
from tests.model.simulator.stages import NOMINAL, plain_sensor

SENSORS = {"nominal": NOMINAL, "offset": plain_sensor(offset=Offset(64.0))}
DARK_DN = 20.0
LEFT = 0.15
"""The deviation of the noise that a network leaves, as a share of the raw image's."""


def sigma_dn(light_dn: float) -> float:
    """Return the deviation of the raw image's noise at a light."""
    dark, growth, *_ = pixel_noise(NOMINAL, FULL_SCALE)
    return float(np.sqrt(dark + growth * light_dn))


@pytest.mark.parametrize("name", SENSORS)
def test_noise_of_dark_ground_goes_and_its_mean_stays(name: str) -> None:
    sensor = SENSORS[name]
    generator = np.random.default_rng(0)
    noise = generator.normal(0, LEFT * sigma_dn(DARK_DN), (61, 83))
    ground = (sensor.offset_dn + DARK_DN + noise).astype(np.float32)
    smooth = Smoothing.of(sensor, FULL_SCALE).smoothed(ground)
    assert smooth.std() < 0.3 * ground.std()
    assert abs(smooth.mean() - ground.mean()) < 0.02 * ground.std()


def test_a_smooth_step_and_bright_ground_stay() -> None:
    """A step of ten deviations of the noise keeps 97 % of its height, and light hides all noise."""
    step = np.full((30, 40), DARK_DN, np.float32)
    step[:, 20:] += 10 * sigma_dn(DARK_DN)
    smoothing = Smoothing.of(NOMINAL, FULL_SCALE)
    smooth = smoothing.smoothed(step)
    assert np.abs(smooth - step).max() < 0.03 * 10 * sigma_dn(DARK_DN)
    bright_dn = 1.2 * LIGHT * sigma_dn(200.0)
    bright = np.random.default_rng(1).normal(bright_dn, 1, (31, 27)).astype(np.float32)
    assert_array_equal(smoothing.smoothed(bright), bright)


def test_pixels_beside_missing_ones_stay() -> None:
    pixels = np.random.default_rng(2).normal(DARK_DN, 1, (40, 50)).astype(np.float32)
    holed = pixels.copy()
    holed[17:20, 30] = np.nan
    smoothing = Smoothing.of(NOMINAL, FULL_SCALE)
    smooth = smoothing.smoothed(holed)
    reached = np.zeros(pixels.shape, bool)
    reached[17 - SMOOTH_PX : 20 + SMOOTH_PX, 30 - SMOOTH_PX : 31 + SMOOTH_PX] = True
    assert_array_equal(smooth[reached], holed[reached])
    assert_array_equal(smooth[~reached], smoothing.smoothed(pixels)[~reached])
