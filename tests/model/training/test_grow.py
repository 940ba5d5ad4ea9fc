"""Tests that growing keeps the function of a network, and that the added parts can learn."""

import pytest
import torch

from beers_deploy.model.convbeers import BankedConvBEERS, ConvBEERS
from beers_deploy.model.training.grow import N, grow
from beers_deploy.model.variants import Variant
from beers_deploy.profiles.errors import ModelError
from tests.model.networks import condition_of, plain


def network(features: int) -> ConvBEERS:
    created = plain(Variant(blocks=2, features=features), seed=1)
    with torch.no_grad():
        for parameter in created.parameters():
            parameter.add_(
                0.05 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(2))
            )
    return created


LARGER = [Variant(2, 6), Variant(2, 18), Variant(3, 6), Variant(5, 12), Variant(4, 6)]
LARGER += [Variant(2, 24, 2), Variant(3, 48, 2), Variant(2, 54, 3)]
"""Some are coarser: at scale S a feature becomes S x S features."""


def image() -> torch.Tensor:
    return torch.rand(2, 1, 18, 24, generator=torch.Generator().manual_seed(4))


def grown(small: N, variant: Variant) -> N:
    return grow(small, variant, torch.Generator().manual_seed(3))


def test_added_blocks_lie_between_the_others_and_can_learn() -> None:
    large = grown(network(6), Variant(4, 6))
    large(image()).square().sum().backward()
    weights = dict(large.named_parameters())
    seconds = [weights[f"body.{block}.second.weight"] for block in range(4)]
    assert [bool(second.any()) for second in seconds] == [True, False, True, False]
    assert all(second.grad is not None and second.grad.any() for second in seconds)


def test_the_copies_of_a_feature_learn_different_things() -> None:
    wide = grown(network(6), Variant(2, 12))
    wide(image()).abs().sum().backward()
    gradient = wide.body[0].first.weight.grad  # type: ignore[union-attr]
    assert isinstance(gradient, torch.Tensor)
    assert (gradient[:6] - gradient[6:]).abs().max() > 1e-3 * gradient.abs().max()


@pytest.mark.parametrize("variant", LARGER)
def test_a_network_behind_a_bank_grows_for_every_sensor(variant: Variant) -> None:
    small = BankedConvBEERS(Variant(2, 6))
    for seed, parameter in enumerate(small.parameters()):
        torch.nn.init.normal_(parameter, 0.0, 0.1, torch.Generator().manual_seed(seed))
    vectors = torch.tensor([[-1.0, -0.5, 0.2, 0.9], [0.7, 0.7, -1.0, -0.6]])
    conditions = condition_of(vectors)
    torch.testing.assert_close(
        grown(small, variant)(image(), conditions), small(image(), conditions), atol=1e-5, rtol=1e-5
    )


def test_a_coarser_network_grows_from_one_of_its_own_scale() -> None:
    wider = grown(grown(network(6), Variant(2, 24, 2)), Variant(3, 48, 2))
    torch.testing.assert_close(wider(image()), network(6)(image()), atol=1e-5, rtol=1e-5)


def test_the_pixels_of_a_place_learn_different_things() -> None:
    """Otherwise a coarser network could learn no more than the finer one."""
    coarse = grown(network(6), Variant(2, 24, 2))
    coarse(image()).abs().sum().backward()
    weight = dict(coarse.named_parameters())["body.0.first.weight"]
    assert weight.grad is not None
    assert (weight == 0).any()
    assert weight.grad[weight == 0].any()


def test_a_network_that_does_not_fit_is_refused() -> None:
    for variant in (Variant(1, 12), Variant(2, 9), Variant(2, 3), Variant(2, 12, 2)):
        with pytest.raises(ModelError, match="features"):
            grown(network(6), variant)
    for variant in (Variant(2, 24), Variant(2, 96, 4)):
        with pytest.raises(ModelError, match="scale 2"):
            grown(grown(network(6), Variant(2, 24, 2)), variant)
