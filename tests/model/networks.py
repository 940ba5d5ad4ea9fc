"""Small networks with random weights, in evaluation mode."""

import torch

from beers_deploy.model.bank import bank_of_vector
from beers_deploy.model.convbeers import BankedConvBEERS, Condition, ConvBEERS, initialise
from beers_deploy.model.variants import Variant

SMALL = Variant(blocks=1, features=4)


def plain(variant: Variant = SMALL, seed: int = 0) -> ConvBEERS:
    network = ConvBEERS(variant)
    initialise(network, torch.Generator().manual_seed(seed))
    return network.eval()


def behind_a_bank(variant: Variant, spread: float) -> BankedConvBEERS:
    """Return a network behind a filter bank, with sensor biases of that standard deviation."""
    network = BankedConvBEERS(variant)
    generator = torch.Generator().manual_seed(0)
    initialise(network, generator)
    torch.nn.init.normal_(network.bias.weight, 0.0, spread, generator)
    return network.eval()


def condition_of(vectors: torch.Tensor) -> Condition:
    """Return the condition of a batch for the sensor vectors (N, 4)."""
    return Condition.of(vectors, [bank_of_vector(tuple(vector.tolist())) for vector in vectors])


def radius_px(variant: Variant) -> int:
    """Return the receptive radius: one place a convolution (head, two a block, body end, tail)."""
    return variant.scale * (2 * variant.blocks + 3)
