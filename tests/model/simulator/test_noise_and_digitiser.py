import numpy as np
import pytest

from beers_deploy.model.simulator.detector import Draw, add_noise, digitise, noise_sigma, to_radiance, to_uint16
from beers_deploy.profiles import load_sensor
from beers_deploy.profiles.sensor import Instrument

SENSOR = load_sensor("pleiades-degraded").nominal()
GAIN = SENSOR.gain_dn_per_radiance


@pytest.mark.parametrize("radiance", [2.0, 25.0, 60.0, 100.0, 300.0])
def test_the_variance_is_alpha_l_plus_beta(radiance: float) -> None:
    image = np.full((700, 701), radiance, np.float32)
    noisy = add_noise(image, SENSOR, Draw(1).generator("noise"))
    expected = SENSOR.alpha * radiance + SENSOR.beta
    assert noisy.var(dtype=np.float64) == pytest.approx(expected, rel=0.01)
    assert noisy.mean(dtype=np.float64) == pytest.approx(radiance, abs=4 * (expected / image.size) ** 0.5)


@pytest.mark.parametrize("radiance", [2.0, 25.0, 60.0, 100.0, 300.0])
def test_digitising_adds_a_twelfth_of_a_unit_squared(radiance: float) -> None:
    image = np.full((700, 701), radiance, np.float32)
    dn = digitise(add_noise(image, SENSOR, Draw(2).generator("noise")) * GAIN, SENSOR)
    expected = (SENSOR.alpha * radiance + SENSOR.beta) * SENSOR.gain_dn_per_radiance**2 + 1 / 12
    assert dn.var(dtype=np.float64) == pytest.approx(expected, rel=0.01)


def test_snr_is_a_linear_ratio_not_decibels() -> None:
    assert SENSOR.noise_sigma(25) == pytest.approx(0.5)
    assert SENSOR.noise_sigma(100) == pytest.approx(0.909, abs=1e-3)


def test_ringing_below_zero_is_harmless() -> None:
    assert np.isfinite(noise_sigma(np.array([-50.0, 0.0], np.float32), SENSOR)).all()
    assert float(noise_sigma(np.array(-50, np.float32), SENSOR)) == pytest.approx(SENSOR.beta**0.5)


def test_an_impossible_hand_made_sensor_gives_no_nan() -> None:
    sensor = Instrument(0.07, alpha=-0.01, beta=0.5, gain_dn_per_radiance=10.0, bits=12)
    assert float(noise_sigma(np.array(300, np.float32), sensor)) == 0


def test_clipping_comes_before_the_cast() -> None:
    dn = digitise(np.array([[-5.0, 0.04, 399.99, 1e6]], np.float32) * GAIN, SENSOR)
    assert dn.tolist() == [[0.0, 0.0, 4095.0, 4095.0]]
    assert to_uint16(np.array([-1.0, 70000.0], np.float32)).tolist() == [0, 65535]


def test_whole_numbers_survive_a_round_trip() -> None:
    dn = np.arange(4096, dtype=np.float32)
    np.testing.assert_array_equal(digitise(to_radiance(dn, SENSOR) * GAIN, SENSOR), dn, strict=True)


def test_each_effect_has_its_own_draws() -> None:
    def numbers(draw: Draw, effect: str) -> np.ndarray:
        return draw.generator(effect).standard_normal(1000)

    np.testing.assert_array_equal(numbers(Draw(3, 7), "a"), numbers(Draw(3, 7), "a"))
    for other in (numbers(Draw(3, 7), "b"), numbers(Draw(3, 8), "a"), numbers(Draw(4, 7), "a")):
        assert abs(np.corrcoef(numbers(Draw(3, 7), "a"), other)[0, 1]) < 0.15
