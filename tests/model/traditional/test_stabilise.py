"""Tests of variance stabilization: unit variance, an exact inverse, and limits of the formula."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from beers_deploy.model.traditional.noise import bias_radiance, destabilise, stabilise
from beers_deploy.profiles.instrument import Instrument, noise_from_snr

NOMINAL = Instrument(0.07, *noise_from_snr(25, 50, 100, 110), gain_dn_per_radiance=10.2375, bits=12)
LIMITS = [
    NOMINAL,
    replace(NOMINAL, beta=0.0),
    replace(NOMINAL, alpha=0.0),
    replace(NOMINAL, alpha=1e-7),
    replace(NOMINAL, alpha=1e-12),
]


def noisy(radiance: float, sensor: Instrument, seed: int) -> torch.Tensor:
    normal = np.random.default_rng(seed).standard_normal(200_003)
    return torch.from_numpy(radiance + sensor.noise_sigma(radiance) * normal)


@pytest.mark.parametrize("sensor", LIMITS)
@pytest.mark.parametrize("radiance", [5.0, 25.0, 100.0, 390.0])
def test_noise_has_variance_one_at_every_radiance(radiance: float, sensor: Instrument) -> None:
    """As alpha nears 0, the difference of two roots would vanish in float32."""
    stable = stabilise(noisy(radiance, sensor, 1).float(), sensor)
    assert float(stable.var()) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("sensor", LIMITS)
def test_round_trip_in_float32(sensor: Instrument) -> None:
    radiance = torch.linspace(0, 400, 4097)
    there_and_back = destabilise(stabilise(radiance, sensor), sensor)
    torch.testing.assert_close(there_and_back, radiance, rtol=1e-5, atol=1e-6)


def test_below_zero_it_rises_and_is_inverted() -> None:
    radiance = torch.linspace(-5, 5, 101)
    stable = stabilise(radiance, NOMINAL)
    assert bool((stable.diff() > 0).all())
    torch.testing.assert_close(destabilise(stable, NOMINAL), radiance, rtol=1e-5, atol=1e-6)


def test_no_noise_in_the_dark_is_finite() -> None:
    sensor = replace(NOMINAL, beta=0.0)
    stable = stabilise(torch.tensor([-1.0, 0.0, 1.0]), sensor)
    assert stable.tolist() == pytest.approx([0, 0, 2 / sensor.alpha**0.5])


def test_the_bias_of_averaging_is_restored() -> None:
    sensor = replace(NOMINAL, alpha=0.2)
    mean = destabilise(stabilise(noisy(25, sensor, 3), sensor).mean(), sensor)
    assert float(mean) - 25 == pytest.approx(-bias_radiance(sensor), rel=0.2)
