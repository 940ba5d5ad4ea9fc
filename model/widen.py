"""A wider network that computes what a narrower one does: training goes on instead of starting again.

Every feature is copied, and what reads it divides its weight among the copies in random shares (Net2WiderNet: Chen,
Goodfellow and Shlens, ICLR 2016, section 2.3). The shares differ for every reader, so the copies part at once.
"""

import torch
from torch import Tensor, nn

from model.conditioning import ToldConvBEERS
from model.convbeers import ConvBEERS, Variant
from profiles.errors import ModelError


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


def widen_told(network: ToldConvBEERS, variant: Variant, generator: torch.Generator) -> ToldConvBEERS:
    """As `widen`: base and directions are widened, and the convolutions' coefficients stay.

    Raises:
        ModelError: see `widen`.
    """
    wide = ToldConvBEERS(variant)
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
