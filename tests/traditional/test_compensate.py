"""MTF compensation: gain 1 at DC, the target MTF without regularisation, finite whatever the blur."""

import numpy as np
import pytest
import torch

from model.simulator.mtf import transfer_function
from model.simulator.sampling import sample, scene_spectrum
from model.traditional.compensate import compensate, compensation_gain
from model.traditional.padding import mirror_pad
from profiles.errors import OptionError


def texture(height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(0).uniform(0, 4095, (height, width)).astype(np.float32))


@pytest.mark.parametrize("mtf_from", [1.001e-4, 1e-3, 0.03, 0.07, 0.25, 0.63])
@pytest.mark.parametrize("mtf_to", [1.001e-4, 0.25, 0.63])
@pytest.mark.parametrize("epsilon", [0.0, 3e-3])
def test_gain_is_one_at_dc_and_finite_everywhere(mtf_from: float, mtf_to: float, epsilon: float) -> None:
    gain = compensation_gain(26, 35, mtf_from, mtf_to, epsilon)
    assert float(gain[0, 0]) == 1
    assert bool(torch.isfinite(gain).all())
    assert bool((gain >= 0).all())


def test_without_regularisation_it_is_the_ratio_of_the_mtfs() -> None:
    gain = compensation_gain(26, 34, 0.07, 0.25, epsilon=0)
    assert float(gain[0, 17]) == pytest.approx(0.25 / 0.07)


def test_regularisation_holds_the_noise_of_a_weak_mtf_down() -> None:
    assert float(compensation_gain(26, 34, 0.03, 0.25, epsilon=0).max()) > 15
    assert float(compensation_gain(26, 34, 0.03, 0.25).max()) < 5


@pytest.mark.parametrize("value", [0.0, 1.0, 4095.0])
def test_a_constant_image_is_unchanged(value: float) -> None:
    image = torch.full((13, 21), value)
    torch.testing.assert_close(compensate(image, 0.07, 0.25), image, rtol=1e-6, atol=1e-6)


def test_the_mean_is_preserved() -> None:
    # 128 + 2 * 64 is a whole period of the mirrored image: its mean cannot change, and so neither can the crop's.
    image = texture(128, 128)
    assert float(compensate(image, 0.07, 0.25).double().mean() / image.double().mean()) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (61, 75)])
def test_any_shape_comes_back_finite(shape: tuple[int, int]) -> None:
    restored = compensate(texture(*shape), 1.001e-4, 0.63)
    assert restored.shape == shape
    assert bool(torch.isfinite(restored).all())


def test_it_carries_one_blur_into_the_other() -> None:
    yy, xx = np.mgrid[:261, :275]
    scene = torch.from_numpy(2000 + 1000 * np.sin(0.9 * xx + 0.4 * yy) * np.cos(0.07 * xx)).float()
    blurred, target = (sample(scene_spectrum(scene), transfer_function(261, 275, 1, m), 275, 1) for m in (0.07, 0.25))
    inside = slice(80, -80), slice(80, -80)
    before = (blurred - target)[inside].square().mean()
    after = (compensate(blurred, 0.07, 0.25, epsilon=0) - target)[inside].square().mean()
    wrong = (compensate(blurred, 0.07, 0.20, epsilon=0) - target)[inside].square().mean()
    assert float(after) < 1e-3 * float(before)
    assert float(wrong) > 10 * float(after)


@pytest.mark.parametrize("epsilon", [-1e-3, float("nan"), float("inf")])
def test_a_senseless_epsilon_is_refused(epsilon: float) -> None:
    with pytest.raises(OptionError, match="epsilon"):
        compensation_gain(8, 8, 0.07, 0.25, epsilon)


def test_mirror_repeats_the_edge_and_may_exceed_the_image() -> None:
    row = mirror_pad(torch.tensor([[1, 2, 3]]), 4, (0, 5))[0]
    assert row.tolist() == [3, 3, 2, 1, 1, 2, 3, 3, 2, 1, 1, 2]
