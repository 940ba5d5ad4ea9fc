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


@pytest.mark.parametrize("cycles_per_px", [0.1, 0.25, 0.4])
@pytest.mark.parametrize("mtf_nyquist", [0.03, 0.07, 0.25])
def test_a_sine_keeps_the_contrast_that_the_mtf_says(
    cycles_per_px: float, mtf_nyquist: float
) -> None:
    ratio = 4
    pixels = 40
    x = (np.arange(pixels * ratio) + 0.5) / ratio
    wave = 1000 + 500 * np.cos(2 * math.pi * cycles_per_px * x)
    radiance = np.tile(wave.astype(np.float32), (pixels * ratio, 1))
    sensor = Instrument(mtf_nyquist, 0.0, 0.0, 10.0, 16)
    dn = acquire(prepare_scene(radiance, ratio), sensor, Draw(0), margin_px=0)
    line = dn.mean(0, np.float64) / 10
    bin_ = round(cycles_per_px * pixels)
    contrast = 2 * abs(np.fft.rfft(line)[bin_]) / pixels / 500
    gamma = -2 * math.log(mtf_nyquist * math.pi / 2)
    expected = (
        math.exp(-gamma * cycles_per_px)
        * math.sin(math.pi * cycles_per_px)
        / (math.pi * cycles_per_px)
    )
    assert contrast == pytest.approx(expected, abs=1e-3)


def steepest_fall(ratio: int, mtf_nyquist: float) -> float:
    """Return the largest fall between neighbours, in DN, across an upward step of 1500 DN."""
    side = 96 * ratio
    step = np.full((side, side), 50.0, np.float32)
    step[:, side // 2 :] = 200.0
    sensor = Instrument(mtf_nyquist, 0.0, 0.0, 10.0, 16)
    line = acquire(prepare_scene(step, ratio), sensor, Draw(0), margin_px=16)[0]
    return float(-np.diff(line).min())


@pytest.mark.parametrize("mtf_nyquist", [0.03, 0.07, 0.25])
@pytest.mark.parametrize("ratio", [1, 2, 3, 5])
def test_a_step_rises_without_ringing(ratio: int, mtf_nyquist: float) -> None:
    # A fall of one digital number comes from rounding alone.
    assert steepest_fall(ratio, mtf_nyquist) <= 1


def test_a_step_would_ring_where_the_scene_is_no_finer_than_the_sensor() -> None:
    assert steepest_fall(1, 0.6) > 10


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
