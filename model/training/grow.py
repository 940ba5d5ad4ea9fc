"""Start a network from a smaller one that computes the same image."""

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from beers_deploy.model.bank import in_places
from beers_deploy.model.convbeers import BankedConvBEERS, TrainableNetwork, initialise
from beers_deploy.model.variants import Variant
from beers_deploy.profiles.errors import ModelError

N = TypeVar("N", bound=TrainableNetwork)


def grow(network: N, variant: Variant, generator: torch.Generator) -> N:
    """Build a network of `variant` with the outputs of `network`, up to rounding.

    A network of the same size is copied. Features are duplicated, and their weights are divided
    among the copies (Net2Net, Chen et al. 2016). Added blocks are distributed evenly between the
    others. Their second convolution is zero, so that each initially passes on its input. At a
    larger scale each feature becomes one for each pixel of a place.

    Args:
        network: the smaller network.
        variant: the size of the new one.
        generator: the generator of the shares by which weights are divided.
    """
    sources = _sources(network.variant, variant)
    large = type(network)(variant)
    initialise(large, generator)
    weights = large.state_dict()
    small = network.state_dict()
    factor = variant.scale // network.variant.scale
    places = factor**2
    for name, source in sources.items():
        weight = weights[f"{name}.weight"]
        bias = weights[f"{name}.bias"]
        if source is not None:
            # S x S places become channels: (O, I, 3, 3) is (O S^2, I S^2, 3, 3).
            fine = small[f"{source}.weight"]
            outputs, inputs = fine.shape[:2]
            kernels = in_places(fine.flatten(0, 1).double().numpy(), factor)
            by_feature = torch.from_numpy(kernels).to(fine)
            by_feature = by_feature.view(outputs, inputs, places, places, 3, 3).transpose(1, 2)
            coarse = by_feature.reshape(outputs * places, inputs * places, 3, 3)
            weight.copy_(_widened(coarse, weight.shape, generator))
            bias.copy_(_repeated(small[f"{source}.bias"], bias.shape, places))
        elif name.endswith("second"):
            # An added block passes on its input until it has learnt something.
            weight.zero_()
    # The head's bias is linear in the sensor vector, so that its weights grow with the features.
    if isinstance(large, BankedConvBEERS):
        large.bias.weight.data.copy_(
            _repeated(small["bias.weight"], large.bias.weight.shape, places)
        )
    return large


def _sources(small: Variant, large: Variant) -> dict[str, str | None]:
    """Map each convolution of the large network to the one of the small network that initialises
    it.

    An added convolution has the source None. Raises ModelError if the small network cannot grow to
    the large one.
    """
    factor = large.scale // small.scale
    fits = small.scale in (1, large.scale) and large.features % (small.features * factor**2) == 0
    if large.blocks < small.blocks or not fits:
        raise ModelError(
            f"The weights to start from must have at most {large.blocks} blocks, and features that "
            f"divide {large.features} at scale {large.scale}, but they have {small.blocks} blocks "
            f"of {small.features} features at scale {small.scale}. Start from a smaller network."
        )
    places = [block * large.blocks // small.blocks for block in range(small.blocks)]
    origins = {f"body.{place}.": f"body.{block}." for block, place in enumerate(places)}
    sources: dict[str, str | None] = {}
    for name in large.convolutions:
        stem, _, layer = name.rpartition(".")
        prefix = origins.get(f"{stem}.")
        sources[name] = name if not stem else prefix and prefix + layer
    return sources


def _repeated(rows: Tensor, shape: Sequence[int], places: int) -> Tensor:
    """Repeat rows of the features, (F, ...), to the number of features of the large network."""
    coarse = rows.repeat_interleave(places, 0)
    return coarse.repeat(shape[0] // len(coarse), *[1] * (rows.ndim - 1))


def _widened(weight: Tensor, channels: Sequence[int], generator: torch.Generator) -> Tensor:
    """Widen weights (O, I, kh, kw) to `channels` by duplication.

    The weights of an input are divided among its copies at random.
    """
    copies_out = channels[0] // weight.shape[0]
    copies_in = channels[1] // weight.shape[1]
    shares = torch.rand(channels[0], copies_in, weight.shape[1], 1, 1, generator=generator) + 0.5
    shares = shares / shares.sum(1, keepdim=True)
    copies = weight.repeat(copies_out, 1, 1, 1).unsqueeze(1) * shares
    return copies.reshape(channels[0], channels[1], *weight.shape[2:])
