import math

import numpy as np
import pytest

from beers_deploy.model.simulator.sampling import resample


def wave(height: int, width: int, cycles: tuple[int, int]) -> np.ndarray:
    """A plane wave over the whole scene, sampled at pixel centres."""
    y, x = ((np.arange(n) + 0.5) / n for n in (height, width))
    phase = 2 * math.pi * (cycles[0] * y[:, None] + cycles[1] * x) + 0.7
    return (100 + 30 * np.cos(phase)).astype(np.float32)


@pytest.mark.parametrize(("height", "width"), [(48, 70), (75, 90), (31, 41), (60, 84)])
@pytest.mark.parametrize("cycles", [(0, 0), (3, 5), (11, 2), (0, 13)])
def test_a_wave_that_both_grids_hold_is_the_same_wave(height: int, width: int, cycles: tuple[int, int]) -> None:
    result = resample(wave(60, 84, cycles), height, width)
    np.testing.assert_allclose(result, wave(height, width, cycles), rtol=0, atol=1e-3, strict=True)


def test_what_the_new_grid_cannot_hold_is_cut_not_aliased() -> None:
    result = resample(wave(60, 84, (0, 30)), 40, 40)
    np.testing.assert_allclose(result, np.full((40, 40), 100.0, np.float32), rtol=0, atol=1e-3, strict=True)


def test_the_mean_is_kept() -> None:
    scene = 50 + 100 * np.random.default_rng(0).random((57, 83), np.float32)
    assert float(resample(scene, 91, 64).mean()) == pytest.approx(float(scene.mean()), rel=1e-6)
