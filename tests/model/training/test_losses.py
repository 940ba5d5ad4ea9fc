"""Tests of the loss: its terms and their sum. `tests.stability` compares it with its formula."""

import math

import pytest
import torch
from torch import Tensor, nn

from beers_deploy.model.metrics.perceptual import Lpips
from beers_deploy.model.training.losses import PAPER, LossWeights, RestorationLoss, log_mse


def images(side: int = 33) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    reference = torch.rand(2, 1, side, side + 4, generator=generator)
    return reference + 0.01 * torch.randn(reference.shape, generator=generator), reference


class Distance(nn.Module):
    """A replacement for LPIPS in tests of the sum alone."""

    def forward(self, restored: Tensor, reference: Tensor) -> Tensor:
        return (restored - reference).square().mean((1, 2, 3))


def with_distance() -> Lpips:
    return Distance()  # type: ignore[return-value]


def test_the_terms_add_up() -> None:
    restored, reference = images()
    total, terms = RestorationLoss(PAPER, with_distance())(restored, reference)
    assert set(terms) == {"l1", "fft", "lpips"}
    expected = terms["l1"] + 0.1 * terms["fft"] + 0.5 * terms["lpips"]
    torch.testing.assert_close(total, expected)


def test_a_psnr_term_is_the_loss_of_psnr_and_weighs_all_patches_equally() -> None:
    """A tenth of the error on one of two patches gains 10 dB in the mean, for either patch."""
    generator = torch.Generator().manual_seed(0)
    reference = torch.rand(2, 1, 13, 17, generator=generator)
    errors = (
        0.05
        * torch.randn(2, 1, 13, 17, generator=generator)
        * torch.tensor([1.0, 0.3]).view(2, 1, 1, 1)
    )
    before = log_mse(reference + errors, reference)
    for patch in range(2):
        better = errors.clone()
        better[patch] *= 0.1
        gained_db = 10 / math.log(10) * float(before - log_mse(reference + better, reference))
        assert gained_db == pytest.approx(10, abs=0.15)
    assert float(log_mse(reference, reference)) == 0
    restored = (reference + errors).requires_grad_()
    total, terms = RestorationLoss(LossWeights(0, 0, 0, psnr=0.01))(restored, reference)
    assert set(terms) == {"l1", "psnr"}
    total.backward()  # type: ignore[no-untyped-call]
    assert restored.grad is not None
    assert bool(torch.isfinite(restored.grad).all())


def test_terms_without_weight_are_not_computed() -> None:
    restored, reference = images()
    total, terms = RestorationLoss(LossWeights(l1=2.0, lpips=0.0, fft=0.0), with_distance())(
        restored, reference
    )
    assert set(terms) == {"l1"}
    torch.testing.assert_close(total, 2 * terms["l1"])
    assert set(RestorationLoss(PAPER)(restored, reference)[1]) == {"l1", "fft"}


def test_autocast_does_not_reach_the_loss() -> None:
    restored, reference = images(64)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside, _ = RestorationLoss()(restored, reference)
    assert inside.dtype == torch.float32
    assert torch.equal(inside, RestorationLoss()(restored, reference)[0])
