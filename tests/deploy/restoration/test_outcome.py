"""Tests of warnings about a result: 3 % more light gives one, shipped networks give none."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import beers_deploy as bd
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.outcome import Tally
from tests.deploy.restoration.runs import restored, simulated

SENSOR = Sensor.load("pleiades-degraded")


def tally(image: np.ndarray, result: np.ndarray) -> Tally:
    return Tally.of(image[None], result[None], None, None)


def doubts_the_mean(counts: Tally) -> bool:
    return any("the mean went from" in doubt for doubt in counts.doubts)


@given(
    st.integers(0, 2**20),
    st.floats(0.08, 0.5),
    st.floats(0.05, 0.5),
    st.sampled_from([-0.03, 0.03]),
)
def test_three_percent_of_an_ordinary_scene_are_doubted_and_one_is_not(
    seed: int, mean: float, contrast: float, share: float
) -> None:
    """The mean is 8 to 50 % of full scale and the contrast up to half of it, as in most scenes in
    daylight.
    """
    image = mean * (1 + contrast * np.random.default_rng(seed).uniform(-1, 1, (200, 200)))
    brighter = tally(image, (1 + share) * image)
    assert doubts_the_mean(brighter)
    assert brighter.figures["mean moved"].value == pytest.approx(100 * share * image.mean())
    assert not doubts_the_mean(tally(image, (1 + share / 3) * image))


@given(st.integers(0, 2**20), st.floats(0.0006, 0.0072))
def test_noise_that_was_clipped_at_0_may_be_added_or_taken_off(seed: int, sigma: float) -> None:
    noise = np.random.default_rng(seed).normal(0, sigma, (200, 200))
    raw = np.maximum(noise, 0)
    for shift in (-0.35 * sigma, 0.35 * sigma):
        assert not doubts_the_mean(tally(raw, np.full_like(raw, raw.mean() + shift)))
    assert doubts_the_mean(tally(raw, raw + 0.02))


@given(st.integers(0, 2**20), st.floats(0.0003, 0.0072), st.booleans())
def test_areas_of_zero_are_doubted_and_clipped_noise_is_not(
    seed: int, sigma: float, has_border: bool
) -> None:
    raw = np.maximum(np.random.default_rng(seed).normal(0, sigma, (200, 200)), 0)
    if has_border:
        raw[:, :40] = 0
    counts = tally(raw, raw)
    assert any("exactly 0" in doubt for doubt in counts.doubts) == has_border
    assert counts.blank == has_border * 200 * 40


def test_parts_add_up_to_the_whole() -> None:
    image = np.random.default_rng(1).uniform(0, 0.1, (60, 50))
    parts = tally(image[:20], image[:20]) + tally(image[20:], image[20:])
    total = tally(image, image)
    assert parts.dark == total.dark > 0
    assert parts.mean_bound == pytest.approx(total.mean_bound)


@pytest.mark.parametrize(
    "options",
    [{"network": "convbeers-xs-int8"}, {"method": "traditional", "sensor": SENSOR}],
    ids=["network", "traditional"],
)
def test_the_share_at_the_ends_is_that_of_the_stored_numbers(
    options: dict[str, Any], tmp_path: Path
) -> None:
    """A result of 0.3 DN is stored as 0."""
    raw = np.ones((64, 64), np.uint16)
    # A restoration undershoots around the square.
    raw[20:40, 20:40] = 2000
    result, row = restored(tmp_path, raw, force=True, **options)
    ends = (result == 0) & (raw > 0)
    assert 0 < ends.mean() < 1
    assert row.figures["results at ends"].value == pytest.approx(100 * ends.mean())


@settings(max_examples=5)
@given(st.integers(0, 2**20), st.sampled_from([1.0, 0.25, 0.05, 0.01]), st.booleans())
def test_shipped_networks_are_not_doubted(seed: int, light: float, has_sensor: bool) -> None:
    generator = np.random.default_rng(seed)
    radiance = light * procedural_scene(480, 480, generator).radiance
    pair = simulated(images=radiance.astype(np.float32), sensor=SENSOR, seed=seed)
    tallies: list[Tally] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Tally, "require", lambda self, **_: tallies.append(self))
        sensor = SENSOR if has_sensor else "blind"
        bd.restore(pair.degraded, network="convbeers-xs-int8", sensor=sensor)
    assert not doubts_the_mean(tallies[0])
