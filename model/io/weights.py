"""Weights on disk: safetensors, with the variant and its recipe in the header."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from model.conditioning import DIRECTIONS, RANGES, Network, ToldConvBEERS
from model.convbeers import VARIANTS, ConvBEERS, Variant
from model.io.files import whole_file
from profiles.errors import ModelError, OptionError
from profiles.toml import parse_json, unreadable

TOLD = "told its sensor"
"""The kind of weights, in the header, that need a sensor before they are a network; plain ones state no kind."""

FAULTS = (AttributeError, LookupError, TypeError, ValueError, OverflowError, RuntimeError)
"""What reading a header or filling a network may raise on a file that is not ours."""

N = TypeVar("N", ConvBEERS, ToldConvBEERS)


def variant_named(name: str) -> Variant:
    """The variant of that name.

    Raises:
        OptionError: no such variant.
    """
    if name not in VARIANTS:
        raise OptionError(
            "variant", expected=f"one of {', '.join(VARIANTS)}", got=repr(name), remedy="choose one of them"
        )
    return VARIANTS[name]


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, object]) -> None:
    """Write named tensors of any shape and a JSON header as safetensors, whole or not at all."""
    whole = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with whole_file(path) as temporary:
        save_file(whole, temporary, metadata={key: json.dumps(value) for key, value in header.items()})


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, object]]:
    """Read the named tensors, of any shape, and the JSON header of a safetensors file.

    Raises:
        ModelError: missing or not safetensors.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = {key: parse_json(value) for key, value in (file.metadata() or {}).items()}
            # Copies: the library's own lie in the file, which Windows then does not replace, and others may change.
            return {key: file.get_tensor(key).clone() for key in file.keys()}, header  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError, ValueError, LookupError, TypeError, RuntimeError) as error:
        got = unreadable(path) or " ".join(str(error).split())[:120]
        remedy = "give a file written by 'beers-deploy train'"
        raise ModelError(str(path), expected="safetensors weights", got=got, remedy=remedy) from error


def save_network(path: Path, network: Network, recipe: Mapping[str, object]) -> None:
    """Write a network's weights, its variant and the recipe that made them; the ranges of what it can be told."""
    header: dict[str, object] = {"variant": asdict(network.variant), "recipe": dict(recipe)}
    if isinstance(network, ToldConvBEERS):
        header |= {"kind": TOLD, "ranges": dict(RANGES)}
    write_tensors(path, network.state_dict(), header)


def load_network(path: Path) -> tuple[ConvBEERS, dict[str, object]]:
    """Read a network in evaluation mode, and its recipe.

    Raises:
        ModelError: not our weights, or weights of another shape.
    """
    tensors, header = read_tensors(path)
    if header.get("kind") == TOLD:
        remedy = "name the sensor: beers-deploy export --checkpoint FILE --sensor NAME"
        raise ModelError(
            str(path), expected="the weights of a plain network", got="one that is told its sensor", remedy=remedy
        )
    try:
        network = _filled(ConvBEERS, "", 1, tensors, header)
    except FAULTS as error:
        raise _not_weights(path, "the weights of a ConvBEERS", error) from error
    return network, _recipe(header)


def load_told(path: Path) -> tuple[ToldConvBEERS, dict[str, object]]:
    """Read a network that is told its sensor, in evaluation mode, and its recipe.

    Raises:
        ModelError: not such weights, or of other ranges than this version tells in.
    """
    tensors, header = read_tensors(path)
    try:
        if header.get("kind") != TOLD:
            raise ValueError("a network that cannot be told its sensor")
        if header.get("ranges") != {name: list(ends) for name, ends in RANGES.items()}:
            raise ValueError("other ranges of sensors than this version's")
        network = _filled(ToldConvBEERS, "base.", 1 + DIRECTIONS, tensors, header)
    except FAULTS as error:
        raise _not_weights(path, "weights that 'train --told' wrote", error) from error
    return network, _recipe(header)


def is_told(path: Path) -> bool:
    """Whether a weights file holds a network that is told its sensor.

    Raises:
        ModelError: missing or not safetensors.
    """
    return read_tensors(path)[1].get("kind") == TOLD


def _not_weights(path: Path, expected: str, error: Exception) -> ModelError:
    got = " ".join(str(error).split())[:120]
    return ModelError(str(path), expected=expected, got=got, remedy="give a file written by 'beers-deploy train'")


def _recipe(header: Mapping[str, object]) -> dict[str, object]:
    recipe = header.get("recipe", {})
    return recipe if isinstance(recipe, dict) else {}


def _filled(kind: type[N], prefix: str, copies: int, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> N:
    """A network of that kind, which holds `copies` sets of a ConvBEERS's weights, in evaluation mode."""
    shape = header["variant"]
    variant = Variant(int(shape["blocks"]), int(shape["features"]))
    _check_variant(variant, tensors, prefix, copies)
    network = kind(variant)
    network.load_state_dict(dict(tensors))
    return network.eval()


def _check_variant(variant: Variant, tensors: Mapping[str, Tensor], prefix: str, copies: int) -> None:
    """The tensors decide before a network is made: a header alone must not take memory.

    Raises:
        ValueError: other tensors than a network of that variant has, of another type, or not finite.
    """
    first = tensors[f"{prefix}head.weight"]
    others = sum(name.startswith("coefficients.") for name in tensors)
    if len(tensors) - others != copies * (4 * variant.blocks + 6) or len(first) != variant.features:
        raise ValueError(f"{len(tensors)} tensors, {len(first)} features at the head, for {variant}")
    if not all(tensor.dtype == torch.float32 for tensor in tensors.values()) or not all_finite(tensors):
        raise ValueError("weights that are not finite float32")


def all_finite(tensors: Mapping[str, Tensor]) -> bool:
    """Whether every value of every tensor, of any shape, is finite."""
    return all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values())


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
