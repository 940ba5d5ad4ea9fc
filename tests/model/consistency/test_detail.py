"""Tests of the step for finer detail: when it is used, what it removes and what it keeps."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from tests.model.consistency.images import (
    FULL_SCALE,
    GAUSSIAN,
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
    step_for,
    whole_step_for,
)


def detail(name: str, raw: Pixels, restored: Pixels) -> NDArray[np.float32]:
    """Return what the step for finer detail adds to the consistency step."""
    whole = corrected(whole_step_for(name), raw, restored)
    return whole - corrected(step_for(name), raw, restored)


@pytest.mark.parametrize("name", [*SENSORS, "Gaussian"])
def test_it_is_used_where_the_curve_departs_from_the_formula(name: str) -> None:
    departs = name in ("smear", "antialias", "lopsided point", "narrow point", "Gaussian")
    assert (whole_step_for(name).detail is not None) == departs


@pytest.mark.parametrize("name", ["smear", "lopsided point", "narrow point"])
def test_a_consistent_pair_hardly_changes(name: str) -> None:
    """The change is 0.4 to 2.5 DN rms at 480 DN of contrast (measured).

    The control has another blur.
    """
    raw = blurred(scene(), SENSORS[name])
    assert rms(detail(name, raw, scene())[INSIDE]) < 3
    assert rms(detail("Gaussian", raw, scene())[INSIDE]) > 6


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
    error = 0.3 * band[INSIDE]
    rest, coarse_rest = (
        (corrected(step, raw, restored) - corrected(step, raw, truth))[INSIDE] + error
        for step in (whole_step_for("Gaussian"), step_for("Gaussian"))
    )
    assert rms(rest) < 0.5 * rms(error)
    assert rms(rest) < 0.8 * rms(coarse_rest)


def test_a_third_of_the_noise_returns_on_flat_ground() -> None:
    ground = np.full(scene().shape, 1500.0)
    sigma = sigma_dn(GAUSSIAN, 1500)
    added = detail("Gaussian", noisy(ground, GAUSSIAN), ground)[INSIDE]
    assert 0.25 * sigma < rms(added) < 0.35 * sigma


@pytest.mark.parametrize("share", [0.02, 0.5, 0.9])
def test_only_rounding_changes_flat_ground(share: float) -> None:
    ground = np.full((90, 77), share * FULL_SCALE)
    assert np.abs(detail("Gaussian", ground, ground)).max() < 1e-6 * FULL_SCALE


def test_nothing_is_added_at_the_border_nor_next_to_unknown_or_saturated_pixels() -> None:
    raw = acquired(GAUSSIAN)
    restored = scene().copy()
    restored[100:120, 130:150] = np.nan
    raw[100:120, 130:150] = 1e9
    raw[200, 60] = FULL_SCALE
    added = detail("Gaussian", raw, restored)
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
