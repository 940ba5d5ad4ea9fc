"""The whole chain on a simulated pair: what it gains, and what it loses when told the wrong sensor."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from model.simulator.acquire import Pair, simulate_pair
from model.simulator.draws import Draw
from model.traditional.compensate import compensate
from model.traditional.pipeline import describe, restore_traditional, with_rounding_noise
from profiles import load_sensor
from profiles.errors import OptionError
from profiles.sensor import Sensor

DEGRADED = load_sensor("pleiades-degraded").nominal()
REFERENCE = load_sensor("pleiades-reference").nominal()
NOISE_FREE = replace(REFERENCE, alpha=0.0, beta=0.0)


@pytest.fixture(scope="module")
def pair(camera: Tensor) -> Pair:
    """A photograph of up to 200 W/m2/sr/um, 139 x 145 pixels within the margin, its reference without noise."""
    return simulate_pair(camera[64:267, 128:337] * (200 / 255), DEGRADED, NOISE_FREE, 1, Draw(seed=1))


def psnr_db(image: Tensor, truth: Tensor) -> float:
    """Over the full scale, away from the border, where the scene beyond it is unknown."""
    difference = (image - truth)[8:-8, 8:-8].double()
    return float(10 * torch.log10(DEGRADED.max_dn**2 / difference.square().mean()))


def test_the_chain_gains_many_decibels_over_the_degraded_image(pair: Pair) -> None:
    restored = restore_traditional(pair.degraded, DEGRADED, REFERENCE)
    assert restored.shape == pair.degraded.shape
    assert restored.dtype == torch.float32
    assert psnr_db(restored, pair.reference) > psnr_db(pair.degraded, pair.reference) + 12


def test_each_half_of_the_chain_is_needed(pair: Pair) -> None:
    whole = psnr_db(restore_traditional(pair.degraded, DEGRADED, REFERENCE), pair.reference)
    denoised = psnr_db(
        restore_traditional(pair.degraded, DEGRADED, replace(REFERENCE, mtf_nyquist=0.07)), pair.reference
    )
    sharpened = psnr_db(compensate(pair.degraded, 0.07, 0.25), pair.reference)
    assert denoised < whole - 3
    assert sharpened < whole - 3


@pytest.mark.parametrize(
    "told", [replace(DEGRADED, mtf_nyquist=0.04), replace(DEGRADED, mtf_nyquist=0.15), replace(DEGRADED, alpha=0.5)]
)
def test_the_wrong_sensor_costs_decibels(pair: Pair, told: Sensor) -> None:
    right = psnr_db(restore_traditional(pair.degraded, DEGRADED, REFERENCE), pair.reference)
    wrong = psnr_db(restore_traditional(pair.degraded, told, REFERENCE), pair.reference)
    assert wrong < right - 1


def test_the_brightness_is_kept(pair: Pair) -> None:
    restored = restore_traditional(pair.degraded, DEGRADED, REFERENCE)
    assert float(restored.mean() / pair.degraded.mean()) == pytest.approx(1, abs=2e-3)


def test_the_gain_of_each_sensor_is_its_own(pair: Pair) -> None:
    crop = pair.degraded[:37, :45]
    same = restore_traditional(crop, DEGRADED, REFERENCE, "fast")
    half = restore_traditional(crop, DEGRADED, replace(REFERENCE, gain_dn_per_radiance=10.2375 / 2), "fast")
    torch.testing.assert_close(half * 2, same)


@pytest.mark.parametrize("level", [0.0, 4095.0])
@pytest.mark.parametrize("sensor", [DEGRADED, NOISE_FREE, load_sensor("pleiades-variable").nominal()])
def test_a_black_and_a_saturated_image(level: float, sensor: Sensor) -> None:
    restored = restore_traditional(torch.full((13, 21), level), sensor, REFERENCE)
    torch.testing.assert_close(restored, torch.full((13, 21), level), rtol=0, atol=0.05)


def test_the_result_stays_within_the_converter() -> None:
    checkerboard = torch.from_numpy(np.indices((29, 31)).sum(0) % 2 * 4095).float()
    restored = restore_traditional(checkerboard, DEGRADED, REFERENCE, "fast")
    assert 0 <= float(restored.min()) <= float(restored.max()) <= 4095


def test_rounding_counts_as_noise() -> None:
    assert with_rounding_noise(NOISE_FREE).beta == pytest.approx((1 / 10.2375) ** 2 / 12)


def test_it_says_what_it_does() -> None:
    steps = describe(DEGRADED, REFERENCE, "fast")
    assert len(steps) == 5
    assert "0.07 to 0.25" in steps[3]


def test_an_unknown_quality_is_refused() -> None:
    with pytest.raises(OptionError, match="fast, standard, best"):
        restore_traditional(torch.ones(3, 3), DEGRADED, REFERENCE, "superb")
