"""The simulator on real images; skipped where there are none beside the repository."""

from pathlib import Path

import numpy as np
import pytest

from beers_deploy.model.io.images import list_images
from beers_deploy.model.metrics.fidelity import psnr_db
from beers_deploy.model.simulator.acquire import Pair, simulate_pair
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.sampling import Scene, read_scene
from beers_deploy.profiles import load_sensor
from tests.model.simulator.stages import pixel_means

DEGRADED, REFERENCE = (load_sensor(name).nominal() for name in ("pleiades-degraded", "pleiades-reference"))
FOLDERS = ["aerial-test", "pleiades"]


def first_scene(folder: Path) -> Scene:
    """The first image, a corner of at most 700 x 610 pixels."""
    scene = read_scene(list_images(folder)[0], REFERENCE)
    return Scene(scene.name, scene.radiance[:700, :610])


def pair_of(scene: Scene) -> Pair:
    return simulate_pair(scene.radiance, DEGRADED, REFERENCE, 3, Draw(0), margin_px=16)


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_real_scene_is_radiance_of_a_day(folder: str, shared_data: Path) -> None:
    radiance = first_scene(shared_data / folder).radiance
    assert radiance.dtype == np.float32
    assert 0 <= float(radiance.min()) < float(radiance.max()) <= 400.001
    assert 5 < float(radiance.mean()) < 300


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_real_pair_is_whole_numbers_of_the_same_ground(folder: str, shared_data: Path) -> None:
    scene = first_scene(shared_data / folder)
    pair = pair_of(scene)
    for image in (pair.degraded, pair.reference):
        assert np.array_equal(image, np.rint(image))
        assert 0 <= float(image.min()) <= float(image.max()) <= 4095
    ground = pixel_means(scene.radiance, 3)[16:-16, 16:-16] * 10.2375
    for image in (pair.degraded, pair.reference):
        assert float(image.mean()) == pytest.approx(float(ground.mean()), rel=0.02)
    closeness = [psnr_db(image, ground, 4095) for image in (pair.degraded, pair.reference)]
    assert closeness[0] + 3 < closeness[1]


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_blur_takes_detail_from_a_real_scene(folder: str, shared_data: Path) -> None:
    """Contrast between neighbours falls; the negative control is the pair of one sensor with itself."""
    pair = pair_of(first_scene(shared_data / folder))
    detail = [float(np.diff(image, axis=1).std()) for image in (pair.degraded, pair.reference)]
    assert detail[0] < 0.8 * detail[1]
    scene = first_scene(shared_data / folder).radiance
    same = simulate_pair(scene, REFERENCE, REFERENCE, 3, Draw(0), margin_px=16)
    again = [float(np.diff(image, axis=1).std()) for image in (same.degraded, same.reference)]
    assert again[0] == pytest.approx(again[1], rel=0.02)
