"""A larger network that begins where a smaller one stands: wider, deeper or coarser, with the same outputs."""

from collections.abc import Mapping
from itertools import product

import torch
from torch import Tensor

from model.conditioning import ConditionedConvBEERS, initialise_coefficients
from model.convbeers import ConvBEERS, initialise
from model.specialise import DIRECTIONS
from model.variants import Variant
from profiles.errors import ModelError

_LAST = "4"
"""Of the coefficients' layers, the linear one whose outputs they are, DIRECTIONS for each convolution."""


def grow(network: ConvBEERS, variant: Variant, generator: torch.Generator) -> ConvBEERS:
    """A network of `variant` with the outputs of `network`, up to rounding; the same size is copied.

    Features are copied, and their weights shared out among the copies (Net2Net, Chen et al. 2016). Added blocks lie
    evenly between the others; their second convolution is zero, so that each hands on what it is given until it has
    learnt something. At a larger scale each feature becomes one for each pixel of a place (see `_coarser`).

    Raises:
        ModelError: fewer blocks, a finer scale, or features that are no multiple.
    """
    sources = _sources(network.variant, variant)
    large = ConvBEERS(variant)
    initialise(large, generator)
    weights = large.state_dict()
    for name, source in sources.items():
        if source is None and name.endswith("second"):
            weights[f"{name}.weight"].zero_()
    large.load_state_dict(weights | _copied(network.state_dict(), sources, (network.variant, variant), generator))
    return large


def grow_conditioned(
    network: ConditionedConvBEERS, variant: Variant, generator: torch.Generator
) -> ConditionedConvBEERS:
    """As `grow`, for every sensor: added convolutions have coefficients of their own, whose directions are zero.

    Raises:
        ModelError: see `grow`.
    """
    sources = _sources(network.variant, variant)
    large = ConditionedConvBEERS(variant)
    initialise_coefficients(large, generator)
    large.base.load_state_dict(grow(network.base, variant, generator).state_dict())
    for old, new in zip(network.directions, large.directions, strict=True):
        copied = _copied(old.state_dict(), sources, (network.variant, variant), generator)
        new.load_state_dict(new.state_dict() | copied)  # an added one is zero, as drawn
    large.coefficients.load_state_dict(_coefficients(network, large, sources))
    return large


def _sources(small: Variant, large: Variant) -> dict[str, str | None]:
    """The convolution of the small network that each of the large one's is made from; None for an added one."""
    factor = large.scale // small.scale
    fits = small.scale in (1, large.scale) and large.features % (small.features * factor**2) == 0
    if large.blocks < small.blocks or not fits:
        expected = f"at most {large.blocks} blocks, of features that divide {large.features} at scale {large.scale}"
        got = f"{small.blocks} blocks of {small.features} features at scale {small.scale}"
        raise ModelError("weights to start from", expected=expected, got=got, remedy="start from a smaller network")
    places = [old * large.blocks // small.blocks for old in range(small.blocks)]
    kept = {f"body.{place}.": f"body.{old}." for old, place in enumerate(places)}
    found: dict[str, str | None] = {}
    for name in large.convolutions:
        stem, _, last = name.rpartition(".")
        prefix = kept.get(f"{stem}.")
        found[name] = name if not stem else prefix and prefix + last
    return found


def _copied(
    tensors: Mapping[str, Tensor],
    sources: Mapping[str, str | None],
    variants: tuple[Variant, Variant],
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """The weights and biases that come from the small network's `tensors`, by the large one's names."""
    found, (small, variant) = dict[str, Tensor](), variants
    factor = variant.scale // small.scale
    for name, source in sources.items():
        if source is not None:
            weight, channels = _coarser(tensors[f"{source}.weight"], factor), variant.convolutions[name]
            bias = tensors[f"{source}.bias"].repeat_interleave(factor**2)
            found[f"{name}.weight"] = _widened(weight, channels, generator)
            found[f"{name}.bias"] = bias.repeat(channels[0] // len(bias))
    return found


def _coarser(weight: Tensor, factor: int) -> Tensor:
    """(O, I, 3, 3) to (O S^2, I S^2, 3, 3): the same convolution where S x S places are the channels of one.

    Row i of a place reads row i + d of the same channels, d from -1 to 1: it lies in row (i + d) mod S of the place
    that is floor((i + d) / S) below. So for columns. The channels are ordered as a pixel unshuffle orders them.
    """
    outputs, inputs, steps = *weight.shape[:2], range(-1, 2)
    coarse = weight.new_zeros(outputs, factor, factor, inputs, factor, factor, 3, 3)
    for row, column, down, right in product(range(factor), range(factor), steps, steps):
        (place_y, y), (place_x, x) = divmod(row + down, factor), divmod(column + right, factor)
        coarse[:, row, column, :, y, x, place_y + 1, place_x + 1] = weight[:, :, down + 1, right + 1]
    return coarse.reshape(outputs * factor**2, inputs * factor**2, 3, 3)


def _widened(weight: Tensor, channels: tuple[int, int], generator: torch.Generator) -> Tensor:
    """(O, I, kh, kw) to `channels`: copies along both, divided among the copies of an input."""
    copies_out, copies_in = channels[0] // weight.shape[0], channels[1] // weight.shape[1]
    shares = torch.rand(channels[0], copies_in, weight.shape[1], 1, 1, generator=generator) + 0.5
    shares = shares / shares.sum(1, keepdim=True)
    spread = weight.repeat(copies_out, 1, 1, 1).unsqueeze(1) * shares
    return spread.reshape(*channels, *weight.shape[2:])


def _coefficients(
    small: ConditionedConvBEERS, large: ConditionedConvBEERS, sources: Mapping[str, str | None]
) -> dict[str, Tensor]:
    """What computes the coefficients: the small network's, with the large one's own rows for added convolutions."""
    found = dict(small.coefficients.state_dict())
    rows = {name: number for number, name in enumerate(small.variant.convolutions)}
    for part in ("weight", "bias"):
        key = f"{_LAST}.{part}"
        old = found[key].unflatten(0, (-1, DIRECTIONS))
        new = large.coefficients.state_dict()[key].unflatten(0, (-1, DIRECTIONS)).clone()
        for number, source in enumerate(sources.values()):
            if source is not None:
                new[number] = old[rows[source]]
        found[key] = new.flatten(0, 1)
    return found
