"""Networks of torch from their files and into them, and a network's weights as the start of a wider one's."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from model.conditioning import ConditionedConvBEERS, Network
from model.convbeers import ConvBEERS, plain_network
from model.io.tensors import Weights, read_conditioned, read_plain, write_weights
from model.variants import Variant
from profiles.errors import ModelError

N = TypeVar("N", ConvBEERS, ConditionedConvBEERS)


def arrays(tensors: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Tensors of any shape as arrays."""
    return {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}


def save_network(path: Path, network: Network, recipe: Mapping[str, object]) -> None:
    """Write a network's weights, its variant and the recipe that made them."""
    weights = Weights(arrays(network.state_dict()), network.variant, dict(recipe))
    write_weights(path, weights, isinstance(network, ConditionedConvBEERS))


def load_network(path: Path) -> tuple[ConvBEERS, dict[str, object]]:
    """Read a network in evaluation mode, and its recipe.

    Raises:
        ModelError: not our weights, or weights of another shape.
    """
    found = read_plain(path)
    return plain_network(found.tensors, found.variant), found.recipe


def load_conditioned(path: Path) -> tuple[ConditionedConvBEERS, dict[str, object]]:
    """Read a network that is conditioned on its sensor, in evaluation mode, and its recipe.

    Raises:
        ModelError: not such weights, or of other ranges of sensors than this version's.
    """
    found = read_conditioned(path)
    network = ConditionedConvBEERS(found.variant)
    network.load_state_dict({name: torch.from_numpy(array) for name, array in found.tensors.items()})
    return network.eval(), found.recipe


def widen(network: ConvBEERS, variant: Variant, generator: torch.Generator) -> ConvBEERS:
    """A network of `variant` with the outputs of `network`, up to rounding; the same size is copied.

    Raises:
        ModelError: other blocks, or features that are no multiple.
    """
    narrow = network.variant
    if variant.blocks != narrow.blocks or variant.features % narrow.features:
        expected = f"{variant.blocks} blocks and a divisor of {variant.features} features"
        got = f"{narrow.blocks} blocks of {narrow.features} features"
        remedy = "start from a network of as many blocks, or from none"
        raise ModelError("weights to start from", expected=expected, got=got, remedy=remedy)
    wide = ConvBEERS(variant)
    for old, new in zip(_convolutions(network), _convolutions(wide), strict=True):
        with torch.no_grad():
            new.weight.copy_(_widened(old.weight, (new.out_channels, new.in_channels), generator))
            assert old.bias is not None  # noqa: S101 - conv3x3 gives one
            assert new.bias is not None  # noqa: S101
            new.bias.copy_(old.bias.repeat(new.out_channels // old.out_channels))
    return wide


def widen_conditioned(
    network: ConditionedConvBEERS, variant: Variant, generator: torch.Generator
) -> ConditionedConvBEERS:
    """As `widen`: base and directions are widened, and the convolutions' coefficients stay.

    Raises:
        ModelError: see `widen`.
    """
    wide = ConditionedConvBEERS(variant)
    wide.base.load_state_dict(widen(network.base, variant, generator).state_dict())
    for old, new in zip(network.directions, wide.directions, strict=True):
        assert isinstance(old, ConvBEERS)  # noqa: S101 - ModuleList forgets it
        new.load_state_dict(widen(old, variant, generator).state_dict())
    wide.coefficients.load_state_dict(network.coefficients.state_dict())
    return wide


def _convolutions(network: ConvBEERS) -> list[nn.Conv2d]:
    return [module for module in network.modules() if isinstance(module, nn.Conv2d)]


def _widened(weight: Tensor, channels: tuple[int, int], generator: torch.Generator) -> Tensor:
    """(O, I, kh, kw) to `channels`: copies along both, divided among the copies of an input."""
    copies_out, copies_in = channels[0] // weight.shape[0], channels[1] // weight.shape[1]
    shares = torch.rand(channels[0], copies_in, weight.shape[1], 1, 1, generator=generator) + 0.5
    shares = shares / shares.sum(1, keepdim=True)
    spread = weight.repeat(copies_out, 1, 1, 1).unsqueeze(1) * shares
    return spread.reshape(*channels, *weight.shape[2:])
