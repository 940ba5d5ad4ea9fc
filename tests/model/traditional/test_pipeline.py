"""Tests of the whole pipeline on a simulated pair: its gain, and its loss with a wrong sensor."""

from dataclasses import replace
from typing import NamedTuple, get_args

import numpy as np
import pytest
import torch
from torch import Tensor

from beers_deploy.model.simulator.acquire import simulate_pair
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.traditional.baselines import BASELINES
from beers_deploy.model.traditional.pipeline import (
    Order,
    TraditionalPipeline,
    restore_strips,
    restore_traditional,
)
from beers_deploy.profiles.instrument import Instrument, noise_from_snr
from beers_deploy.profiles.response import PointSpread
from beers_deploy.profiles.sensor import Sensor
from tests.model.simulator.stages import (
    NOMINAL,
    REFERENCE,
    formula_point,
    point_spread,
    with_response,
)

ORDERS: tuple[Order, ...] = get_args(Order)
NOISE_FREE = replace(REFERENCE, alpha=0.0, beta=0.0)


class AcquiredPair(NamedTuple):
    """Two acquisitions (H, W) in digital numbers, as the pipeline accepts them."""

    degraded: Tensor
    reference: Tensor


def acquired_pair(
    camera: Tensor, sensor: Instrument, reference: Instrument = NOISE_FREE
) -> AcquiredPair:
    """Simulate a photograph of up to 200 W/m2/sr/um: 139 x 145 pixels within the margin.

    By default the reference has no noise.
    """
    pair = simulate_pair(
        camera[64:267, 128:337].numpy() * (200 / 255), sensor, reference, 1, Draw(seed=1)
    )
    return AcquiredPair(torch.from_numpy(pair.degraded), torch.from_numpy(pair.reference))


@pytest.fixture(scope="module")
def pair(camera: Tensor) -> AcquiredPair:
    return acquired_pair(camera, NOMINAL)


def psnr_db(image: Tensor, truth: Tensor) -> float:
    """Return the PSNR over full scale, without the border, where the scene outside is unknown."""
    difference = (image - truth)[8:-8, 8:-8].double()
    return float(10 * torch.log10(NOMINAL.max_dn**2 / difference.square().mean()))


def restored_db(pair: AcquiredPair, pipeline: TraditionalPipeline) -> float:
    return psnr_db(restore_traditional(pair.degraded, pipeline), pair.reference)


ALPHA, BETA = noise_from_snr(25, 15, 100, 50)
NOISY = replace(NOMINAL, mtf_nyquist=0.03, alpha=ALPHA, beta=BETA)


@pytest.mark.parametrize(("sensor", "gain_db"), [(NOMINAL, 12.9), (NOISY, 9.6)])
def test_both_orders_of_the_pipeline_gain_the_measured_decibels(
    sensor: Instrument, gain_db: float, camera: Tensor
) -> None:
    """Denoising first gains 13.09 and 9.78 dB, deconvolving first 13.35 and 10.10 dB (measured).

    Deconvolving first is never more than 0.1 dB worse.
    """
    pair = acquired_pair(camera, sensor)
    before = psnr_db(pair.degraded, pair.reference)
    gains = dict[Order, float]()
    for order in ORDERS:
        restored = restore_traditional(
            pair.degraded, TraditionalPipeline(sensor, REFERENCE, order=order)
        )
        assert restored.shape == pair.degraded.shape
        assert restored.dtype == torch.float32
        gains[order] = psnr_db(restored, pair.reference) - before
        assert gains[order] > gain_db
        assert float(restored.mean() / pair.degraded.mean()) == pytest.approx(1, abs=5e-3)
    assert gains["deconvolve-first"] >= gains["denoise-first"] - 0.1


@pytest.mark.parametrize("order", ORDERS)
def test_strips_change_no_bit(order: Order, pair: AcquiredPair) -> None:
    pipeline = TraditionalPipeline(NOMINAL, REFERENCE, "fast", order)
    dn = pair.degraded[:, :53].clone()
    dn[:9, 20:40] = torch.nan
    fitted = pipeline.fitted_to(torch.split(dn, 31))
    strips = torch.cat(list(restore_strips(torch.split(dn, 23), dn.shape[0], fitted)))
    at_once = restore_traditional(dn, pipeline)
    assert torch.equal(strips.nan_to_num(-1), at_once.nan_to_num(-1))
    assert torch.equal(at_once.isnan(), dn.isnan())


def test_the_gain_of_each_sensor_is_its_own(pair: AcquiredPair) -> None:
    crop = pair.degraded[:37, :45]
    same = restore_traditional(crop, TraditionalPipeline(NOMINAL, REFERENCE, "fast"))
    half = restore_traditional(
        crop,
        TraditionalPipeline(NOMINAL, replace(REFERENCE, gain_dn_per_radiance=10.2375 / 2), "fast"),
    )
    torch.testing.assert_close(half * 2, same)


@pytest.mark.parametrize("level", [0.0, 4095.0])
@pytest.mark.parametrize(
    "sensor", [NOMINAL, NOISE_FREE, Sensor.load("pleiades-variable").nominal()]
)
def test_a_black_and_a_saturated_image(level: float, sensor: Instrument) -> None:
    restored = restore_traditional(
        torch.full((13, 21), level), TraditionalPipeline(sensor, REFERENCE)
    )
    torch.testing.assert_close(restored, torch.full((13, 21), level), rtol=0, atol=0.05)


def leaning_disc() -> PointSpread:
    """Return a disc of defocus that is brighter on one side."""
    y, x = np.mgrid[-16:17, -16:17] / 8
    disc = np.hypot(y, x) < 0.85
    return point_spread(disc + 2.0 * (disc & (x + y > 0.4)), 8.0)


def test_a_point_spread_of_the_formula_is_restored_as_well_as_the_formula(camera: Tensor) -> None:
    formula = replace(NOMINAL, mtf_nyquist=0.12, mtf_nyquist_along=0.05)
    point = with_response(NOMINAL, formula_point(formula.mtf_axes, 2, 129, odd=True))
    levels_db = [
        restored_db(acquired_pair(camera, sensor), TraditionalPipeline(sensor, REFERENCE))
        for sensor in (formula, point)
    ]
    assert levels_db[1] == pytest.approx(levels_db[0], abs=0.05)


AXES = replace(NOMINAL, mtf_nyquist=0.12, mtf_nyquist_along=0.04)
TURNED = replace(AXES, mtf_nyquist=0.04, mtf_nyquist_along=0.12)
DISC = with_response(NOMINAL, leaning_disc())
WRONG = [(NOMINAL, replace(NOMINAL, alpha=0.5), "denoise-first")]
WRONG += [(AXES, TURNED, "denoise-first")]
WRONG += [(DISC, replace(DISC, response=None), order) for order in ORDERS]
"""A sensor, the wrong one given to the pipeline, and the order of the steps.

The formula with the contrasts of a leaning disc is another blur than the disc.
"""


@pytest.mark.parametrize(("sensor", "profile", "order"), WRONG)
def test_the_wrong_sensor_costs_decibels(
    sensor: Instrument, profile: Instrument, order: Order, camera: Tensor
) -> None:
    pair = acquired_pair(camera, sensor)
    right, wrong = (
        restored_db(pair, TraditionalPipeline(stated, REFERENCE, order=order))
        for stated in (sensor, profile)
    )
    assert right > wrong + 1


@pytest.mark.parametrize("name", ["wiener", "nl-means"])
def test_baselines_undo_the_whole_response(name: str, camera: Tensor) -> None:
    sensor = with_response(NOMINAL, leaning_disc())
    pair = acquired_pair(camera, sensor)
    right, wrong = (
        psnr_db(
            BASELINES[name](pair.degraded, TraditionalPipeline(profile, REFERENCE)), pair.reference
        )
        for profile in (sensor, replace(sensor, response=None))
    )
    assert right > wrong + 1


@pytest.mark.parametrize("bits", [8, 10, 14])
def test_any_bits_are_restored(bits: int, camera: Tensor) -> None:
    """Rounding to 8 bits counts as noise, and costs a decibel; 14 bits are as good as 12."""
    gain = (2**bits - 1) / 400
    degraded, reference = (
        replace(s, bits=bits, gain_dn_per_radiance=gain) for s in (NOMINAL, NOISE_FREE)
    )
    pair = acquired_pair(camera, degraded, reference)
    restored = restore_traditional(pair.degraded, TraditionalPipeline(degraded, reference))
    before, after = (
        psnr_db(dn * (4095 / (2**bits - 1)), pair.reference * (4095 / (2**bits - 1)))
        for dn in (pair.degraded, restored)
    )
    assert after > before + 11


def test_the_result_stays_within_the_converter() -> None:
    checkerboard = torch.from_numpy(np.indices((29, 31)).sum(0) % 2 * 4095).float()
    restored = restore_traditional(checkerboard, TraditionalPipeline(NOMINAL, REFERENCE, "fast"))
    assert 0 <= float(restored.min()) <= float(restored.max()) <= 4095
