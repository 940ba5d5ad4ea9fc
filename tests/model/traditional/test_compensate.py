"""Tests of MTF compensation: gain 1 at DC, the target MTF without regularization, no infinity."""

import numpy as np
import pytest
import torch

from beers_deploy.model.simulator.mtf import mtf, sensor_mtf
from beers_deploy.model.traditional import compensate as module
from beers_deploy.model.traditional.compensate import (
    compensation_gain,
    compensation_kernel,
    filter_strips,
)
from beers_deploy.profiles.effects import AntiAlias, Smear
from beers_deploy.profiles.instrument import Instrument
from tests.model.simulator import stages
from tests.model.simulator.stages import NOMINAL, plain_sensor, with_contrast, with_response
from tests.model.traditional.whole import compensate

EPSILON = 3e-3
REFERENCE = with_contrast(0.25)


def texture(height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(
        np.random.default_rng(0).uniform(0, 4095, (height, width)).astype(np.float32)
    )


@pytest.mark.parametrize("mtf_from", [1.001e-4, 1e-3, 0.03, 0.07, 0.25, 0.63])
@pytest.mark.parametrize("mtf_to", [1.001e-4, 0.25, 0.63])
@pytest.mark.parametrize("epsilon", [0.0, 3e-3])
def test_gain_is_one_at_dc_and_finite_everywhere(
    mtf_from: float, mtf_to: float, epsilon: float
) -> None:
    gain = compensation_gain(26, 35, with_contrast(mtf_from), with_contrast(mtf_to), epsilon)
    assert float(gain[0, 0]) == 1
    assert np.isfinite(gain).all()
    assert (gain >= 0).all()


@pytest.mark.parametrize(
    "degraded",
    [
        NOMINAL,
        plain_sensor(smear=Smear(1.5)),
        plain_sensor(antialias=AntiAlias(0.4)),
        with_response(NOMINAL, stages.lopsided_point()),
    ],
    ids=["formula", "smear", "anti-alias filter", "point spread"],
)
def test_without_regularisation_a_blur_is_undone_completely(degraded: Instrument) -> None:
    """Gain times blur is the target MTF, so the phase of a point-spread function is undone too."""
    fx = np.fft.rfftfreq(34)[None]
    fy = np.fft.fftfreq(26)[:, None]
    gain = compensation_gain(26, 34, degraded, REFERENCE, epsilon=0)
    undone = gain * sensor_mtf(fx, fy, degraded)
    np.testing.assert_allclose(undone, mtf(fx, fy, 0.25), rtol=1e-9, atol=1e-12)


def test_regularisation_holds_the_noise_of_a_weak_mtf_down() -> None:
    assert float(compensation_gain(26, 34, with_contrast(0.03), REFERENCE, epsilon=0).max()) > 15
    assert float(compensation_gain(26, 34, with_contrast(0.03), REFERENCE, EPSILON).max()) < 5


@pytest.mark.parametrize("mtf_from", [0.07, 1.001e-4])
@pytest.mark.parametrize("shape", [(128, 128), (61, 75), (400, 31), (1, 3)])
def test_the_mean_is_preserved(shape: tuple[int, int], mtf_from: float) -> None:
    """With a symmetric filter on a mirrored image, the crop has the mean of a whole period."""
    image = texture(*shape)
    restored = compensate(image, mtf_from, 0.25, EPSILON)
    assert restored.shape == shape
    assert float(restored.double().mean() / image.double().mean()) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("mtf_from", [0.03, 0.07])
def test_the_kernel_has_the_gain_of_the_formula_and_exactly_1_at_dc(mtf_from: float) -> None:
    """The usual form, T H / (H^2 + epsilon), loses light at DC, which limits the PSNR."""
    kernel = compensation_kernel(with_contrast(mtf_from), REFERENCE, EPSILON)
    assert float(kernel.sum()) == pytest.approx(1, abs=1e-12)
    padded = torch.zeros(512, 512, dtype=torch.float64)
    padded[:129, :129] = kernel
    gain = torch.fft.rfft2(padded.roll((-64, -64), (0, 1)))
    expected = torch.from_numpy(
        compensation_gain(512, 512, with_contrast(mtf_from), REFERENCE, EPSILON)
    )
    assert float(gain.imag.abs().max()) < 1e-9
    error = (gain.real / expected - 1).abs()
    assert float(error[8:240, 8:240].max()) < 2e-3
    # The largest error is at the kink of the gain, where it is continued beyond Nyquist.
    assert float(error.max()) < 0.04


def test_strips_and_blocks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    image = texture(203, 187)
    kernel = compensation_kernel(with_contrast(0.07), REFERENCE, EPSILON)
    at_once = compensate(image, 0.07, 0.25, EPSILON)
    strips = torch.cat(list(filter_strips(torch.split(image, 7), 203, kernel)))
    assert torch.equal(strips, at_once)
    monkeypatch.setattr(module, "BLOCK_PX", 60)
    torch.testing.assert_close(compensate(image, 0.07, 0.25, EPSILON), at_once, rtol=0, atol=0.01)


def test_missing_pixels_reach_no_further_than_the_filter() -> None:
    image = texture(203, 187)
    holed = image.clone()
    holed[:40, :30] = torch.nan
    without_hole, restored = (
        compensate(variant, 0.07, 0.25, EPSILON) for variant in (image, holed)
    )
    assert torch.equal(restored.isnan(), holed.isnan())
    torch.testing.assert_close(restored[104:], without_hole[104:], rtol=0, atol=0.01)
    torch.testing.assert_close(restored[:, 94:], without_hole[:, 94:], rtol=0, atol=0.01)
    nearby = (restored - without_hole)[40:44, :30].abs().mean()
    zeros = compensate(holed.nan_to_num(0), 0.07, 0.25, EPSILON)
    assert float(nearby) < 0.7 * float((zeros - without_hole)[40:44, :30].abs().mean())


def test_it_converts_one_blur_into_the_other() -> None:
    yy, xx = np.mgrid[:261, :275]
    scene = np.asarray(2000 + 1000 * np.sin(0.9 * xx + 0.4 * yy) * np.cos(0.07 * xx), np.float32)
    before_and_after = (stages.blurred(scene, 1, m) for m in (0.07, 0.25))
    blurred, target = map(torch.from_numpy, before_and_after)
    inside = slice(80, -80), slice(80, -80)
    before = (blurred - target)[inside].square().mean()
    after = (compensate(blurred, 0.07, 0.25, epsilon=0) - target)[inside].square().mean()
    wrong = (compensate(blurred, 0.07, 0.20, epsilon=0) - target)[inside].square().mean()
    assert float(after) < 1e-3 * float(before)
    assert float(wrong) > 10 * float(after)
