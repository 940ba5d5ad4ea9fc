import math

import pytest
import torch

from beers_deploy.model.simulator.sampling import resample


def wave(height: int, width: int, cycles: tuple[int, int]) -> torch.Tensor:
    """A plane wave over the whole scene, sampled at pixel centres."""
    y, x = ((torch.arange(n, dtype=torch.float64) + 0.5) / n for n in (height, width))
    return (100 + 30 * torch.cos(2 * math.pi * (cycles[0] * y[:, None] + cycles[1] * x) + 0.7)).float()


@pytest.mark.parametrize(("height", "width"), [(48, 70), (75, 90), (31, 41), (60, 84)])
@pytest.mark.parametrize("cycles", [(0, 0), (3, 5), (11, 2), (0, 13)])
def test_a_wave_that_both_grids_hold_is_the_same_wave(height: int, width: int, cycles: tuple[int, int]) -> None:
    result = resample(wave(60, 84, cycles), height, width)
    torch.testing.assert_close(result, wave(height, width, cycles), rtol=0, atol=1e-3)


def test_what_the_new_grid_cannot_hold_is_cut_not_aliased() -> None:
    result = resample(wave(60, 84, (0, 30)), 40, 40)
    torch.testing.assert_close(result, torch.full((40, 40), 100.0), rtol=0, atol=1e-3)


def test_the_mean_is_kept() -> None:
    scene = 50 + 100 * torch.rand(57, 83, generator=torch.Generator().manual_seed(0))
    assert float(resample(scene, 91, 64).mean()) == pytest.approx(float(scene.mean()), rel=1e-6)
