import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.model.simulator.acquire import prepare_scene, simulate_planned
from beers_deploy.model.simulator.detector import (
    Draw,
    add_noise,
    digitise,
    noise_sigma,
    to_radiance,
    to_uint16,
)
from beers_deploy.model.simulator.mtf import gamma_from_mtf
from beers_deploy.model.simulator.plan import TOLERANCE_DN, Plan, make_plan
from beers_deploy.profiles.effects import (
    TABLES,
    AntiAlias,
    Defects,
    Dsnu,
    Effect,
    FullWell,
    Haze,
    Offset,
    PixelEffect,
    Prnu,
    Smear,
    Striping,
)
from beers_deploy.profiles.errors import OptionError
from tests.model.simulator import stages

NEUTRAL: dict[str, Effect] = {
    "antialias": AntiAlias(0.0),
    "smear": Smear(0.0),
    "veil": Haze(1.0, 0.0),
    "full_well": FullWell(1e6, 0.3, 4.0),
    "prnu": Prnu(0.0),
    "dsnu": Dsnu(0.0),
    "striping": Striping(0.0),
    "offset": Offset(0.0),
    "defects": Defects(0.0, 0.0),
}


def scene(height: int = 340, width: int = 390, seed: int = 0) -> np.ndarray:
    return 20 + 150 * np.random.default_rng(seed).random((height, width), np.float32)


@pytest.mark.parametrize("name", TABLES)
def test_skipping_equals_applying_at_neutral_parameters_bit_for_bit(name: str) -> None:
    """The operator itself must change no bit, also with a plan that skips nothing."""
    radiance = scene(171, 195)
    draw = Draw(3)
    neutral = stages.plain_sensor(**{name: NEUTRAL[name]})
    without_it = stages.plain_sensor()
    one, other = (
        stages.before_digitising(radiance, sensor, 3, draw) for sensor in (neutral, without_it)
    )
    assert np.array_equal(one, other)
    prepared = prepare_scene(radiance, 3)
    everything = Plan((), TOLERANCE_DN)
    expected = simulate_planned(prepared, without_it, draw, everything, margin_px=5)
    for plan in (make_plan(neutral, prepared.stats), everything):
        assert np.array_equal(
            simulate_planned(prepared, neutral, draw, plan, margin_px=5), expected
        )


@pytest.mark.parametrize("effect", [Prnu(0.02), Dsnu(4.0)])
def test_the_pattern_of_a_column_is_the_same_in_every_row(effect: Prnu | Dsnu) -> None:
    image = stages.alone(effect, np.full((31, 47), 50.0, np.float32))
    assert (image == image[:1]).all()
    assert float(image[0].std()) > 0.3


def test_prnu_has_its_spread_and_its_limit() -> None:
    gain = stages.alone(Prnu(0.01), np.full((1, 40_000), 100.0, np.float32)) / 100 - 1
    assert float(gain.std()) == pytest.approx(0.01, rel=0.02)
    assert np.abs(gain).max() <= 0.04 + 1e-6


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        (Striping(6.0), [103.0, 97.0, 3.0, -3.0]),
        (Haze(0.6, 25.0), [85.0, 85.0, 25.0, 25.0]),
        (Offset(64.0), [164.0, 164.0, 64.0, 64.0]),
    ],
)
def test_affine_effects_have_their_values(effect: PixelEffect, expected: list[float]) -> None:
    image = np.array([[100.0, 100.0, 0.0, 0.0]], np.float32)
    assert stages.alone(effect, image)[0].tolist() == expected


def test_spilled_charge_stays_in_its_column() -> None:
    image = np.full((61, 21), 20.0, np.float32)
    image[30, 10] = 520.0
    flooded = stages.alone(FullWell(120.0, 0.4, 3.0), image)
    gained = (flooded - image.clip(max=120.0)).sum(0)
    assert float(gained[10]) == pytest.approx(0.4 * 400.0, rel=1e-5)
    assert np.count_nonzero(gained) == 1
    assert flooded[29, 10] > flooded[25, 10] > 20.0


def test_defects_come_at_their_rate_and_at_the_ends_of_the_range() -> None:
    dn = stages.alone(Defects(2000, 3000), np.full((1000, 1001), 700.0, np.float32), seed=2)
    dead = int((dn == 0).sum())
    hot = int((dn == 4095).sum())
    for count, expected in ((dead, 2002), (hot, 3003)):
        assert abs(count - expected) < 5 * math.sqrt(expected)
    assert int((dn == 700).sum()) == dn.size - dead - hot


def test_an_infeasible_budget_is_refused_with_its_numbers() -> None:
    with pytest.raises(
        OptionError, match=r"up to 0\.1854 \(with an anti-alias filter of gain 0\.291\)"
    ):
        gamma_from_mtf(0.25, 0.5)


@pytest.mark.parametrize("name", ["dsnu", "striping", "offset"])
def test_the_noise_is_the_same_whether_a_pattern_is_applied_or_not(name: str) -> None:
    """Only the pattern added in DN differs, and it is the same in every row."""
    radiance = scene(93, 111)
    sensor = stages.plain_sensor(dsnu=Dsnu(3.0), striping=Striping(2.0), offset=Offset(64.0))
    full = stages.before_digitising(radiance, sensor, 3, Draw(5))
    added = full - stages.before_digitising(radiance, sensor, 3, Draw(5), {name})
    assert_allclose(added, np.broadcast_to(added[:1], added.shape), atol=1e-3)
    assert np.abs(added).min() > 0


@given(
    st.floats(1, 150), st.floats(0, 0.5), st.floats(0, 9), st.integers(2, 37), st.integers(0, 99)
)
def test_a_full_well_spills_no_more_than_its_share_of_what_it_cuts_off(
    well: float, share: float, length_px: float, rows: int, seed: int
) -> None:
    image = scene(rows, 9, seed)
    flooded = stages.alone(FullWell(well, share, length_px), image).astype(float)
    clipped = image.clip(max=well)
    cut = (image.astype(float) - clipped).sum(0)
    gained = (flooded - clipped).sum(0)
    assert (flooded >= clipped).all()
    assert float(flooded.max()) <= well * (1 + 1e-6)
    assert (gained <= share * cut + 1e-3).all()
    assert np.array_equal(stages.alone(FullWell(171.0, share, length_px), image), image)
    assert np.array_equal(stages.alone(FullWell(well, 0.0, length_px), image), image.clip(max=well))


SENSOR = stages.plain_sensor()
GAIN = SENSOR.gain_dn_per_radiance


@pytest.mark.parametrize("radiance", [2.0, 25.0, 60.0, 100.0, 300.0])
def test_the_variance_is_alpha_l_plus_beta_and_digitising_adds_a_twelfth(radiance: float) -> None:
    image = np.full((700, 701), radiance, np.float32)
    noisy = add_noise(image, SENSOR, Draw(1).generator("noise"))
    expected = SENSOR.alpha * radiance + SENSOR.beta
    assert noisy.var(dtype=np.float64) == pytest.approx(expected, rel=0.01)
    assert noisy.mean(dtype=np.float64) == pytest.approx(
        radiance, abs=4 * (expected / image.size) ** 0.5
    )
    dn = digitise(noisy * GAIN, SENSOR)
    assert dn.var(dtype=np.float64) == pytest.approx(expected * GAIN**2 + 1 / 12, rel=0.01)


def test_snr_is_a_linear_ratio_not_decibels() -> None:
    assert SENSOR.noise_sigma(25) == pytest.approx(0.5)
    assert SENSOR.noise_sigma(100) == pytest.approx(0.909, abs=1e-3)


def test_ringing_below_zero_is_harmless() -> None:
    noise = noise_sigma(np.array([-50.0, 0.0], np.float32), SENSOR)
    assert noise.tolist() == pytest.approx([SENSOR.beta**0.5] * 2)


def test_clipping_comes_before_the_cast() -> None:
    dn = digitise(np.array([[-5.0, 0.04, 399.99, 1e6]], np.float32) * GAIN, SENSOR)
    assert dn.tolist() == [[0.0, 0.0, 4095.0, 4095.0]]
    assert to_uint16(np.array([-1.0, 70000.0], np.float32)).tolist() == [0, 65535]


def test_integers_survive_a_round_trip() -> None:
    dn = np.arange(4096, dtype=np.float32)
    assert_array_equal(digitise(to_radiance(dn, SENSOR) * GAIN, SENSOR), dn, strict=True)


def test_each_effect_has_its_own_draws() -> None:
    def numbers(draw: Draw, effect: str) -> np.ndarray:
        return draw.generator(effect).standard_normal(1000)

    assert_array_equal(numbers(Draw(3, 7), "a"), numbers(Draw(3, 7), "a"))
    for other in (numbers(Draw(3, 7), "b"), numbers(Draw(3, 8), "a"), numbers(Draw(4, 7), "a")):
        assert abs(np.corrcoef(numbers(Draw(3, 7), "a"), other)[0, 1]) < 0.15
