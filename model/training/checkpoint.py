"""A run on disk: safetensors, with all that an exact resume needs; nothing is unpickled."""

from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from model.convbeers import ConvBEERS
from model.training.guards import Guards
from model.training.recipe import TrainingRecipe
from model.weights_file import all_finite, load_network, read_tensors, save_network, write_tensors
from profiles.errors import ModelError


def write_checkpoint(
    path: Path,
    network: ConvBEERS,
    average: dict[str, Tensor],
    optimiser: torch.optim.Optimizer,
    recipe: TrainingRecipe,
    step: int,
    guards: Guards,
) -> None:
    """Write weights, their running average, the optimiser's moments, the step and the guards."""
    tensors = {f"network.{k}": v for k, v in network.state_dict().items()}
    tensors |= {f"average.{k}": v for k, v in average.items()}
    for name, parameter in network.named_parameters():
        for moment, value in optimiser.state.get(parameter, {}).items():
            tensors[f"moment.{name}.{moment}"] = value
    write_tensors(path, tensors, {"step": step, "guards": guards.to_json(), "recipe": asdict(recipe)})


def read_checkpoint(
    path: Path,
    network: ConvBEERS,
    average: dict[str, Tensor],
    optimiser: torch.optim.Optimizer,
    recipe: TrainingRecipe,
) -> tuple[int, Guards]:
    """Fill network, average and optimiser from a checkpoint; the step it stands at, and its guards.

    Raises:
        ModelError: not a checkpoint, or one of another recipe or network.
    """
    tensors, header = read_tensors(path)
    if header.get("recipe") != asdict(recipe):
        remedy = "repeat its options, or choose another --out"
        raise ModelError(str(path), expected=f"a checkpoint of {recipe}", got="another recipe", remedy=remedy)
    try:
        network.load_state_dict(_part(tensors, "network."))
        guards = Guards.from_json(header["guards"])  # type: ignore[arg-type]
        step = int(str(header["step"]))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        got = " ".join(str(error).split())[:120]
        remedy = "choose the variant it was begun with"
        raise ModelError(str(path), expected="a checkpoint of this network", got=got, remedy=remedy) from error
    for name, value in _part(tensors, "average.").items():
        average[name].copy_(value)
    for name, parameter in network.named_parameters():
        moments = _part(tensors, f"moment.{name}.")
        optimiser.state[parameter] = {k: _placed(k, v, parameter) for k, v in moments.items()}
    return step, guards


def finish(network: ConvBEERS, path: Path, recipe: dict[str, object]) -> ConvBEERS:
    """Write a network with the recipe that made it, and read it back.

    Raises:
        ModelError: a weight is not finite.
    """
    if not all_finite(network.state_dict()):
        remedy = "lower the learning rate"
        raise ModelError(str(path), expected="finite weights", got="NaN or infinity", remedy=remedy)
    save_network(path, network, recipe)
    return load_network(path)[0]


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _placed(moment: str, value: Tensor, parameter: Tensor) -> Tensor:
    """Adam keeps its step count on the CPU and its moments with (and laid out as) the parameter."""
    return value if moment == "step" else torch.empty_like(parameter).copy_(value)
