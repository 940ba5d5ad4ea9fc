"""Weights on disk: safetensors, with the variant and its recipe in the header."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from model.convbeers import VARIANTS, ConvBEERS, Variant
from model.files import whole_file
from model.shipped import SHIPPED as SHIPPED
from model.shipped import shipped_names as shipped_names
from model.shipped import shipped_weights as shipped_weights
from profiles.errors import ModelError, OptionError


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
            header = {key: json.loads(value) for key, value in (file.metadata() or {}).items()}
            return {key: file.get_tensor(key) for key in file.keys()}, header  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError, ValueError) as error:
        got = "no such file" if not path.exists() else str(error)
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
        shape = header["variant"]
        network = ConvBEERS(Variant(int(shape["blocks"]), int(shape["features"])))  # type: ignore[index]
        network.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
        got = " ".join(str(error).split())[:120]
        remedy = "give a file written by 'beers-deploy train'"
        raise ModelError(str(path), expected="the weights of a ConvBEERS", got=got, remedy=remedy) from error
    recipe = header.get("recipe", {})
    return network.eval(), recipe if isinstance(recipe, dict) else {}


def all_finite(tensors: Mapping[str, Tensor]) -> bool:
    """Whether every value of every tensor is finite."""
    return all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values())
