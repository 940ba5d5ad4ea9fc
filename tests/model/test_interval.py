"""The interval of a restored pixel: its quantile, its fit, its half-widths and its stored form."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from beers_deploy.model.interval import (
    BORDER_PX,
    LEAST_DETAIL,
    Exponents,
    PixelInterval,
    Sample,
    calibrated,
    conformal_quantile,
    fit_exponents,
)
from beers_deploy.model.levels import LEVELS
from beers_deploy.model.self_check import noise_variances
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.sensor import Sensor

SENSOR = Sensor.load("pleiades-degraded").nominal()
EXPONENTS = Exponents(0.4, -0.2, -0.1, 0.1)
INTERVAL = PixelInterval(EXPONENTS, {50: 0.7, 90: 1.8}, 40)
MAX_DN = float(SENSOR.max_dn)


def random_scores(count: int, size: int = 1, seed: int = 0) -> list[np.ndarray]:
    """Scores of so many groups of one size, each group of another scale."""
    generator = np.random.default_rng(seed)
    return [generator.exponential(generator.uniform(0.5, 2), size) for _ in range(count)]


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("count", [9, 19, 20, 99, 250])
def test_the_quantile_of_single_scores_is_that_of_split_conformal_prediction(
    count: int, level: int
) -> None:
    scores = random_scores(count)
    # In integers: as floats, 100 * 0.68 is not 68.
    rank = -(-(count + 1) * level // 100)
    wanted = math.inf if rank > count else np.sort(np.concatenate(scores))[rank - 1]
    assert conformal_quantile(scores, level) == wanted


@pytest.mark.parametrize("level", [50, 80, 90])
def test_the_quantile_is_that_of_puncc(level: int) -> None:
    """DEEL's puncc gets the scores, the weights, and one infinite score for the group to come."""
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


def test_a_new_group_is_covered_as_often_as_the_level_says() -> None:
    """Over many calibrations the mean coverage of one more group is the level or a little more."""
    covered = []
    for seed in range(400):
        *scores, new = random_scores(20, 30, seed)
        covered.append(float((new <= conformal_quantile(scores, 80)).mean()))
    assert 0.80 <= np.mean(covered) <= 0.87
    # Negative control: the quantile of a lower level covers less.
    low = []
    for seed in range(400):
        *scores, new = random_scores(20, 30, seed)
        low.append(float((new <= conformal_quantile(scores, 68)).mean()))
    assert np.mean(low) < 0.78


def sample_of(exponents: Exponents, scale: float, seed: int, mtf: float = 0.07) -> Sample:
    """Errors whose size follows a half-width to the letter, of a sensor of that MTF."""
    generator = np.random.default_rng(seed)
    sensor = replace(SENSOR, mtf_nyquist=mtf)
    detail = generator.uniform(0.1, 20, 4000)
    noise = generator.uniform(3, 9, 4000)
    exponent, factor = exponents.of_sensor(sensor)
    error = scale * factor * noise * detail**exponent * np.abs(generator.normal(size=4000))
    return Sample(sensor, noise, detail, error)


def test_the_fit_finds_the_exponents_that_made_the_errors() -> None:
    made = replace(EXPONENTS, noise=0.0)
    samples = [sample_of(made, 1.0, k, 0.015 * 1.3**k) for k in range(9)]
    found = fit_exponents(samples)
    assert found.detail == pytest.approx(made.detail, abs=0.02)
    assert found.blur == pytest.approx(made.blur, abs=0.03)
    assert found.detail_by_blur == pytest.approx(made.detail_by_blur, abs=0.02)
    # All sensors have one noise, so nothing is said of it.
    assert found.noise == pytest.approx(0, abs=1e-6)


def test_one_sensor_alone_is_fitted_by_its_detail() -> None:
    """The term detail times blur is then a multiple of detail: both together give the slope."""
    sensor = replace(SENSOR, mtf_nyquist=0.03)
    samples = [sample_of(EXPONENTS, 1.0, k, 0.03) for k in range(4)]
    found = fit_exponents(samples)
    assert found.of_sensor(sensor)[0] == pytest.approx(EXPONENTS.of_sensor(sensor)[0], abs=0.02)
    assert found.blur == pytest.approx(0, abs=1e-6)


def test_a_calibrated_interval_covers_what_was_held_out_and_more_by_level() -> None:
    fitted = [sample_of(EXPONENTS, 1.0, k, 0.02 + 0.01 * k) for k in range(9)]
    held_out = [sample_of(EXPONENTS, 1.0, 100 + k, 0.02 + 0.002 * k) for k in range(60)]
    interval = calibrated(fitted, held_out)
    # 60 acquisitions are too few for 99 %.
    assert list(interval.quantiles) == [50, 68, 80, 90, 95]
    assert sorted(interval.quantiles.values()) == list(interval.quantiles.values())
    new = sample_of(EXPONENTS, 1.0, 999).scores(interval.exponents)
    for level, quantile in interval.quantiles.items():
        assert (new <= quantile).mean() == pytest.approx(level / 100, abs=0.03)
    with pytest.raises(OptionError, match=r"one of 50, 68, 80, 90, 95 .* got 99: .* 60 images"):
        interval.for_sensor(SENSOR, MAX_DN, 99)


def test_half_widths_follow_the_formula_and_the_units() -> None:
    """They are those of the formula, pixel by pixel, and scale with the pixel values."""
    generator = np.random.default_rng(3)
    pixels = generator.integers(0, 4096, (9, 11)).astype(np.uint16)
    known = np.ones(pixels.shape, bool)
    half = INTERVAL.for_sensor(SENSOR, MAX_DN, 90).of(pixels, known)
    window = pixels[3:6, 4:7].astype(np.float64)
    dark, growth, square = noise_variances(SENSOR, MAX_DN)
    light = window.mean()
    sigma = math.sqrt(dark + growth * light + square * light**2)
    exponent, factor = EXPONENTS.of_sensor(SENSOR)
    wanted = 1.8 * factor * sigma * (window.std() / sigma) ** exponent
    assert half[4, 5] == pytest.approx(wanted, rel=1e-6)
    assert half.dtype == np.float32
    # The same image in other units, such as shares of full scale.
    scaled = INTERVAL.for_sensor(SENSOR, 1.0, 90).of(pixels / MAX_DN, known)
    np.testing.assert_allclose(scaled * MAX_DN, half, rtol=1e-5)


def test_windows_need_one_pixel_of_context_and_leave_missing_pixels_out() -> None:
    generator = np.random.default_rng(4)
    pixels = generator.integers(0, 4096, (20, 20)).astype(np.float32)
    known = np.ones(pixels.shape, bool)
    width = INTERVAL.for_sensor(SENSOR, MAX_DN, 90)
    whole = width.of(pixels, known)
    np.testing.assert_array_equal(width.of(pixels[6:15], known[6:15])[1:-1], whole[7:14])
    # Negative control: without context the outer rows differ.
    assert (width.of(pixels[6:15], known[6:15])[0] != whole[6]).any()
    known[10, 10] = False
    spoilt = [pixels.copy() for _ in range(3)]
    for image, value in zip(spoilt, (0.0, MAX_DN, np.nan), strict=True):
        image[10, 10] = value
    first, *others = (width.of(image, known) for image in spoilt)
    assert np.isnan(first[10, 10])
    assert np.isfinite(first).sum() == first.size - 1
    for half in others:
        np.testing.assert_array_equal(half, first)
    far = np.ones(pixels.shape, bool)
    far[9:12, 9:12] = False
    np.testing.assert_array_equal(first[far], whole[far])


def test_flat_ground_has_a_width_and_none_exceeds_full_scale() -> None:
    flat = np.full((5, 5), 1000, np.uint16)
    width = INTERVAL.for_sensor(SENSOR, MAX_DN, 90)
    half = width.of(flat, np.ones(flat.shape, bool))
    dark, growth, _ = noise_variances(SENSOR, MAX_DN)
    sigma = math.sqrt(dark + growth * 1000)
    assert half[2, 2] == pytest.approx(width.factor * sigma * LEAST_DETAIL**width.exponent)
    huge = replace(width, factor=1e6)
    assert huge.of(flat, np.ones(flat.shape, bool)).max() == MAX_DN


def test_a_sample_leaves_out_the_border_and_saturated_pixels() -> None:
    raw = np.full((60, 70), 500, np.float32)
    raw[30, 30:35] = MAX_DN
    restored = raw + 1
    sample = Sample.of(raw, restored, raw, SENSOR)
    assert sample.error.size == (60 - 2 * BORDER_PX) * (70 - 2 * BORDER_PX) - 5
    np.testing.assert_allclose(sample.error, 1)


def test_an_interval_comes_back_as_it_was_stored() -> None:
    assert PixelInterval.from_json(INTERVAL.to_json(), "a.onnx") == INTERVAL
    assert "\n" not in INTERVAL.to_json()


RECORD = json.loads(INTERVAL.to_json())


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        '"a\\u001b[31m"',
        json.dumps({**RECORD, "quantiles": {}}),
        json.dumps({**RECORD, "quantiles": {"90": 1e9}}),
        json.dumps({**RECORD, "quantiles": {"91": 1.0}}),
        json.dumps({**RECORD, "acquisitions": "many"}),
        json.dumps({**RECORD, "exponents": {**RECORD["exponents"], "detail": 1e300}}),
        json.dumps({**RECORD, "exponents": {**RECORD["exponents"], "other": 1}}),
        INTERVAL.to_json().replace("0.4", "NaN"),
    ],
)
def test_a_damaged_interval_is_refused_in_one_sentence(text: str) -> None:
    with pytest.raises(ModelError, match=r"^The interval in the metadata of a\.onnx is damaged"):
        PixelInterval.from_json(text, "a.onnx")
