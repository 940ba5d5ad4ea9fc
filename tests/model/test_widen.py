"""Widening keeps the function and frees the copies."""

import pytest
import torch

from model.conditioning import ConditionedConvBEERS, fold, initialise_coefficients
from model.convbeers import ConvBEERS, initialise
from model.io.weights import widen, widen_conditioned
from model.variants import Variant
from profiles.errors import ModelError


def network(features: int) -> ConvBEERS:
    made = ConvBEERS(Variant(blocks=2, features=features))
    initialise(made, torch.Generator().manual_seed(1))
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(2)))
    return made


@pytest.mark.parametrize("features", [6, 12, 18])
def test_the_wider_network_computes_the_same(features: int) -> None:
    narrow = network(6)
    wide = widen(narrow, Variant(2, features), torch.Generator().manual_seed(3))
    image = torch.rand(2, 1, 13, 17, generator=torch.Generator().manual_seed(4))
    torch.testing.assert_close(wide(image), narrow(image), atol=1e-5, rtol=1e-5)


def test_the_copies_of_a_feature_learn_different_things() -> None:
    wide = widen(network(6), Variant(2, 12), torch.Generator().manual_seed(3))
    image = torch.rand(2, 1, 13, 17, generator=torch.Generator().manual_seed(4))
    wide(image).abs().sum().backward()
    gradient = wide.body[0].first.weight.grad  # type: ignore[union-attr]
    assert isinstance(gradient, torch.Tensor)
    assert (gradient[:6] - gradient[6:]).abs().max() > 1e-3 * gradient.abs().max()


def test_a_told_network_is_wider_for_every_sensor() -> None:
    narrow = ConditionedConvBEERS(Variant(2, 6))
    narrow.base.load_state_dict(network(6).state_dict())
    initialise_coefficients(narrow, torch.Generator().manual_seed(5))
    for seed, direction in enumerate(narrow.directions):
        for parameter in direction.parameters():
            torch.nn.init.normal_(parameter, 0.0, 0.05, torch.Generator().manual_seed(seed))
    wide = widen_conditioned(narrow, Variant(2, 12), torch.Generator().manual_seed(3))
    image = torch.rand(1, 1, 13, 17, generator=torch.Generator().manual_seed(4))
    for vector in (torch.tensor([-1.0, -0.5, 0.2, 0.9]), torch.tensor([0.7, 0.7, -1.0, -0.6])):
        torch.testing.assert_close(fold(wide, vector)(image), fold(narrow, vector)(image), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("variant", [Variant(3, 12), Variant(2, 9), Variant(2, 3)])
def test_a_network_that_does_not_fit_is_refused(variant: Variant) -> None:
    with pytest.raises(ModelError, match="features"):
        widen(network(6), variant, torch.Generator().manual_seed(3))
