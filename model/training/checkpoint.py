"""What a run is told, what stops one that has gone wrong, and a run on disk.

That is safetensors, with all that an exact resume needs; nothing is unpickled.
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

from beers_deploy.model.convbeers import Network, arrays, save_network, told
from beers_deploy.model.family import RANGES
from beers_deploy.model.io.tensors import all_finite, read_tensors
from beers_deploy.model.training.losses import PAPER, LossWeights
from beers_deploy.profiles.errors import ModelError, OptionError


@dataclass(frozen=True)
class TrainingRecipe:
    """The numbers of a run; a checkpoint belongs to one recipe.

    Attributes:
        steps: gradient steps.
        batch: patches a step, on every worker.
        learning_rate: the highest, after warm-up.
        warm_up_steps: of a linear rise from 0.
        gradient_norm: larger gradients are cut to it; the L1 loss of a restoration is small, far
            above is a burst.
        ema_decay: of the running average of the weights, which is what is shipped.
        loss: weights of the loss's terms.
        seed: of the first weights and of the patches.
        rounding: the digest of the INT8 file that maps are rounded as; "" rounds none.
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

    def __post_init__(self) -> None:
        numbers = {"learning rate": self.learning_rate}
        numbers |= {
            f"weight of {term} in the loss": weight for term, weight in asdict(self.loss).items()
        }
        for name, value in numbers.items():
            if not (math.isfinite(value) and value >= 0):
                expected = "a finite number, 0 or above"
                remedy = "correct it"
                raise OptionError(name, expected=expected, got=f"{value:g}", remedy=remedy)

    def rate_at(self, step: int) -> float:
        """Learning rate of a step: linear warm-up, then a cosine down to zero."""
        if step < self.warm_up_steps:
            return self.learning_rate * (step + 1) / self.warm_up_steps
        share = (step - self.warm_up_steps) / max(self.steps - self.warm_up_steps, 1)
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * share))


MOMENTS = ("exp_avg", "exp_avg_sq")
"""What Adam keeps of each parameter, besides its step."""

MAX_BAD_STEPS = 10
WINDOW_STEPS = 200
TEST_PLACES = 65
DIVERGED = 5.0
"""A mean loss this many times the best one so far is no fluctuation: batches vary by a factor of
two.
"""


@dataclass
class Guards:
    """Counts skipped steps, and compares the loss of each window of steps with the best window so
    far.

    Attributes:
        bad_steps: steps whose gradient was not finite: skipped.
        best: the lowest mean loss of a window; None before the first.
        sum: of the losses of the present window.
        count: of its steps.
    """

    bad_steps: int = 0
    best: float | None = None
    sum: float = 0.0
    count: int = 0

    def skipped(self, step: int) -> None:
        """Count a step whose loss or gradient was not finite."""
        self.bad_steps += 1
        if self.bad_steps > MAX_BAD_STEPS:
            raise _error(step, "a finite loss", f"{self.bad_steps} non-finite steps")

    def passed(self, step: int, loss: float) -> None:
        """Take note of a step's loss."""
        self.sum = self.sum + loss
        self.count = self.count + 1
        if self.count < WINDOW_STEPS:
            return
        mean = self.sum / self.count
        self.sum = 0.0
        self.count = 0
        if self.best is not None and mean > DIVERGED * self.best:
            raise _error(step, f"a loss near {self.best:.4g}", f"{mean:.4g}: it diverged")
        self.best = mean if self.best is None else min(self.best, mean)


def require_finite_output(
    network: Network, where: str, remedy: str = "lower the learning rate"
) -> None:
    """Refuse a network that makes NaN or infinity of an image in [0, 1]: its weights may be finite
    all the same.

    It lies on the CPU; a conditioned one is told the middle of every range.
    """
    side_px = network.variant.scale * TEST_PLACES
    image = torch.rand((1, 1, side_px, side_px), generator=torch.Generator().manual_seed(0))
    images = torch.cat([torch.zeros_like(image), image, torch.ones_like(image)])
    with torch.inference_mode():
        restored = told(network, torch.zeros(len(RANGES)))(images)
    if not bool(torch.isfinite(restored).all()):
        raise ModelError(
            where, expected="finite pixels of a test image", got="NaN or infinity", remedy=remedy
        )


def _error(step: int, expected: str, got: str) -> ModelError:
    remedy = "lower the learning rate or check the images"
    return ModelError(f"training step {step}", expected=expected, got=got, remedy=remedy)


def checkpoint_sha256(tensors: Mapping[str, Tensor], header: Mapping[str, object]) -> str:
    """Return the hex digest of named tensors and of what the header states beside it.

    Safetensors has none, and a flipped bit is a plausible weight or another step.
    """
    content = {key: value for key, value in header.items() if key != "sha256"}
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    for name, array in sorted(arrays(dict(tensors)).items()):
        # The same bytes of another shape or type are another tensor.
        digest.update(f"{name} {array.shape} {array.dtype} ".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def read_checkpoint(
    path: Path, network: Network, recipe: TrainingRecipe, data: str = ""
) -> tuple[dict[str, Tensor], int, Guards]:
    """The parts of a checkpoint by name (see `Trainer.save`), its step and its guards, once all is
    as it must be.

    Args:
        path: the file.
        network: a network of the same size.
        recipe: that it was begun with.
        data: digest of all that it was begun to learn from.
    """
    parts, header = read_tensors(path)
    tensors = {name: torch.from_numpy(array) for name, array in parts.items()}
    if header.get("recipe") != asdict(recipe):
        remedy = "repeat its options, or choose another folder"
        raise ModelError(
            str(path), expected=f"a checkpoint of {recipe}", got="another recipe", remedy=remedy
        )
    if header.get("data") != data:
        remedy = "give the same ones, or choose another folder"
        expected = "a checkpoint of these images, sensors and first weights"
        raise ModelError(str(path), expected=expected, got="one of others", remedy=remedy)
    try:
        if header["sha256"] != checkpoint_sha256(tensors, header):
            raise ValueError("a content that does not match its digest")
        _check_parts(tensors, network, recipe.steps)
        counts: Any = header["guards"]
        best = None if counts["best"] is None else float(counts["best"])
        guards = Guards(int(counts["bad_steps"]), best, float(counts["sum"]), int(counts["count"]))
        step = int(str(header["step"]))
        if not 0 <= step <= recipe.steps:
            raise ValueError(f"step {step} of {recipe.steps}")
    except (AttributeError, LookupError, TypeError, ValueError, OverflowError) as error:
        got = " ".join(str(error).split())[:120]
        remedy = "choose the variant it was begun with, or begin anew where the file is damaged"
        raise ModelError(
            str(path), expected="a checkpoint of this network", got=got, remedy=remedy
        ) from error
    return tensors, step, guards


def finish(network: Network, path: Path, recipe: dict[str, object]) -> None:
    """Write a network with the recipe that made it."""
    if not all_finite(arrays(network.state_dict())):
        remedy = "lower the learning rate"
        raise ModelError(str(path), expected="finite weights", got="NaN or infinity", remedy=remedy)
    require_finite_output(network, str(path))
    save_network(path, network, recipe)


def _check_parts(tensors: dict[str, Tensor], network: Network, steps: int) -> None:
    """Raise ValueError unless all tensors fit the network and Adam: nothing is filled in before."""
    templates: dict[str, Tensor] = {}
    for key, value in network.state_dict().items():
        templates |= {f"network.{key}": value, f"average.{key}": value}
    # Before the first step Adam keeps nothing.
    if len(tensors) > len(templates):
        for name, parameter in network.named_parameters():
            templates |= {f"moment.{name}.{moment}": parameter for moment in MOMENTS}
            templates[f"moment.{name}.step"] = parameter.new_zeros(())
    for name, template in templates.items():
        value = tensors[name]
        moment = name.rsplit(".", 1)[1]
        if value.shape != template.shape or value.dtype != template.dtype:
            shapes = f"{tuple(value.shape)} of {value.dtype} in place of {tuple(template.shape)}"
            raise ValueError(f"a tensor {shapes}")
        # Adam's second moment is a mean of squares.
        limits = {"step": (0, steps), "exp_avg_sq": (0, math.inf)}
        least, most = limits.get(moment, (-math.inf, math.inf))
        if not bool(((value >= least) & (value <= most)).all()):
            raise ValueError(f"{name} that Adam cannot have")
    if len(tensors) != len(templates) or not all_finite(arrays(tensors)):
        raise ValueError(
            f"{len(tensors)} tensors in place of {len(templates)}, or values that are not finite"
        )
