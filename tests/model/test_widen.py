"""Widening keeps the function and frees the copies."""

import pytest
import torch

from model.convbeers import ConvBEERS, Variant, initialise
from model.widen import widen
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


@pytest.mark.parametrize("variant", [Variant(3, 12), Variant(2, 9), Variant(2, 3)])
def test_a_network_that_does_not_fit_is_refused(variant: Variant) -> None:
    with pytest.raises(ModelError, match="features"):
        widen(network(6), variant, torch.Generator().manual_seed(3))
