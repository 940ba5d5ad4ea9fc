import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.model.simulator.acquire import prepare_scene, simulate_planned
from beers_deploy.model.simulator.detector import Draw, add_defects, saturate
from beers_deploy.model.simulator.mtf import gamma_from_mtf, mtf, transfer_function
from beers_deploy.model.simulator.plan import TOLERANCE_DN, Plan, make_plan
from beers_deploy.model.simulator.sampling import sample, scene_spectrum
from beers_deploy.profiles.effects import (
    AntiAlias,
    Defects,
    Dsnu,
    Effect,
    FullWell,
    Haze,
    Offset,
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


@pytest.mark.parametrize("name", NEUTRAL)
def test_skipping_equals_applying_at_neutral_parameters_bit_for_bit(name: str) -> None:
    """Whether the plan leaves the effect out or skips nothing: the operator itself must change no bit."""
    radiance, draw = scene(171, 195), Draw(3)
    neutral, without_it = stages.plain_sensor(**{name: NEUTRAL[name]}), stages.plain_sensor()
    one, other = (stages.before_digitising(radiance, sensor, 3, draw) for sensor in (neutral, without_it))
    assert np.array_equal(one, other)
    prepared, everything = prepare_scene(radiance, 3), Plan((), TOLERANCE_DN)
    expected = simulate_planned(prepared, without_it, draw, everything, margin_px=5)
    for plan in (make_plan(neutral, prepared.stats), everything):
        assert np.array_equal(simulate_planned(prepared, neutral, draw, plan, margin_px=5), expected)


@pytest.mark.parametrize("name", ["prnu", "dsnu", "defects", "veil"])
def test_leaving_one_effect_out_changes_no_other_draw(name: str) -> None:
    radiance, draw = np.full((120, 140), 80.0, np.float32), Draw(5)
    sensor = stages.plain_sensor(dsnu=Dsnu(3.0), prnu=Prnu(0.01), defects=Defects(500, 500), veil=Haze(0.8, 10.0))
    whole = stages.before_digitising(radiance, sensor, 2, draw, skip={name, "noise"})
    other = stages.plain_sensor(**{k: v for k, v in sensor.effects.items() if k != name})
    assert np.array_equal(whole, stages.before_digitising(radiance, other, 2, draw, skip={"noise"}))


def test_the_pattern_of_a_column_is_the_same_in_every_row() -> None:
    for effect in (Prnu(0.02), Dsnu(4.0)):
        image = stages.alone(effect, np.full((31, 47), 50.0, np.float32))
        assert (image == image[:1]).all()
        assert float(image[0].std()) > 0.3


def test_prnu_has_its_spread_and_its_limit() -> None:
    gain = stages.alone(Prnu(0.01), np.full((1, 40_000), 100.0, np.float32)) / 100 - 1
    assert float(gain.std()) == pytest.approx(0.01, rel=0.02)
    assert np.abs(gain).max() <= 0.04 + 1e-6


def test_stripes_alternate_and_keep_the_mean() -> None:
    striped = stages.alone(Striping(6.0), np.full((5, 8), 100.0, np.float32))
    assert striped[0].tolist() == [103.0, 97.0] * 4


def test_haze_is_affine() -> None:
    assert stages.alone(Haze(0.6, 25.0), np.array([0.0, 100.0], np.float32)).tolist() == [25.0, 85.0]


def test_below_the_well_nothing_changes_and_share_zero_is_a_clip() -> None:
    image = scene(40, 33)
    assert np.array_equal(saturate(image, FullWell(171.0, 0.4, 5.0)), image)
    assert np.array_equal(saturate(image, FullWell(90.0, 0.0, 5.0)), image.clip(max=90.0))


def test_what_spills_stays_in_its_column_and_never_exceeds_the_excess() -> None:
    image = np.full((61, 21), 20.0, np.float32)
    image[30, 10] = 520.0
    flooded = saturate(image, FullWell(120.0, 0.4, 3.0))
    clipped = image.clip(max=120.0)
    gained = (flooded - clipped).sum(0)
    assert float(flooded.max()) <= 120.0
    assert float(gained[10]) == pytest.approx(0.4 * 400.0, rel=1e-5)
    assert float(gained.sum() - gained[10]) == 0.0
    assert flooded[29, 10] > flooded[25, 10] > 20.0


def test_defects_come_at_their_rate_and_at_the_ends_of_the_range() -> None:
    dn = add_defects(np.full((1000, 1001), 700.0, np.float32), Defects(2000, 3000), 4095, Draw(2).generator("x"))
    dead, hot = int((dn == 0).sum()), int((dn == 4095).sum())
    for count, expected in ((dead, 2002), (hot, 3003)):
        assert abs(count - expected) < 5 * math.sqrt(expected)
    assert int((dn == 700).sum()) == dn.size - dead - hot


def test_smear_averages_along_the_track_and_nothing_across() -> None:
    ratio, side = 4, 160
    y = (np.arange(side) + 0.5) / ratio
    along = np.tile((100 + 30 * np.cos(2 * math.pi * 0.1 * y)).astype(np.float32)[:, None], side)
    for image, factor in ((along, float(np.sinc(3.0 * 0.1))), (along.T, 1.0)):
        contrasts = []
        for smear_px in (0.0, 3.0):
            transfer = transfer_function(side, side, ratio, 0.2, 0.0, smear_px)
            contrasts.append(float(sample(scene_spectrum(image), transfer, side, ratio).std()))
        assert contrasts[1] / contrasts[0] == pytest.approx(factor, rel=1e-4)


@pytest.mark.parametrize("sigma_px", [0.1, 0.3, 0.4])
def test_the_anti_alias_filter_is_part_of_the_budget(sigma_px: float) -> None:
    assert float(mtf(0.5, 0.0, 0.07, sigma_px)) == pytest.approx(0.07, rel=1e-9)
    assert gamma_from_mtf(0.07, sigma_px) < gamma_from_mtf(0.07)


def test_an_infeasible_budget_is_refused_with_its_numbers() -> None:
    with pytest.raises(OptionError, match=r"up to 0\.1854 behind an anti-alias filter that keeps 0\.291"):
        gamma_from_mtf(0.25, 0.5)


def test_the_offset_lifts_every_pixel() -> None:
    flat = np.full((20, 24), 10.0, np.float32)
    dark, lifted = (
        stages.before_digitising(flat, stages.plain_sensor(**e), 2, Draw(0), {"noise"})
        for e in ({}, {"offset": Offset(64.0)})
    )
    np.testing.assert_allclose(lifted - dark, 64.0, rtol=1e-6)


@pytest.mark.parametrize("name", ["dsnu", "striping", "offset"])
def test_the_noise_is_the_same_whether_a_pattern_is_applied_or_not(name: str) -> None:
    """What is added in DN is then all that differs, and it is the same in every row."""
    radiance = scene(93, 111)
    sensor = stages.plain_sensor(dsnu=Dsnu(3.0), striping=Striping(2.0), offset=Offset(64.0))
    whole = stages.before_digitising(radiance, sensor, 3, Draw(5))
    added = whole - stages.before_digitising(radiance, sensor, 3, Draw(5), {name})
    np.testing.assert_allclose(added, np.broadcast_to(added[:1], added.shape), atol=1e-3)
    assert np.abs(added).min() > 0


@given(st.floats(1, 150), st.floats(0, 0.5), st.floats(0, 9), st.integers(2, 37), st.integers(0, 99))
def test_a_full_well_gives_back_no_more_than_its_share_of_what_it_cuts_off(
    well: float, share: float, length_px: float, rows: int, seed: int
) -> None:
    image = scene(rows, 9, seed)
    flooded, clipped = saturate(image, FullWell(well, share, length_px)).astype(float), image.clip(max=well)
    cut, gained = (image.astype(float) - clipped).sum(0), (flooded - clipped).sum(0)
    assert (flooded >= clipped).all()
    assert float(flooded.max()) <= well * (1 + 1e-6)
    assert (gained <= share * cut + 1e-3).all()


def test_defect_rates_of_zero_change_nothing_and_of_a_million_everything() -> None:
    dn = scene(17, 23)
    for defects, expected in (
        (Defects(0, 0), dn),
        (Defects(1e6, 0), np.zeros_like(dn)),
        (Defects(0, 1e6), np.full_like(dn, 255.0)),
    ):
        assert np.array_equal(add_defects(dn, defects, 255, Draw(0).generator("x")), expected)
