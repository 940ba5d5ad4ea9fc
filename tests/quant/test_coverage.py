"""Tests of the samples' range: its percentiles, its record, and records that are invalid."""

from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from beers_deploy.quant.samples.coverage import (
    KEY,
    SampleRange,
    histogram,
    range_from,
    recorded_range,
    uncovered,
)

DARK = SampleRange(0.0, 0.01, 0.2, 0.3, 0.0)
FULL = SampleRange(0.0, 0.2, 0.95, 1.0, 0.01)


@given(st.lists(st.integers(0, 4095), min_size=1, max_size=300), st.integers(1, 5))
def test_percentiles_are_those_of_all_pixels_however_they_are_divided(
    pixels: list[int], parts: int
) -> None:
    values = np.array(pixels, np.float32) / np.float32(4095)
    sample_range = range_from(sum(map(histogram, np.array_split(values, parts)), np.zeros(1)))
    expected = np.quantile(values, [0.01, 0.5, 0.99, 0.999], method="inverted_cdf")
    assert_allclose(
        [sample_range.p1, sample_range.p50, sample_range.p99, sample_range.p99_9],
        expected,
        atol=2 / 4096,
    )
    assert sample_range.saturated == pytest.approx(np.mean(np.array(pixels) == 4095))


@given(st.lists(st.floats(0, 1), min_size=4, max_size=4), st.floats(0, 1))
def test_a_recorded_range_is_read_back(values: list[float], saturated: float) -> None:
    p1, p50, p99, p99_9 = sorted(values)
    sample_range = SampleRange(p1, p50, p99, p99_9, saturated)
    stored = recorded_range({KEY: sample_range.to_words()})
    assert stored is not None
    assert_allclose(astuple(stored), astuple(sample_range), atol=1e-6)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "3",
        "[]",
        "null",
        '{"p1": 0}',
        '{"p1": 0, "p50": 0.5, "p99": 0.4, "p99_9": 1, "saturated": 0}',
        '{"p1": 0, "p50": 0.5, "p99": 0.6, "p99_9": 7, "saturated": 0}',
        '{"p1": 0, "p50": 0.5, "p99": 0.6, "p99_9": NaN, "saturated": 0}',
        '{"p1": 0, "p50": 0.5, "p99": 0.6, "p99_9": 1, "saturated": "much"}',
        '{"p1": 0, "p50": 0.5, "p99": 0.6, "p99_9": 1, "saturated": 0, "more": 1}',
        "[" * 5000,
    ],
)
def test_a_record_that_makes_no_sense_is_none(text: str) -> None:
    assert recorded_range({KEY: text}) is None
    assert recorded_range({}) is None


def test_bright_ground_that_no_sample_shows_is_reported() -> None:
    assert uncovered(FULL, None) == uncovered(FULL, DARK) == ""
    assert "calibration reached 0.30" in uncovered(DARK, DARK)
    assert "nothing brighter was judged" in uncovered(DARK, FULL)
    assert "calibration" not in uncovered(DARK, FULL)
