"""Weights on disk: safetensors, with the variant and its recipe in the header."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from model.convbeers import VARIANTS, ConvBEERS, Variant
from model.files import whole_file
from profiles.errors import ModelError, OptionError
from profiles.text import parse_json


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
    """Write named tensors and a JSON header as safetensors, whole or not at all."""
    whole = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with whole_file(path) as temporary:
        save_file(whole, temporary, metadata={key: json.dumps(value) for key, value in header.items()})


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, object]]:
    """Read named tensors and the JSON header.

    Raises:
        ModelError: missing or not safetensors.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = {key: parse_json(value) for key, value in (file.metadata() or {}).items()}
            # Copies: the library's own lie in the file, which Windows then does not replace, and others may change.
            return {key: file.get_tensor(key).clone() for key in file.keys()}, header  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError, ValueError, LookupError, TypeError, RuntimeError) as error:
        got = "no such file" if not path.exists() else " ".join(str(error).split())[:120]
        remedy = "give a file written by 'beers-deploy train'"
        raise ModelError(str(path), expected="safetensors weights", got=got, remedy=remedy) from error


def save_network(path: Path, network: ConvBEERS, recipe: Mapping[str, object]) -> None:
    """Write a network's weights, its variant and the recipe that made them."""
    write_tensors(path, network.state_dict(), {"variant": asdict(network.variant), "recipe": dict(recipe)})


def load_network(path: Path) -> tuple[ConvBEERS, dict[str, object]]:
    """Read a network in evaluation mode, and its recipe.

    Raises:
        ModelError: not our weights, or weights of another shape.
    """
    tensors, header = read_tensors(path)
    try:
        shape: Any = header["variant"]
        variant = Variant(int(shape["blocks"]), int(shape["features"]))
        _check_variant(variant, tensors)
        network = ConvBEERS(variant)
        network.load_state_dict(tensors)
    except (AttributeError, LookupError, TypeError, ValueError, OverflowError, RuntimeError) as error:
        got = " ".join(str(error).split())[:120]
        remedy = "give a file written by 'beers-deploy train'"
        raise ModelError(str(path), expected="the weights of a ConvBEERS", got=got, remedy=remedy) from error
    recipe = header.get("recipe", {})
    return network.eval(), recipe if isinstance(recipe, dict) else {}


def _check_variant(variant: Variant, tensors: Mapping[str, Tensor]) -> None:
    """The tensors decide before a network is made: a header alone must not take memory.

    Raises:
        ValueError: other tensors than a network of that variant has, of another type, or not finite.
    """
    first = tensors["head.weight"]
    if len(tensors) != 4 * variant.blocks + 6 or len(first) != variant.features:
        raise ValueError(f"{len(tensors)} tensors, {len(first)} features at the head, for {variant}")
    if not all(tensor.dtype == torch.float32 for tensor in tensors.values()) or not all_finite(tensors):
        raise ValueError("weights that are not finite float32")


def all_finite(tensors: Mapping[str, Tensor]) -> bool:
    """Whether every value of every tensor is finite."""
    return all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values())
