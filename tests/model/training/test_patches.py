"""Tests of patches that are simulated during training, and of patches from pairs on disk."""

import os
import subprocess
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from beers_deploy.model.exposure import HEADROOM, factors_for
from beers_deploy.model.family import RANGES, SensorFamily, noise_over_full_scale
from beers_deploy.model.raster.writer import write_tiff
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.model.training.looks import Looks
from beers_deploy.model.training.patches import draw_turn, pair_files, turn
from beers_deploy.model.training.source import Batch, PatchSource, StoredPairs, cut
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import MtfTable
from beers_deploy.profiles.sensor import Sensor
from tests.model.simulator.stages import NOMINAL, point_spread, with_response
from tests.model.training.sources import small_scene, source
from tests.project_files import ROOT

PROFILE = Sensor.load("pleiades-degraded")


def test_the_same_seed_gives_the_same_batches_from_anywhere() -> None:
    straight = source().batches()
    later = source().batches(first=18)
    batches = [next(straight) for _ in range(20)]
    for batch in batches[18:]:
        assert equal(batch, next(later))
    assert not equal(batches[0], next(source(seed=1).batches()))


def parts(batch: Batch) -> list[torch.Tensor]:
    return [batch.degraded, batch.reference, *(batch.condition or ())]


def equal(one: Batch, other: Batch) -> bool:
    return all(torch.equal(a, b) for a, b in zip(parts(one), parts(other), strict=True))


PATCHES = "from tests.model.training.sources import source; made = source().batches(); next(made)"


@pytest.mark.slow
def test_drawing_patches_keeps_the_number_of_threads() -> None:
    """Each case needs its own process, because torch sets a thread's number of threads once."""
    thread_counts = [threads_after(work) for work in ("pass", PATCHES)]
    assert thread_counts[0] == thread_counts[1]


def threads_after(work: str) -> str:
    code = f"import torch\n{work}\nprint(torch.get_num_threads())"
    # The suite's own processes have one thread, so a change of their number would not show there.
    two = {**os.environ, "OMP_NUM_THREADS": "2"}
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, cwd=ROOT, env=two, capture_output=True, text=True, check=True
    ).stdout


class OneSensor(SensorFamily):
    """A family of one sensor, sharp across the track and blurred along it."""

    def draw(self, _generator: np.random.Generator) -> Instrument:
        return replace(self.like, mtf_nyquist=0.15, mtf_nyquist_along=0.03, alpha=0.0, beta=0.0)


class Alike(SensorFamily):
    """A family of one sensor, which is `like`."""

    def draw(self, _generator: np.random.Generator) -> Instrument:
        return self.like


def steps(image: torch.Tensor) -> tuple[float, float]:
    """Return the mean difference of neighbours, along a row and down a column."""
    return float(image.diff(dim=-1).abs().mean()), float(image.diff(dim=-2).abs().mean())


def contrasts(degraded: torch.Tensor, reference: torch.Tensor) -> tuple[float, float]:
    """Return the shares of the contrast that a blur leaves across and along the track."""
    across, along = (a / b for a, b in zip(steps(degraded), steps(reference), strict=True))
    return across, along


NOISE = Scene("noise", 100 + 60 * np.random.default_rng(0).random((420, 480), np.float32))


def test_a_turned_patch_has_the_vector_and_the_bank_of_the_turned_sensor() -> None:
    """A patch is more blurred along the axis that is blurred in its vector and its bank."""
    recipe = replace(source().recipe, family=OneSensor(NOMINAL), oversamplings=(2,))
    ways = set()
    for batch in islice(PatchSource([NOISE], recipe, 3, 0).batches(), 30):
        assert batch.condition is not None
        samples = zip(
            batch.degraded,
            batch.reference,
            batch.condition.vectors,
            batch.condition.filters,
            strict=True,
        )
        for one, other, vector, filters in samples:
            across, along = contrasts(one, other)
            assert (across > along) == bool(vector[0] > vector[1])
            # The axis that lost more contrast is sharpened more.
            sharpened = steps(filters[-1])
            assert (across > along) == (sharpened[0] < sharpened[1])
            ways.add(across > along)
    assert ways == {True, False}


def test_conditioned_patches_have_vectors_of_many_sensors_and_repeat() -> None:
    first, repeated = ([*islice(source(conditioned=True).batches(k), 20 - k)] for k in (0, 17))
    vectors = torch.cat([batch.condition.vectors for batch in first if batch.condition is not None])
    assert vectors.shape == (60, 4)
    assert float(vectors.std(0).min()) > 0.3
    assert all(equal(one, two) for one, two in zip(first[17:], repeated, strict=True))


def test_dark_patches_are_brightened_as_in_a_restoration() -> None:
    """No patch could be brightened further, and the noise in its vector grows with the factor."""
    family = Alike(replace(NOMINAL, alpha=0.0, beta=(100 / 200) ** 2))
    looks = Looks(lit_share=1.0, calm_share=0.3, soft_share=0.3)
    recipe = replace(source().recipe, family=family, looks=looks)
    applied = set()
    for batch in islice(PatchSource([small_scene()], recipe, 3, 0).batches(), 40):
        assert batch.condition is not None
        for patch, vector in zip(batch.degraded, batch.condition.vectors, strict=True):
            low, high = RANGES["sigma_bright"]
            sigma = low * (high / low) ** ((float(vector[3]) + 1) / 2)
            factor = round(sigma / noise_over_full_scale(family.like))
            applied.add(factor)
            brightest = float(patch.max())
            for larger in factors_for(family.like):
                assert larger <= factor or brightest * larger / factor > HEADROOM
            assert factor == 1 or brightest <= HEADROOM
    assert len(applied) > 1


def test_patches_of_one_sensor_keep_its_axes() -> None:
    """Without a condition, patches are only turned by 180 degrees or mirrored."""
    across, along = (replace(PROFILE.mtf_nyquist, value=value) for value in (0.3, 0.03))
    anisotropic = replace(PROFILE, mtf_nyquist=across, mtf_nyquist_along=along)
    recipe = replace(source().recipe, degraded=anisotropic, oversamplings=(2,))
    for batch in islice(PatchSource([NOISE], recipe, 3, 0).batches(), 30):
        clearer, blurred = contrasts(batch.degraded, batch.reference)
        assert clearer > blurred


def test_a_lopsided_blur_is_neither_mirrored_nor_turned() -> None:
    generator = np.random.default_rng(0)
    ways = [
        draw_turn(generator, quarters, mirrors)
        for quarters, mirrors in ((True, True), (False, True))
    ]
    for _ in range(50):
        assert draw_turn(generator, True, mirrors=False) == (0, False)
        ways.append(draw_turn(generator, False))
    assert {quarter for quarter, _ in ways[2:]} == {0, 2}
    samples = np.zeros((9, 9))
    samples[3:6, 4:8] = 1
    table = MtfTable((0, 0.25, 0.5), (1, 0.5, 0.1), (1, 0.5, 0.1))
    lopsided = point_spread(samples, 4)
    assert NOMINAL.symmetry == (True, True)
    assert replace(NOMINAL, mtf_nyquist_along=0.05).symmetry == (True, False)
    for response, symmetry in (
        (table, (True, True)),
        (replace(table, along=(1, 0.4, 0.1)), (True, False)),
        (lopsided, (False, False)),
    ):
        assert with_response(NOMINAL, response).symmetry == symmetry


def test_patches_lie_within_full_scale_and_a_pair_shows_the_same_ground() -> None:
    degraded, reference, _ = next(source().batches())
    assert degraded.shape == reference.shape == (3, 1, 32, 32)
    for image in (degraded, reference):
        assert 0 <= float(image.min()) <= float(image.max()) <= 1
    for one, other in zip(degraded, reference, strict=True):
        assert np.corrcoef(one.ravel(), other.ravel())[0, 1] > 0.7


def test_scenes_too_small_for_a_patch_are_refused() -> None:
    with pytest.raises(ImageError, match="64 target pixels"):
        next(source(procedural_scene(120, 120, np.random.default_rng(0)), patch_px=64).batches())


def test_cut_takes_whole_patches_and_turn_keeps_pairs_together() -> None:
    image = torch.arange(2 * 30 * 41).reshape(2, 30, 41)
    rng = np.random.default_rng(0)
    patches = cut(image, 8, rng)
    assert patches.shape[1:] == (2, 8, 8)
    turned = turn(patches.numpy(), rng)
    assert (turned[:, 1] - turned[:, 0] == 30 * 41).all()


def test_two_workers_share_the_batches_of_one() -> None:
    """The workers take shards in turn, so together they read the batches of a single worker."""
    alone = source().batches()
    shards = [list(islice(alone, PatchSource.SHARD_BATCHES)) for _ in range(2)]
    for rank in range(2):
        own = source(rank=rank, workers=2).batches()
        assert all(equal(next(own), batch) for batch in shards[rank])


def write_pairs(folder: Path, *degraded: np.ndarray) -> StoredPairs:
    """Write pairs of these images, by default three of noise, with references twice as bright."""
    noise = (
        np.random.default_rng(k).integers(0, 2048, (41, 53)).astype(np.uint16) for k in range(3)
    )
    for k, image in enumerate(degraded or noise):
        write_tiff(folder / "degraded" / f"p{k}.tif", image)
        write_tiff(folder / "reference" / f"p{k}.tif", 2 * image)
    return StoredPairs(pair_files(folder), PROFILE, 24, batch=4, seed=0)


def test_stored_pairs_are_cut_alike_and_the_same_from_anywhere(tmp_path: Path) -> None:
    pairs = write_pairs(tmp_path)
    straight = pairs.batches()
    batches = [next(straight) for _ in range(4)]
    degraded, reference, _ = batches[3]
    assert degraded.shape == reference.shape == (4, 1, 24, 24)
    assert torch.equal((reference * 4095).round(), 2 * (degraded * 4095).round())
    assert equal(next(pairs.batches(first=3)), batches[3])
    assert not equal(batches[0], batches[3])


@pytest.mark.parametrize("quarters", [True, False])
def test_stored_pairs_of_two_different_axes_keep_them(quarters: bool, tmp_path: Path) -> None:
    """Rows of one brightness stay rows, unless patches may be turned by 90 degrees.

    They may not if the axes are drawn from two ranges, even from equal ones.
    """
    rows = np.repeat(np.arange(41, dtype=np.uint16)[:, None] * 45, 53, 1)
    sensor = PROFILE if quarters else replace(PROFILE, mtf_nyquist_along=PROFILE.mtf_nyquist)
    patches, *_ = next(replace(write_pairs(tmp_path, rows), batch=32, sensor=sensor).batches())
    flat = [bool((patch == patch[..., :1]).all()) for patch in patches]
    assert any(flat)
    assert all(flat) is not quarters


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        (np.full((41, 53), 5000, np.uint16), "has values from 5000 .* 0 to 4095"),
        (np.full((41, 53), 200, np.uint8), "8-bit pixels"),
        (np.full((41, 53), 0.4, np.float32), "floats of at most 0.4"),
        (np.full((41, 53), -9, np.float32), "Add the offset"),
    ],
)
def test_stored_pairs_of_another_scale_are_refused(
    pixels: np.ndarray, words: str, tmp_path: Path
) -> None:
    with pytest.raises(ImageError, match=words):
        next(write_pairs(tmp_path, pixels).batches())


def test_stored_pairs_too_small_or_incomplete_are_refused(tmp_path: Path) -> None:
    pairs = write_pairs(tmp_path)
    with pytest.raises(ImageError, match="42 pixels"):
        replace(pairs, patch_px=42)
    write_tiff(tmp_path / "degraded" / "p2.tif", np.ones((30, 53), np.uint16))
    with pytest.raises(ImageError, match=r"p2.tif .* 53 x 30 pixels and 53 x 41 pixels"):
        replace(pairs, seed=1)
    (tmp_path / "degraded" / "p1.tif").unlink()
    with pytest.raises(ImageError, match="'p1' in only one"):
        pair_files(tmp_path)
