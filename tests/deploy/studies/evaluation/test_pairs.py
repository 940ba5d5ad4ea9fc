"""Tests of the pairs of an evaluation: read from a folder, or simulated from scenes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beers_deploy.model.raster.writer import write_tiff
from beers_deploy.model.simulator.acquire import simulate_pair
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.pairs import Pair
from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.errors import ImageError
from beers_deploy.studies.evaluation.pairs import (
    numbered_pairs,
    oversampling_note,
    oversamplings_of,
    read_pairs,
    scenes_at,
    simulate_pairs,
)
from tests.deploy.studies.evaluation.small_pairs import (
    DEGRADED,
    REFERENCE,
    SENSORS,
    pair,
    write_pairs,
)


def test_pairs_are_read_back_from_a_folder(tmp_path: Path) -> None:
    pairs = [pair("a_1.tif", 1), pair("b_2.tif", 2)]
    read_back = read_pairs(write_pairs(tmp_path, pairs))
    assert [item.name for item in read_back] == ["a_1", "b_2"]
    for one, other in zip(read_back, pairs, strict=True):
        assert np.array_equal(one.degraded, other.degraded)
        assert np.array_equal(one.reference, other.reference)


def test_a_pair_without_a_partner_or_of_two_sizes_is_refused(tmp_path: Path) -> None:
    write_pairs(tmp_path, [pair("a.tif"), pair("b.tif")])
    write_tiff(tmp_path / "reference" / "b.tif", np.ones((9, 9), np.uint16))
    with pytest.raises(ImageError, match=r"45 x 37 and 9 x 9"):
        read_pairs(tmp_path)


def test_a_pair_in_memory_with_pixels_that_are_not_finite_is_refused() -> None:
    """Its scores would be NaN, which a table shows as that of equal images."""
    degraded, reference, clean = np.zeros((3, 8, 8))
    given = Pair(degraded, reference, clean, SENSORS[0], (DEGRADED, REFERENCE))
    assert [each.name for each in numbered_pairs([given, given])] == ["pair0", "pair1"]
    given.reference[0, 0] = np.nan
    with pytest.raises(ImageError, match="Pair 0 of `pairs` has pixels that are NaN"):
        numbered_pairs([given])


def test_scenes_too_small_are_named_and_all_too_small_is_refused() -> None:
    large, small = (procedural_scene(side, side, np.random.default_rng(0)) for side in (400, 200))
    pairs, left_out = simulate_pairs([large, replace(small, name="small")], DEGRADED, REFERENCE, 0)
    assert len(pairs) == 1
    assert left_out == ["small"]
    assert pairs[0].degraded.shape == pairs[0].reference.shape
    with pytest.raises(ImageError, match="224 pixels"):
        simulate_pairs([small], DEGRADED, REFERENCE, 0)


@pytest.mark.parametrize(
    ("own", "sides", "words"),
    [
        (2, (300, 700), ""),
        (4, (700, 700), ""),
        (4, (300, 700), "pixel: 2 and 4, where pleiades-degraded states 4"),
        (5, (700, 700), "pixel: 4, where pleiades-degraded states 5; at most 4 are taken"),
    ],
)
def test_another_oversampling_than_the_profiles_is_noted(
    own: int, sides: tuple[int, int], words: str
) -> None:
    profile = replace(DEGRADED, oversampling=Constant(own, "stated", "a test"))
    scenes = [procedural_scene(side, side, np.random.default_rng(0)) for side in sides]
    pairs, _ = simulate_pairs(scenes, profile, REFERENCE, 0, oversamplings_of(profile))
    note = oversampling_note(pairs, profile)
    assert words in note
    assert bool(words) == bool(note)


def test_the_reference_without_noise_is_the_same_acquisition_otherwise() -> None:
    """The references differ by the sensor's noise and rounding. The pair itself is unchanged."""
    scene = procedural_scene(700, 760, np.random.default_rng(3))
    (one,), _ = simulate_pairs([scene], DEGRADED, REFERENCE, 7)
    expected = simulate_pair(scene.radiance, *SENSORS, 4, Draw(7))
    assert np.array_equal(one.degraded, expected.degraded)
    assert np.array_equal(one.reference, expected.reference)
    assert one.noise_free is not None
    noise = one.reference - one.noise_free
    sensor = SENSORS[1]
    light = np.clip(one.noise_free / sensor.gain_dn_per_radiance, 0, None)
    # Rounding to integers adds a variance of 1/12.
    variance = (sensor.alpha * light + sensor.beta) * sensor.gain_dn_per_radiance**2 + 1 / 12
    unclipped = one.reference < sensor.max_dn
    assert float((noise**2 / variance)[unclipped].mean()) == pytest.approx(1, abs=0.05)
    assert abs(float(noise[unclipped].mean())) < 3 * float(np.sqrt(variance.mean() / noise.size))
    (dim,), _ = simulate_pairs(scenes_at(0.25, [scene]), DEGRADED, REFERENCE, 7)
    assert dim.noise_free is not None
    ratio = float((dim.reference - dim.noise_free).std() / noise.std())
    assert 1 / 4 < ratio < 1, "the light is scaled, and the noise is not"
