import math

import numpy as np
import pytest

from beers_deploy.model.simulator.acquire import (
    MARGIN_PX,
    acquire,
    acquire_padded,
    prepare_scene,
    simulate_pair,
)
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.instrument import Instrument
from tests.model.simulator.stages import NOMINAL, REFERENCE

QUIET = Instrument(0.07, alpha=0.0, beta=0.0, gain_dn_per_radiance=10.0, bits=16)


def test_the_two_noises_of_a_pair_are_independent() -> None:
    pair = simulate_pair(np.full((900, 960), 80.0, np.float32), NOMINAL, REFERENCE, 5, Draw(0))
    noise = [image.ravel() - image.mean() for image in (pair.degraded, pair.reference)]
    assert abs(np.corrcoef(noise[0], noise[1])[0, 1]) < 0.03


def test_the_margin_keeps_the_wrapped_border_out() -> None:
    """A bright strip at the left edge wraps to the right edge, where the margin must remove it."""
    dark, strip = (np.full((600, 600), 50.0, np.float32) for _ in range(2))
    strip[:, :5] = 400.0

    def leak(margin_px: int) -> float:
        scenes = (prepare_scene(scene, 5) for scene in (dark, strip))
        images = (acquire(scene, QUIET, Draw(0), margin_px=margin_px) for scene in scenes)
        before, after = (image[:, -1].mean() for image in images)
        return abs(float(after - before))

    assert leak(MARGIN_PX) < 5
    assert leak(0) > 100


def test_a_scene_within_its_margin_is_refused() -> None:
    scene = np.full((335, 471), 80.0, np.float32)
    pair = simulate_pair(scene, NOMINAL, REFERENCE, 5, Draw(0))
    assert pair.degraded.shape == pair.reference.shape == (67 - 64, 94 - 64)
    with pytest.raises(ImageError, match="64 target pixels"):
        simulate_pair(scene[:324], NOMINAL, REFERENCE, 5, Draw(0))


@pytest.mark.parametrize(("height", "width"), [(96, 96), (95, 100), (5, 7)])
def test_a_padded_acquisition_covers_the_whole_scene(height: int, width: int) -> None:
    dn = acquire_padded(np.full((height, width), 80.0, np.float32), QUIET, 3, Draw(0), "degraded")
    assert dn.shape == (math.ceil(height / 3), math.ceil(width / 3))
    np.testing.assert_allclose(dn, 800.0, rtol=0, atol=1)


def test_padding_shifts_nothing() -> None:
    """Inside a margin of real scene, padded and cropped acquisitions differ by the mirror alone."""
    radiance = procedural_scene(600, 600, np.random.default_rng(3)).radiance
    padded = acquire_padded(radiance, QUIET, 3, Draw(0), "degraded")
    cropped = acquire(prepare_scene(radiance, 3), QUIET, Draw(0))
    inner = padded[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
    assert np.abs(inner - cropped).mean() < 2
    shifted = padded[MARGIN_PX:-MARGIN_PX, MARGIN_PX + 1 : 1 - MARGIN_PX or None]
    assert np.abs(shifted[:, :-1] - cropped[:, :-1]).mean() > 20


def test_drawn_scenes_are_physical_and_repeatable() -> None:
    scene, again, other = (
        procedural_scene(700, 913, np.random.default_rng(seed)).radiance for seed in (5, 5, 6)
    )
    assert scene.shape == (700, 913)
    assert scene.dtype == np.float32
    assert 0 < scene.min() < 20
    assert 200 < scene.max() < 1000
    assert np.array_equal(scene, again)
    assert not np.array_equal(scene, other)
