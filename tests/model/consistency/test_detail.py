"""Tests of the step for finer detail: when it is used, what it removes and what it keeps."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from beers_deploy.model.consistency.step import Consistency
from beers_deploy.profiles.instrument import Instrument
from tests.model.consistency.images import (
    FULL_SCALE,
    INSIDE,
    SENSORS,
    Pixels,
    acquired,
    blurred,
    corrected,
    noisy,
    rms,
    scene,
    sigma_dn,
)
from tests.model.simulator.stages import (
    REFERENCE,
    gaussian_pixel,
    plain_sensor,
    with_response,
)

GAUSSIAN = with_response(plain_sensor(), gaussian_pixel(1.1, 1.1, 8, 129))
"""A sensor whose blur is a Gaussian of 1.1 pixels."""


def detail(sensor: Instrument, raw: Pixels, restored: Pixels) -> NDArray[np.float32]:
    """Return what the step for finer detail adds to the consistency step."""
    step = Consistency.of(sensor, REFERENCE)
    return corrected(step, raw, restored) - corrected(replace(step, detail=None), raw, restored)


@pytest.mark.parametrize("name", SENSORS)
def test_it_is_used_where_the_curve_departs_from_the_formula(name: str) -> None:
    departs = name in ("smear", "antialias", "lopsided point", "narrow point")
    assert (Consistency.of(SENSORS[name], REFERENCE).detail is not None) == departs
    assert Consistency.of(GAUSSIAN, REFERENCE).detail is not None


@pytest.mark.parametrize("name", ["smear", "lopsided point", "narrow point"])
def test_a_consistent_pair_hardly_changes(name: str) -> None:
    """The change is 0.4 to 2.5 DN rms at 480 DN of contrast (measured).

    The control has another blur.
    """
    sensor = SENSORS[name]
    assert rms(detail(sensor, blurred(scene(), sensor), scene())[INSIDE]) < 3
    assert rms(detail(GAUSSIAN, blurred(scene(), sensor), scene())[INSIDE]) > 6


@pytest.mark.parametrize("size_px", [1.5, 3.0])
def test_an_error_of_detail_is_removed_in_noise(size_px: float) -> None:
    """At least half of the error is removed, more than by the consistency step alone.

    The restoration amplifies a band of frequencies by up to 14 % too much, as one with a filter
    bank for another MTF curve would.
    """
    truth = scene()
    band = gaussian_filter(truth, size_px) - gaussian_filter(truth, 2 * size_px)
    restored = truth + 0.3 * band
    raw = noisy(blurred(truth, GAUSSIAN), GAUSSIAN)
    step = Consistency.of(GAUSSIAN, REFERENCE)
    error = 0.3 * band[INSIDE]
    with_noise = corrected(step, raw, truth)
    rest = (corrected(step, raw, restored) - with_noise)[INSIDE] + error
    coarse = replace(step, detail=None)
    coarse_rest = (corrected(coarse, raw, restored) - corrected(coarse, raw, truth))[INSIDE] + error
    assert rms(rest) < 0.5 * rms(error)
    assert rms(rest) < 0.8 * rms(coarse_rest)


def test_a_third_of_the_noise_returns_on_flat_ground() -> None:
    ground = np.full(scene().shape, 1500.0)
    sigma = sigma_dn(GAUSSIAN, 1500)
    added = detail(GAUSSIAN, noisy(ground, GAUSSIAN), ground)[INSIDE]
    assert 0.25 * sigma < rms(added) < 0.35 * sigma


@pytest.mark.parametrize("share", [0.02, 0.5, 0.9])
def test_only_rounding_changes_flat_ground(share: float) -> None:
    ground = np.full((90, 77), share * FULL_SCALE)
    assert np.abs(detail(GAUSSIAN, ground, ground)).max() < 1e-6 * FULL_SCALE


def test_nothing_is_added_at_the_border_nor_next_to_unknown_or_saturated_pixels() -> None:
    raw = acquired(GAUSSIAN)
    restored = scene().copy()
    restored[100:120, 130:150] = np.nan
    raw[100:120, 130:150] = 1e9
    raw[200, 60] = FULL_SCALE
    added = detail(GAUSSIAN, raw, restored)
    assert np.isfinite(added).all()
    for area in (
        np.s_[:16],
        np.s_[:, :16],
        # At these two borders the last block lies partly outside the image.
        np.s_[-13:],
        np.s_[:, -13:],
        np.s_[92:100, 122:158],
        np.s_[192:208, 52:68],
    ):
        assert (added[area] == 0).all()
    assert (added[INSIDE] != 0).mean() > 0.8
