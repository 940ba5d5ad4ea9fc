"""The simulator on real images; skipped where there are none beside the repository."""

from pathlib import Path

import numpy as np
import pytest

from beers_deploy.model.io.images import list_images
from beers_deploy.model.metrics.fidelity import psnr_db
from beers_deploy.model.simulator.acquire import simulate_pair
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.sampling import read_scene
from beers_deploy.profiles import load_sensor
from tests.model.simulator.stages import pixel_means

DEGRADED, REFERENCE = (load_sensor(name).nominal() for name in ("pleiades-degraded", "pleiades-reference"))


@pytest.fixture(params=["aerial-test", "pleiades"])
def radiance(request: pytest.FixtureRequest, shared_data: Path) -> np.ndarray:
    """A corner of at most 700 x 610 pixels of a folder's first image."""
    return read_scene(list_images(shared_data / request.param)[0], REFERENCE).radiance[:700, :610]


def test_a_real_scene_is_radiance_of_a_day(radiance: np.ndarray) -> None:
    assert radiance.dtype == np.float32
    assert 0 <= float(radiance.min()) < float(radiance.max()) <= 400.001
    assert 5 < float(radiance.mean()) < 300


def test_a_real_pair_is_whole_numbers_of_the_same_ground(radiance: np.ndarray) -> None:
    pair = simulate_pair(radiance, DEGRADED, REFERENCE, 3, Draw(0), margin_px=16)
    ground = pixel_means(radiance, 3)[16:-16, 16:-16] * 10.2375
    for image in (pair.degraded, pair.reference):
        assert np.array_equal(image, np.rint(image))
        assert 0 <= float(image.min()) <= float(image.max()) <= 4095
        assert float(image.mean()) == pytest.approx(float(ground.mean()), rel=0.02)
    closeness = [psnr_db(image, ground, 4095) for image in (pair.degraded, pair.reference)]
    assert closeness[0] + 3 < closeness[1]


def test_the_blur_takes_detail_from_a_real_scene(radiance: np.ndarray) -> None:
    """Contrast between neighbours falls; the negative control is the pair of one sensor with itself."""
    detail = []
    for sensor in (DEGRADED, REFERENCE):
        pair = simulate_pair(radiance, sensor, REFERENCE, 3, Draw(0), margin_px=16)
        detail.append(float(np.diff(pair.degraded, axis=1).std() / np.diff(pair.reference, axis=1).std()))
    assert detail[0] < 0.8
    assert detail[1] == pytest.approx(1, rel=0.02)
