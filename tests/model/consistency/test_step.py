"""Tests of the consistency step: what it leaves unchanged and removes, also tile by tile."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from beers_deploy.model.consistency.blocks import Placed
from beers_deploy.model.consistency.step import RAW_REACH_PX, REACH_PX, Consistency
from beers_deploy.profiles.effects import Offset
from tests.model.consistency.images import (
    COLUMNS,
    FULL_SCALE,
    INSIDE,
    ROWS,
    SENSORS,
    Pixels,
    acquired,
    blurred,
    corrected,
    noisy,
    rms,
    scene,
    sigma_dn,
    step_for,
    whole_step_for,
)
from tests.model.simulator.stages import REFERENCE, plain_sensor

Cut = tuple[int, int, int, int]

WITH_DETAIL = whole_step_for("lopsided point")


def corrected_in_part(
    step: Consistency, raw: Pixels, restored: Pixels, cut: Cut
) -> NDArray[np.float32]:
    """Compute the correction of a part of an image, from as few pixels around it as suffice."""
    height, width = restored.shape
    top, bottom, left, right = cut
    first = max(top - REACH_PX, 0), max(left - REACH_PX, 0)
    first_raw = max(top - RAW_REACH_PX, 0), max(left - RAW_REACH_PX, 0)
    part = restored[first[0] : bottom + REACH_PX, first[1] : right + REACH_PX]
    part_raw = raw[first_raw[0] : bottom + RAW_REACH_PX, first_raw[1] : right + RAW_REACH_PX]
    down = Placed(height, first[0], top, bottom)
    across = Placed(width, first[1], left, right)
    return step.correction(
        part_raw.astype(np.float32), part.astype(np.float32), down, across, first_raw
    )


@st.composite
def spans(draw: st.DrawFn) -> tuple[int, int, int]:
    """Draw the size of an image's side, and the start and stop of a part of it."""
    size = draw(st.one_of(st.integers(1, 40), st.integers(41, 400)))
    start = draw(st.integers(0, size - 1))
    return size, start, draw(st.integers(start + 1, size))


@settings(max_examples=50)
@given(
    step=st.sampled_from([step_for("formula"), WITH_DETAIL]),
    down=spans(),
    across=spans(),
    lacks=st.sets(st.sampled_from(["pixels", "area", "saturated", "light"])),
    seed=st.integers(0, 99),
)
def test_any_part_is_corrected_as_the_whole_image_is_bit_for_bit(
    step: Consistency,
    down: tuple[int, int, int],
    across: tuple[int, int, int],
    lacks: set[str],
    seed: int,
) -> None:
    generator = np.random.default_rng(seed)
    height, top, bottom = down
    width, left, right = across
    raw, restored = (generator.random((2, height, width)) * 4000).astype(np.float32)
    some = generator.integers(0, height, 3), generator.integers(0, width, 3)
    if "light" in lacks:
        restored /= 100
    if "pixels" in lacks:
        restored[some] = np.nan
    if "area" in lacks:
        restored[height // 3 : height // 2, width // 4 : width // 2] = np.nan
    if "saturated" in lacks:
        raw[some[0][::-1], some[1]] = FULL_SCALE
    uncut = corrected(step, raw, restored)
    part = corrected_in_part(step, raw, restored, (top, bottom, left, right))
    assert_array_equal(part, uncut[top:bottom, left:right])
    assert np.isfinite(uncut).all()


@settings(max_examples=40)
@given(
    name=st.sampled_from(list(SENSORS)),
    height=st.one_of(st.just(1), st.integers(1, 90)),
    width=st.one_of(st.just(1), st.integers(1, 90)),
    share=st.floats(0, 1),
)
def test_a_constant_image_does_not_change(name: str, height: int, width: int, share: float) -> None:
    """Only rounding changes it, from where noise is no longer clipped at zero up to full scale.

    Measured: at most 0.002 DN, 8 units in the last place of float32.
    """
    step = step_for(name)
    darkest_dn = float(step.means[-1])
    constant = np.full((height, width), darkest_dn + share * (FULL_SCALE - 1 - darkest_dn))
    assert np.abs(corrected(step, constant, constant)).max() < 1e-6 * FULL_SCALE


@pytest.mark.parametrize("name", SENSORS)
def test_a_consistent_pair_hardly_changes(name: str) -> None:
    """Measured: it changes by 0.3 to 0.8 DN rms, at a contrast of 480 DN and a noise of 9 DN."""
    restored = scene()
    sensor = SENSORS[name]
    change = corrected(step_for(name), blurred(restored, sensor), restored)[INSIDE]
    assert rms(change) < 1.0
    assert np.abs(change).max() < 4


ERRORS = {
    "offset": np.full((ROWS, COLUMNS), 5.0),
    "slope": np.broadcast_to(np.linspace(-6, 6, COLUMNS), (ROWS, COLUMNS)),
    "gain": 0.01 * gaussian_filter(scene().astype(np.float64), 24),
}
"""Smooth errors of a restored image in DN: an offset, a slope, and a gain of large structures."""


@pytest.mark.parametrize("name", ["formula", "two axes", "lopsided point"])
@pytest.mark.parametrize("error", ERRORS)
def test_smooth_errors_are_removed_in_noise_and_once_is_enough(name: str, error: str) -> None:
    """The noise is the same with and without the error, so the difference is the error alone."""
    sensor = SENSORS[name]
    step = step_for(name)
    wrong = ERRORS[error]
    raw = acquired(sensor)
    without = corrected(step, raw, scene())
    restored = scene() + wrong
    change = corrected(step, raw, restored)
    rest = (change - without + wrong)[INSIDE]
    assert rms(rest) < 0.02 * rms(wrong[INSIDE])
    repeated = corrected(step, raw, restored + change) - corrected(step, raw, scene() + without)
    assert rms(repeated[INSIDE]) < 0.01 * sigma_dn(sensor, 1500)


@pytest.mark.parametrize("name", ["formula", "two axes", "lopsided point", "narrow point"])
def test_little_noise_returns_on_flat_ground(name: str) -> None:
    """Measured: the first application adds 0.083 sigma, a second changes 0.028 to 0.037 sigma, and
    a third 0.013 to 0.021.

    Interpolation between block means is no projection: it keeps half of what alternates from block
    to block.
    """
    sensor = SENSORS[name]
    step = step_for(name)
    ground = np.full((ROWS, COLUMNS), 1500.0)
    sigma = sigma_dn(sensor, 1500)
    raw = noisy(ground, sensor)
    first = corrected(step, raw, ground)
    second = corrected(step, raw, ground + first)
    third = corrected(step, raw, ground + first + second)
    assert 0.07 * sigma < rms(first[INSIDE]) < 0.1 * sigma
    assert rms(second[INSIDE]) < 0.045 * sigma
    assert rms(third[INSIDE]) < rms(second[INSIDE])


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("at", [(0, 0), (3, 4), (5, 2)])
def test_the_flux_of_an_erased_point_is_restored(name: str, at: tuple[int, int]) -> None:
    """Measured within 49 x 49 pixels: 98.4 to 101.2 %; H spreads the rest farther away."""
    row, column = np.mgrid[:201, :201] - np.array([100 + at[0], 100 + at[1]])[:, None, None]
    point = 800 * np.exp(-(row**2 + column**2) / 2 / 0.8**2)
    ground = np.full(point.shape, 500.0)
    change = corrected(step_for(name), blurred(ground + point, SENSORS[name]), ground)
    window = np.s_[76 + at[0] : 125 + at[0], 76 + at[1] : 125 + at[1]]
    assert change[window].sum() == pytest.approx(point.sum(), rel=0.03)


HOLE = np.s_[100:200, 120:220]
"""An area without known pixels. Its borders are not aligned with the blocks."""


def around_hole(px: int) -> NDArray[np.bool_]:
    """Return a mask of the known pixels within `px` rows and columns of the hole."""
    near = np.zeros((ROWS, COLUMNS), bool)
    near[100 - px : 200 + px, 120 - px : 220 + px] = True
    near[HOLE] = False
    return near


def holed(name: str) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return the raw image, a restored one with an offset and a hole, and the correction without
    the hole.
    """
    sensor = SENSORS[name]
    raw = acquired(sensor)
    restored = scene() + np.float32(5)
    without_hole = corrected(step_for(name), raw, restored)
    restored[HOLE] = np.nan
    return raw, restored, without_hole


@pytest.mark.parametrize("name", ["formula", "lopsided point"])
def test_around_a_hole_the_correction_is_nearly_that_without_the_hole(name: str) -> None:
    """Measured: 0.16 to 0.24 sigma rms off from 8 to 16 px, 0.06 to 0.08 from 24 to 40 px, 0.02
    farther away.

    Nearer than 8 px most pixels have no block whose residual is known, and their correction is 0.
    """
    raw, restored, without_hole = holed(name)
    change = corrected(step_for(name), raw, restored)
    sigma = sigma_dn(SENSORS[name], 1500)
    assert np.isfinite(change).all()
    for nearer_px, farther_px, most in (
        (8, 16, 0.3),
        (16, 24, 0.2),
        (24, 40, 0.1),
        (40, REACH_PX, 0.03),
    ):
        ring = around_hole(farther_px) & ~around_hole(nearer_px)
        assert rms((change - without_hole)[ring]) < most * sigma
    assert np.abs(change).max() < np.abs(without_hole).max() + sigma


@pytest.mark.parametrize("value", [0.0, 7.0, FULL_SCALE, 1e9, np.inf, np.nan])
def test_raw_values_of_missing_pixels_do_not_matter(value: float) -> None:
    raw, restored, _ = holed("formula")
    before = corrected(step_for("formula"), raw, restored)
    raw[HOLE] = value
    with np.errstate(invalid="ignore"):
        after = corrected(step_for("formula"), raw, restored)
    assert_array_equal(after[around_hole(200)], before[around_hole(200)])
    assert np.isfinite(before).all()


@pytest.mark.parametrize("name", ["formula", "lopsided point"])
def test_around_a_clipped_area_nothing_is_brightened(name: str) -> None:
    """The residual of a clipped roof of 5200 DN is not noise.

    The control treats clipped pixels like others.
    """
    sensor = SENSORS[name]
    step = step_for(name)
    bright = scene().copy()
    bright[150:182, 140:190] = 5200
    unclipped = blurred(bright, sensor)
    raw = np.minimum(unclipped, FULL_SCALE)
    restored = np.minimum(bright, FULL_SCALE)
    around = np.zeros(raw.shape, bool)
    around[138:194, 128:202] = True
    around &= raw < FULL_SCALE
    truth = corrected(replace(step, full_scale=1e9), unclipped, bright)[around]
    careless = corrected(replace(step, full_scale=1e9), raw, restored)[around]
    change = corrected(step, raw, restored)[around]
    assert abs(change.mean()) < 0.2 * sigma_dn(sensor, 1500)
    assert np.abs(change).max() < np.abs(truth).max() + sigma_dn(sensor, 1500)
    assert abs(careless.mean()) > 4 * sigma_dn(sensor, 1500)


@pytest.mark.parametrize("offset_dn", [0.0, 2.0, 100.0])
@pytest.mark.parametrize("sigmas", [0.3, 1.0, 3.0])
def test_noise_clipped_at_zero_keeps_the_mean_of_the_dark(offset_dn: float, sigmas: float) -> None:
    """At a signal of 0.74 DN the raw mean is 0.65 DN too bright.

    The step removes all but 0.04 DN (measured).
    """
    sensor = plain_sensor(**({"offset": Offset(offset_dn)} if offset_dn else {}))
    dark_dn = float(np.hypot(sensor.noise_sigma(0) * sensor.gain_dn_per_radiance, np.sqrt(1 / 12)))
    signal_dn = sigmas * dark_dn + offset_dn
    noise = np.random.default_rng(8).normal(0, sigma_dn(sensor, signal_dn), (400, 400))
    raw = np.clip(np.rint(signal_dn + noise), 0, FULL_SCALE)
    start = np.full(raw.shape, raw.mean())
    corrected_dark = start + corrected(Consistency.of(sensor, REFERENCE), raw, start)
    light = signal_dn - offset_dn
    assert corrected_dark.mean() - offset_dn == pytest.approx(light, abs=0.05 * dark_dn)
    if offset_dn == 0 and sigmas < 1:
        assert raw.mean() > 1.5 * signal_dn
