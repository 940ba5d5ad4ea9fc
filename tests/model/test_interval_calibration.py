"""Tests of the calibration of an interval: its quantile, its fit and its coverage."""

import math
from dataclasses import astuple, replace
from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose

from beers_deploy.model.interval import Conditions, Exponents
from beers_deploy.model.interval_calibration import (
    BORDER_PX,
    Sample,
    calibrated,
    conformal_quantile,
    fit_exponents,
)
from beers_deploy.model.levels import LEVELS
from beers_deploy.profiles.errors import OptionError
from tests.model.exponents import EXPONENTS
from tests.model.simulator.stages import NOMINAL

MAX_DN = float(NOMINAL.max_dn)


def random_scores(count: int, size: int = 1, seed: int = 0) -> list[np.ndarray]:
    """Draw the scores of `count` groups of one size, each group with another scale."""
    generator = np.random.default_rng(seed)
    return [generator.exponential(generator.uniform(0.5, 2), size) for _ in range(count)]


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("count", [9, 19, 20, 99, 250])
def test_the_quantile_of_single_scores_is_that_of_split_conformal_prediction(
    count: int, level: int
) -> None:
    scores = random_scores(count)
    # The rank is computed in integers because 100 * 0.68 is not 68 in floating point.
    rank = -(-(count + 1) * level // 100)
    expected = math.inf if rank > count else np.sort(np.concatenate(scores))[rank - 1]
    assert conformal_quantile(scores, level) == expected


@pytest.mark.parametrize("level", [50, 80, 90])
def test_the_quantile_is_that_of_puncc(level: int) -> None:
    """DEEL's puncc gets the scores, their weights, and the weight of the group to come."""
    calibration = pytest.importorskip(
        "deel.puncc.api.calibration",
        reason="puncc is not installed: it needs NumPy below 2, pandas and scikit-learn",
    )
    calibrator = calibration.BaseCalibrator(
        nonconf_score_func=lambda predicted, true: np.abs(predicted - true),
        pred_set_func=lambda predicted, scores_quantile: (predicted, scores_quantile),
    )
    # No sum of weights equals a level: puncc's float sums may fall on either side of a tie.
    for scores in (random_scores(36), [*random_scores(20, 7), *random_scores(12, 3, seed=1)]):
        values = np.concatenate(scores)
        calibrator.fit(y_true=values, y_pred=np.zeros_like(values))
        shares = [np.full(group.size, 1 / group.size) for group in scores]
        weights = np.concatenate([*shares, np.ones(1)]) / (len(scores) + 1)
        theirs = calibrator.compute_quantile(alpha=1 - level / 100, weights=weights)
        assert conformal_quantile(scores, level) == pytest.approx(float(theirs), rel=1e-12)
        if len(values) == len(scores):
            plain = calibrator.compute_quantile(alpha=1 - level / 100)
            assert conformal_quantile(scores, level) == pytest.approx(float(plain), rel=1e-12)


def test_a_new_group_is_covered_at_the_level() -> None:
    """Over many calibrations the mean coverage of one more group is the level or a little more."""
    covered = []
    for seed in range(400):
        *scores, new = random_scores(20, 30, seed)
        covered.append(float((new <= conformal_quantile(scores, 80)).mean()))
    assert 0.80 <= np.mean(covered) <= 0.87


def sample_of(exponents: Exponents, seed: int, blur: float = 0.0, noise: float = 0.0) -> Sample:
    """Draw errors whose size follows a half-width exactly, for a sensor of that blur and noise."""
    generator = np.random.default_rng(seed)
    conditions = Conditions(blur, noise, middle_noise=5.0)
    detail = generator.uniform(0.1, 20, 4000)
    sigma = generator.uniform(1, 9, 4000)
    half = exponents.half_widths(conditions, sigma, detail)
    return Sample(conditions, sigma, detail, half * np.abs(generator.normal(size=4000)))


def test_the_fit_finds_the_exponents_that_made_the_errors() -> None:
    blurs = np.linspace(-1.5, 0.7, 6)
    sensors = enumerate(product(blurs, blurs))
    samples = [sample_of(EXPONENTS, seed, blur, noise) for seed, (blur, noise) in sensors]
    fit = fit_exponents(samples)
    assert_allclose(astuple(fit), astuple(EXPONENTS), atol=0.03)


def test_one_sensor_alone_is_fitted_by_its_detail() -> None:
    """Detail times blur and detail times noise are then multiples of detail: the sum is fitted."""
    sample = sample_of(EXPONENTS, 0, blur=-0.8, noise=0.3)
    fit = fit_exponents([sample, *(sample_of(EXPONENTS, k, -0.8, 0.3) for k in (1, 2, 3))])
    scores = sample.scores(fit)
    assert np.corrcoef(np.log(sample.detail), np.log(scores))[0, 1] == pytest.approx(0, abs=0.05)
    assert (fit.blur, fit.noise) == pytest.approx((0, 0), abs=1e-6)


def test_each_sensor_is_covered_whatever_the_tails_of_its_errors() -> None:
    """Where the MTF is higher, errors of almost the same median have longer tails."""
    samples = list[Sample]()
    for k in range(108):
        sample = sample_of(EXPONENTS, k, 0.2 * (k % 9) - 1)
        scores = sample.scores(EXPONENTS)
        samples.append(replace(sample, error=sample.error * scores ** (0.2 * (k % 9))))
    interval = calibrated(samples[:12], samples[12:])
    for sample in samples[12:]:
        within = sample.scores(interval.exponents) <= interval.quantiles[90]
        assert within.mean() == pytest.approx(0.9, abs=0.03)


def test_images_that_are_saturated_all_over_calibrate_nothing() -> None:
    white = np.full((50, 50), MAX_DN, np.float32)
    sample = Sample.of(white, white, white, NOMINAL)
    known = sample_of(EXPONENTS, 0)
    for fitted, held_out in (([sample], [known]), ([known], [sample])):
        with pytest.raises(OptionError, match="needs pairs with pixels that are not saturated"):
            calibrated(fitted, held_out)


def test_a_calibrated_interval_covers_new_errors_at_each_level() -> None:
    fitted = [sample_of(EXPONENTS, k, 0.2 * k - 1) for k in range(9)]
    held_out = [sample_of(EXPONENTS, 100 + k, 0.03 * k - 1) for k in range(60)]
    interval = calibrated(fitted, held_out)
    # 60 acquisitions are too few for 99 %.
    assert list(interval.quantiles) == [50, 68, 80, 90, 95]
    assert sorted(interval.quantiles.values()) == list(interval.quantiles.values())
    new = sample_of(EXPONENTS, 999).scores(interval.exponents)
    for level, quantile in interval.quantiles.items():
        assert (new <= quantile).mean() == pytest.approx(level / 100, abs=0.03)
    with pytest.raises(OptionError, match=r"one of 50, 68, 80, 90, 95 .* got 99: .* 60 images"):
        interval.for_sensor(NOMINAL, MAX_DN, 99)


def test_a_sample_leaves_out_the_border_and_saturated_pixels() -> None:
    raw = np.full((60, 70), 500, np.float32)
    raw[30, 30:35] = MAX_DN
    restored = raw + 1
    sample = Sample.of(raw, restored, raw, NOMINAL)
    assert sample.error.size == (60 - 2 * BORDER_PX) * (70 - 2 * BORDER_PX) - 5
    assert_allclose(sample.error, 1)
