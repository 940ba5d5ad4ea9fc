"""Tests that patches cover the sensor's range, and that scales fit ground brighter than samples."""

from collections import Counter
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.samples.coverage import histogram, range_from
from beers_deploy.quant.samples.simulated import Calibration, draw_patches, unseen_patches
from beers_deploy.quant.samples.views import (
    CALIBRATION,
    JUDGING,
    Lightings,
    assign_lightings,
    light_factor,
)
from beers_deploy.quant.session import open_session, run
from tests.quant.quick import behind_conv, patches_of, quickly, waves, without_references

SENSOR = Sensor.load("pleiades-degraded")
REFERENCE = Sensor.load("pleiades-reference")


@given(
    count=st.integers(1, 400),
    seed=st.integers(0, 2**31),
    lightings=st.sampled_from([CALIBRATION, JUDGING]),
)
def test_any_number_of_patches_is_lit_in_the_stated_shares(
    count: int, seed: int, lightings: Lightings
) -> None:
    assigned = assign_lightings(count, lightings, np.random.default_rng(seed))
    counts = Counter(assigned)
    assert counts.total() == count
    assert sum(lightings.values()) == 1
    for name, share in lightings.items():
        assert abs(counts[name] - count * share) <= 1


@settings(max_examples=60)
@given(
    full_scale=st.floats(50, 5000),
    brightness=st.floats(1e-3, 1e4),
    seed=st.integers(0, 2**31),
    shape=st.tuples(st.integers(30, 61), st.integers(30, 61)),
)
def test_bright_ground_comes_near_full_scale_and_saturated_ground_beyond(
    full_scale: float, brightness: float, seed: int, shape: tuple[int, int]
) -> None:
    generator = np.random.default_rng(seed)
    radiance = brightness * generator.gamma(2.0, size=shape)

    def lit(name: str) -> np.ndarray:
        return radiance * light_factor(name, radiance, full_scale, generator) / full_scale

    assert 0.7 < np.quantile(lit("bright"), 0.999) <= 1.0001
    assert np.mean(lit("saturated") > 1) < 0.051
    assert 0.049 < np.mean(lit("dark")) / np.mean(radiance / full_scale) < 0.251
    np.testing.assert_array_equal(lit("as drawn"), radiance / full_scale)


@pytest.mark.parametrize("name", JUDGING)
def test_ground_without_light_stays_finite(name: str) -> None:
    assert np.isfinite(light_factor(name, np.zeros((9, 11)), 400.0, np.random.default_rng(0)))


@pytest.mark.slow
def test_default_patches_cover_the_range_and_those_of_the_gate_as_well() -> None:
    """Without relighting, 99.9 % of a scene's pixels lie in the lower half of the range."""
    calibration = Calibration(SENSOR, None, patches=32, patch_px=48, seed=0)
    for patches in (calibration.drawn, unseen_patches(SENSOR, None, 32, 0)):
        sample_range = range_from(sum(map(histogram, patches.degraded), np.zeros(1)))
        assert sample_range.p99_9 > 0.75
        assert sample_range.p1 < 0.05


def test_simulated_patches_are_shares_of_full_scale() -> None:
    """The brightest unlit ground of a drawn scene, paint of 260 W/m2/sr/um, is below full scale."""
    scenes = [procedural_scene(500, 520, np.random.default_rng(1))]
    patches = draw_patches(scenes, SENSOR, REFERENCE, 8, 3, 40, lightings={})
    largest = max(float(image.max()) for image in chain.from_iterable(patches.pairs))
    assert 0.02 < largest <= 1


def test_lightings_change_the_exposure_alone() -> None:
    scenes = [procedural_scene(500, 520, np.random.default_rng(1))]
    lit, plain = (
        draw_patches(scenes, SENSOR, REFERENCE, 16, 3, 40, lightings=lightings)
        for lightings in (JUDGING, {})
    )
    ratios = set()
    for one, other in zip(lit.views, plain.views, strict=True):
        exposure = one.ground.exposure
        assert replace(other, ground=replace(other.ground, exposure=exposure)) == one
        ratios.add(round(exposure / other.ground.exposure, 6))
    assert 1 in ratios
    assert len(ratios) > 4
    repeated = draw_patches(scenes, SENSOR, REFERENCE, 16, 3, 40, lightings=JUDGING)
    assert repeated.digest == lit.digest != plain.digest


def test_scales_hold_ground_that_is_brighter_than_the_samples() -> None:
    """Factors of the search do not pass HardSwish, so scales alone can prevent clipping.

    The samples have a tenth of the light of the image that is judged.
    """
    model = behind_conv(
        "y = HardSwish(x) restored = Conv(y, last)", last=np.full((1, 2, 1, 1), 0.5)
    )
    (bright,) = waves(1)
    expected = run(open_session(model), bright)
    patches = without_references(patches_of([np.float32(0.1) * image for image in waves()]))
    errors = []
    for brightens in (True, False):
        result = run(open_session(quickly(model, patches, brightens=brightens).host), bright)
        errors.append(np.abs(result - expected).max())
    assert 10 * errors[0] < errors[1]
