"""A run on disk: safetensors, with all that an exact resume needs; nothing is unpickled."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from beers_deploy.model.convbeers import Network, arrays, load_network, save_network
from beers_deploy.model.io.tensors import all_finite, read_tensors, write_tensors
from beers_deploy.model.training.guards import Guards, require_finite_output
from beers_deploy.model.training.losses import PAPER, LossWeights
from beers_deploy.profiles.errors import ModelError, OptionError

Optimiser = Literal["adam", "adamw"]


@dataclass(frozen=True)
class TrainingRecipe:
    """The numbers of a run; a checkpoint belongs to one recipe.

    Attributes:
        steps: gradient steps.
        batch: patches a step, on every worker.
        learning_rate: the highest, after warm-up.
        warm_up_steps: of a linear rise from 0.
        gradient_norm: larger gradients are cut to it; the L1 loss of a restoration is small, far above is a burst.
        ema_decay: of the running average of the weights, which is what is shipped.
        weight_decay: of AdamW.
        optimiser: "adam" or "adamw".
        loss: weights of the loss's terms.
        distil: weight of the L1 distance to a teacher's output; 0 without a teacher.
        seed: of the first weights and of the patches.

    Raises:
        OptionError: a number that is negative or not finite.
    """

    steps: int
    batch: int = 8
    learning_rate: float = 1e-3
    warm_up_steps: int = 200
    gradient_norm: float = 0.1
    ema_decay: float = 0.999
    weight_decay: float = 1e-4
    optimiser: Optimiser = "adam"
    loss: LossWeights = PAPER
    distil: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        numbers = {"learning rate": self.learning_rate, "weight of the teacher": self.distil}
        numbers |= {f"weight of {term} in the loss": weight for term, weight in asdict(self.loss).items()}
        for name, value in numbers.items():
            if not (math.isfinite(value) and value >= 0):
                expected, remedy = "a finite number, 0 or above", "correct it"
                raise OptionError(name, expected=expected, got=f"{value:g}", remedy=remedy)

    def rate_at(self, step: int) -> float:
        """Learning rate of a step: linear warm-up, then a cosine down to zero."""
        if step < self.warm_up_steps:
            return self.learning_rate * (step + 1) / self.warm_up_steps
        share = (step - self.warm_up_steps) / max(self.steps - self.warm_up_steps, 1)
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * share))


MOMENTS = ("step", "exp_avg", "exp_avg_sq")
"""What Adam keeps of each parameter."""
LEAST = {"step": 1.0, "exp_avg_sq": 0.0}


def write_checkpoint(
    path: Path,
    network: Network,
    average: dict[str, Tensor],
    optimiser: torch.optim.Optimizer,
    recipe: TrainingRecipe,
    step: int,
    guards: Guards,
) -> None:
    """Write weights, running average and Adam's moments, any shape each, with step, recipe and guards."""
    tensors = {f"network.{k}": v for k, v in network.state_dict().items()}
    tensors |= {f"average.{k}": v for k, v in average.items()}
    for name, parameter in network.named_parameters():
        for moment, value in optimiser.state.get(parameter, {}).items():
            tensors[f"moment.{name}.{moment}"] = value
    header = {"step": step, "guards": guards.to_json(), "recipe": asdict(recipe)}
    write_tensors(path, arrays(tensors), header)


def read_checkpoint(
    path: Path, network: Network, average: dict[str, Tensor], optimiser: torch.optim.Optimizer, recipe: TrainingRecipe
) -> tuple[int, Guards]:
    """Fill network, average (any shape each) and optimiser from a checkpoint; return its step and guards."""
    found, header = read_tensors(path)
    tensors = {name: torch.from_numpy(array) for name, array in found.items()}
    if header.get("recipe") != asdict(recipe):
        remedy = "repeat its options, or choose another folder"
        raise ModelError(str(path), expected=f"a checkpoint of {recipe}", got="another recipe", remedy=remedy)
    try:
        _check_parts(tensors, network, recipe.steps)
        guards = Guards.from_json(header["guards"])  # type: ignore[arg-type]
        step = int(str(header["step"]))
        if not 0 <= step <= recipe.steps:
            raise ValueError(f"step {step} of {recipe.steps}")
    except (AttributeError, LookupError, TypeError, ValueError, OverflowError) as error:
        got = " ".join(str(error).split())[:120]
        remedy = "choose the variant it was begun with"
        raise ModelError(str(path), expected="a checkpoint of this network", got=got, remedy=remedy) from error
    network.load_state_dict(_part(tensors, "network."))
    for name, value in _part(tensors, "average.").items():
        average[name].copy_(value)
    for name, parameter in network.named_parameters():
        moments = _part(tensors, f"moment.{name}.")
        optimiser.state[parameter] = {k: _placed(k, v, parameter) for k, v in moments.items()}
    return step, guards


def finish(network: Network, path: Path, recipe: dict[str, object]) -> Network:
    """Write a network with the recipe that made it, and read it back."""
    if not all_finite(arrays(network.state_dict())):
        remedy = "lower the learning rate"
        raise ModelError(str(path), expected="finite weights", got="NaN or infinity", remedy=remedy)
    require_finite_output(network, str(path))
    save_network(path, network, recipe)
    return load_network(path)[0]


def _check_parts(tensors: dict[str, Tensor], network: Network, steps: int) -> None:
    """Nothing is filled in before all of it fits."""
    wanted = network.state_dict()
    parameters = dict(network.named_parameters())
    for name, value in wanted.items():
        _check_like(tensors[f"network.{name}"], value)
        _check_like(tensors[f"average.{name}"], value)
    moments = [name for name in tensors if name.startswith("moment.")]
    for name in moments:
        parameter, moment = name.removeprefix("moment.").rsplit(".", 1)
        like = parameters[parameter]
        _check_like(tensors[name], like.new_zeros(()) if moment == "step" else like)
        if not bool((tensors[name] >= LEAST.get(moment, -math.inf)).all()) or (
            moment == "step" and tensors[name] > steps
        ):
            raise ValueError(f"{name} that Adam cannot have")
    if len(tensors) != 2 * len(wanted) + len(moments) or len(moments) not in (0, len(MOMENTS) * len(parameters)):
        raise ValueError(f"{len(tensors)} tensors")
    if {name.rsplit(".", 1)[1] for name in moments} - set(MOMENTS) or not all_finite(arrays(tensors)):
        raise ValueError("other moments than Adam's, or values that are not finite")


def _check_like(value: Tensor, wanted: Tensor) -> None:
    if value.shape != wanted.shape or value.dtype != wanted.dtype:
        raise ValueError(f"a tensor {tuple(value.shape)} of {value.dtype} in place of {tuple(wanted.shape)}")


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _placed(moment: str, value: Tensor, parameter: Tensor) -> Tensor:
    """Adam keeps its step count on the CPU and its moments with (and laid out as) the parameter."""
    return value if moment == "step" else torch.empty_like(parameter).copy_(value)
