"""Tests that a pass simulated in torch equals the simulator, and applies the drawn look."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.model.curves import draw_table
from beers_deploy.model.simulator.acquire import NOISE, acquire, prepare_scene
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.training.looks import Look, Looks
from beers_deploy.model.training.passes import (
    Pass,
    detected,
    folded_signals,
    noiseless,
    prepare,
    with_look,
)
from beers_deploy.profiles.effects import AntiAlias, Offset, Smear
from beers_deploy.profiles.instrument import Instrument
from tests.model.simulator.stages import NOMINAL, lopsided_point, with_response

PLAIN = Look(1.0)


def with_table(seed: int) -> Instrument:
    return with_response(NOMINAL, draw_table(0.1, 0.06, np.random.default_rng(seed)))


SENSORS = {
    "formula": NOMINAL,
    "two axes": replace(NOMINAL, mtf_nyquist_along=0.03),
    "smear": replace(NOMINAL, effects={"smear": Smear(0.8)}),
    "anti-alias": replace(NOMINAL, effects={"antialias": AntiAlias(0.3)}),
    "table": with_table(0),
    "another table": with_table(1),
    "point-spread function": with_response(NOMINAL, lopsided_point()),
}


@pytest.mark.parametrize("ratio", [2, 3, 5])
@pytest.mark.parametrize("name", SENSORS)
def test_a_pass_equals_the_simulator(name: str, ratio: int) -> None:
    scene = procedural_scene(307, 331, np.random.default_rng(4))
    sensor = SENSORS[name]
    phase = (0.3, -0.8)
    prepared = prepare_scene(scene.radiance, ratio)
    height, width = prepared.radiance.shape
    shift = np.fft.fftfreq(height)[:, None] * phase[0] + np.fft.rfftfreq(width) * phase[1]
    prepared.spectrum[:] *= np.exp(2j * np.pi * shift)
    expected = acquire(prepared, sensor, Draw(0), margin_px=8, skip=NOISE)
    (signal,) = folded_signals(prepare(scene, ratio), (sensor,), Pass(ratio, phase, PLAIN, 8))
    actual = noiseless(signal, sensor) * sensor.max_dn
    np.testing.assert_allclose(actual.numpy(), expected, atol=0.5)


@settings(max_examples=20)
@given(st.floats(0.02, 3), st.floats(0.05, 1), st.floats(0, 1.5))
def test_a_look_multiplies_the_mean_and_the_contrast_by_its_factors(
    light: float, contrast: float, softness_px: float
) -> None:
    radiance = torch.rand(36, 44, generator=torch.Generator().manual_seed(0))
    fy = torch.fft.fftfreq(36)
    fx = torch.fft.rfftfreq(44)
    transformed = with_look(torch.fft.rfft2(radiance), Look(light, contrast, softness_px), fy, fx)
    changed = torch.fft.irfft2(transformed, s=radiance.shape)
    assert float(changed.mean()) == pytest.approx(light * float(radiance.mean()), rel=1e-4)
    contrast_ratio = float(changed.std()) / (light * contrast * float(radiance.std()))
    assert contrast_ratio <= 1.0001
    if softness_px == 0:
        assert contrast_ratio == pytest.approx(1, rel=1e-4)
        torch.testing.assert_close(
            changed - changed.mean(),
            light * contrast * (radiance - radiance.mean()),
            rtol=0,
            atol=1e-5,
        )


def test_softness_is_a_gaussian_of_that_width() -> None:
    point = torch.zeros(64, 64)
    point[32, 32] = 1
    frequency = torch.fft.fftfreq(64), torch.fft.rfftfreq(64)
    soft = torch.fft.irfft2(with_look(torch.fft.rfft2(point), Look(1, 1, 1.3), *frequency))
    places = torch.arange(64) - 32.0
    spread = float((soft.sum(0) * places**2).sum()) ** 0.5
    assert spread == pytest.approx(1.3, rel=1e-3)


def test_looks_reach_deep_shade_and_saturation_and_most_are_ordinary() -> None:
    generator = np.random.default_rng(0)
    varied = Looks(lit_share=0.4, calm_share=0.3, soft_share=0.3)
    looks = [varied.draw(generator) for _ in range(2000)]
    lights = np.array([look.light for look in looks])
    assert lights.min() < 0.05
    assert lights.max() > 2
    ordinary = (lights >= 0.5) & (lights <= 1.25)
    assert ordinary.mean() > 0.6
    assert np.mean([look.contrast < 1 for look in looks]) == pytest.approx(
        varied.calm_share, abs=0.05
    )
    assert np.mean([look.softness_px > 0 for look in looks]) == pytest.approx(
        varied.soft_share, abs=0.05
    )


@pytest.mark.parametrize("level", [0.0, 5.0, 100.0, 390.0])
def test_noise_has_the_sensors_standard_deviation_at_every_level(level: float) -> None:
    signal = torch.full((300, 300), level)
    noisy = detected(signal, NOMINAL, "degraded", np.random.default_rng(1)) * NOMINAL.max_dn
    clipped = level == 0
    expected = float(np.hypot(NOMINAL.noise_sigma(level) * NOMINAL.gain_dn_per_radiance, 12**-0.5))
    if not clipped:
        assert float(noisy.std()) == pytest.approx(expected, rel=0.03)
        assert float(noisy.mean()) == pytest.approx(
            level * NOMINAL.gain_dn_per_radiance, abs=5 * expected / 300
        )
    assert float(noisy.min()) >= 0
    assert torch.equal(noisy, noisy.round())


def test_effects_of_a_profile_are_those_of_the_simulator() -> None:
    """An offset, which the code in torch does not simulate itself, is added."""
    sensor = replace(NOMINAL, effects={"offset": Offset(64.0)})
    signal = torch.full((40, 50), 80.0)
    plain, shifted = (
        detected(signal, instrument, "degraded", np.random.default_rng(1))
        for instrument in (NOMINAL, sensor)
    )
    assert float((shifted - plain).mean() * NOMINAL.max_dn) == pytest.approx(64, abs=1)
    assert float(
        noiseless(signal, sensor)[0, 0] - noiseless(signal, NOMINAL)[0, 0]
    ) == pytest.approx(64 / 4095)
