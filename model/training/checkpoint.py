"""Define the parameters of a run, the guards that stop a failing run, and its checkpoint on disk.

A checkpoint is a safetensors file with everything that an exact resume needs; nothing is unpickled.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beers_deploy.model.convbeers import TrainableNetwork, arrays, for_sensor, save_network
from beers_deploy.model.family import RANGES
from beers_deploy.model.io.tensors import all_finite, read_tensors
from beers_deploy.model.training.losses import PAPER, LossWeights
from beers_deploy.profiles.errors import ModelError, printable


@dataclass(frozen=True)
class TrainingRecipe:
    """The parameters of a run; a checkpoint belongs to one recipe.

    Attributes:
        steps: the number of gradient steps.
        batch: the number of patches of a step on each worker.
        learning_rate: the highest learning rate, which is reached after the warm-up.
        warm_up_steps: the number of steps in which the learning rate rises linearly from 0.
        gradient_norm: the norm to which larger gradients are clipped. The L1 loss of a restoration
            is small, so that a far larger gradient is a burst.
        ema_decay: the decay per step of the running average of the weights. The average becomes the
            network.
        loss: the weight of each term of the loss.
        seed: the seed of the first weights and of the patches.
        rounding: the digest of the INT8 file whose rounding is applied to the maps; "" for no
            rounding.
    """

    steps: int
    batch: int = 8
    learning_rate: float = 1e-3
    warm_up_steps: int = 200
    gradient_norm: float = 0.1
    ema_decay: float = 0.999
    loss: LossWeights = PAPER
    seed: int = 0
    rounding: str = ""

    def rate_at(self, step: int) -> float:
        """Return the learning rate of a step: a linear warm-up, then a cosine down to zero."""
        if step < self.warm_up_steps:
            return self.learning_rate * (step + 1) / self.warm_up_steps
        share = (step - self.warm_up_steps) / max(self.steps - self.warm_up_steps, 1)
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * share))


MOMENTS = ("exp_avg", "exp_avg_sq")
"""The state that Adam stores for each parameter, in addition to its step."""

LOWER_RATE = "Lower the learning rate or check the images."
MAX_BAD_STEPS = 10
WINDOW_STEPS = 200
TEST_PLACES = 65
DIVERGED = 5.0
"""A mean loss of this many times the best one so far is no fluctuation, because batches vary by a
factor of two.
"""


@dataclass
class Guards:
    """Counts skipped steps, and compares the loss of each window of steps with that of the best
    window so far.

    Attributes:
        bad_steps: the number of steps that were skipped because their gradient was not finite.
        best: the lowest mean loss of a window; None before the first.
        sum: sum of the losses of the present window.
        count: the number of its steps.
    """

    bad_steps: int = 0
    best: float | None = None
    sum: float = 0.0
    count: int = 0

    def skipped(self, step: int) -> None:
        """Count a step without a finite loss or gradient; raise ModelError after too many."""
        self.bad_steps += 1
        if self.bad_steps > MAX_BAD_STEPS:
            raise ModelError(
                f"The training stopped at step {step}: the loss or the gradient was NaN or "
                f"infinite in {self.bad_steps} steps. {LOWER_RATE}"
            )

    def passed(self, step: int, loss: float) -> None:
        """Count the loss of a step, and raise ModelError if the mean of a window diverges."""
        self.sum += loss
        self.count += 1
        if self.count < WINDOW_STEPS:
            return
        mean = self.sum / self.count
        self.sum = 0.0
        self.count = 0
        if self.best is not None and mean > DIVERGED * self.best:
            raise ModelError(
                f"The training diverged at step {step}: the mean loss is {mean:.4g}, and it was "
                f"{self.best:.4g} before. {LOWER_RATE}"
            )
        self.best = mean if self.best is None else min(self.best, mean)


def require_finite_output(
    network: TrainableNetwork, name: str, remedy: str = "Lower the learning rate."
) -> None:
    """Raise ModelError if a network returns NaN or infinity for an image in [0, 1].

    Finite weights do not exclude that, because their sums may overflow.

    Args:
        network: the network, on the CPU. A conditioned one is given the middle of every range.
        name: the name of the network, in the message.
        remedy: the last sentence of the message.
    """
    side_px = network.variant.scale * TEST_PLACES
    image = torch.rand((1, 1, side_px, side_px), generator=torch.Generator().manual_seed(0))
    images = torch.cat([torch.zeros_like(image), image, torch.ones_like(image)])
    with torch.inference_mode():
        restored = for_sensor(network, torch.zeros(len(RANGES)))(images)
    if not bool(torch.isfinite(restored).all()):
        raise ModelError(f"{name} returns NaN or infinity for a test image. {remedy}")


def checkpoint_sha256(tensors: Mapping[str, Tensor], header: Mapping[str, object]) -> str:
    """Return the hex digest of named tensors and of the other content of the header.

    Safetensors has no digest, and a flipped bit would be a plausible weight or another step.
    """
    content = {key: value for key, value in header.items() if key != "sha256"}
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    for name, array in sorted(arrays(dict(tensors)).items()):
        # The same bytes of another shape or type are another tensor.
        digest.update(f"{name} {array.shape} {array.dtype} ".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def read_checkpoint(
    path: Path, network: TrainableNetwork, recipe: TrainingRecipe, data: str
) -> tuple[dict[str, Tensor], int, Guards]:
    """Read and validate a checkpoint, or raise ModelError.

    Args:
        path: the file of the checkpoint.
        network: a network of the size that the checkpoint must have.
        recipe: the recipe with which the training was begun.
        data: digest of all data that the training learns from.

    Returns:
        The tensors by name (see `Trainer.save`), the number of steps done, and the guards.
    """
    parts, header = read_tensors(path)
    tensors = {name: torch.from_numpy(array) for name, array in parts.items()}
    begun = _options(header.get("recipe"))
    asked = _options(asdict(recipe))
    changed = []
    for name, value in asked.items():
        # The rounding is a digest, which tells a reader nothing.
        values = f" was {begun.get(name)!r}, and is {value!r}" if name != "rounding" else " differs"
        if begun.get(name) != value:
            changed.append(f"`{name}`{values}")
    if changed:
        raise ModelError(
            f"The checkpoint {path} was begun with other options: {'; '.join(changed)}. Repeat "
            "those, or choose another folder."
        )
    if header.get("data") != data:
        raise ModelError(
            f"The checkpoint {path} belongs to a training with other images, held-out sites, "
            "patches, looks, sensors or first weights. Give the same ones, or choose another "
            "folder."
        )
    try:
        if header["sha256"] != checkpoint_sha256(tensors, header):
            raise ValueError("its content does not match its digest")
        _check_parts(tensors, network)
        counts: Any = header["guards"]
        best = None if counts["best"] is None else float(counts["best"])
        guards = Guards(int(counts["bad_steps"]), best, float(counts["sum"]), int(counts["count"]))
        step = int(str(header["step"]))
        if not 0 <= step <= recipe.steps:
            raise ValueError(f"it is at step {step} of {recipe.steps}")
    except (AttributeError, LookupError, TypeError, ValueError, OverflowError) as error:
        # The message of a KeyError is the bare key.
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise ModelError(
            f"{path} is not a checkpoint of this network: {printable(reason)}. Choose the variant "
            "it was begun with, or start again if the file is damaged."
        ) from error
    return tensors, step, guards


def _options(recipe: object) -> dict[str, object]:
    """Return the options of a training by name, from its recipe as a checkpoint stores it."""
    options = dict(recipe) if isinstance(recipe, dict) else {}
    loss = options.pop("loss", None)
    for term, weight in loss.items() if isinstance(loss, dict) else ():
        options[f"{term}_weight"] = weight
    return options


def finish(network: TrainableNetwork, path: Path, recipe: dict[str, object]) -> None:
    """Write the weights of a trained network to a file, with the recipe in its header.

    Raises:
        ModelError: the network returns NaN or infinity.
    """
    if not all_finite(arrays(network.state_dict())):
        raise ModelError(
            f"The trained weights for {path} contain NaN or infinity. Lower the learning rate."
        )
    require_finite_output(network, f"The network for {path}")
    save_network(path, network, recipe)


def _check_parts(tensors: dict[str, Tensor], network: TrainableNetwork) -> None:
    """Raise ValueError unless all tensors fit the network and Adam: nothing is filled in before."""
    templates: dict[str, Tensor] = {}
    for key, value in network.state_dict().items():
        templates |= {f"network.{key}": value, f"average.{key}": value}
    # Before the first step Adam keeps nothing.
    if len(tensors) > len(templates):
        for name, parameter in network.named_parameters():
            templates |= {f"moment.{name}.{moment}": parameter for moment in MOMENTS}
            templates[f"moment.{name}.step"] = parameter.new_zeros(())
    shapes = {name: (value.shape, value.dtype) for name, value in tensors.items()}
    if shapes != {name: (value.shape, value.dtype) for name, value in templates.items()}:
        raise ValueError("its tensors have other names, shapes or types")
    if not all_finite(arrays(tensors)):
        raise ValueError("it has values that are not finite")
