"""Train a ConvBEERS: Adam on the L1 loss, warm-up and cosine, averaged weights, exact resume.

A checkpoint holds the network, its running average and Adam's moments as safetensors; batches are keyed by
(seed, step). So a run that was killed and resumed ends with the same weights as one that was not.
"""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from model.convbeers import ConvBEERS, Variant, initialise
from model.patches import PatchSource
from model.weights_file import all_finite, load_network, read_tensors, save_network, write_tensors
from profiles.errors import ModelError


@dataclass(frozen=True)
class TrainingRecipe:
    """What decides the weights, beside the images and the sensors."""

    steps: int
    batch: int = 8
    learning_rate: float = 1e-3
    warm_up_steps: int = 200
    gradient_norm: float = 0.1  # the L1 loss of a restoration is small: far above this is a burst
    ema_decay: float = 0.999
    seed: int = 0

    def rate_at(self, step: int) -> float:
        """Learning rate of a step: linear warm-up, then a cosine down to zero."""
        if step < self.warm_up_steps:
            return self.learning_rate * (step + 1) / self.warm_up_steps
        share = (step - self.warm_up_steps) / max(self.steps - self.warm_up_steps, 1)
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * share))


@dataclass(frozen=True)
class Progress:
    """What a run reports now and then."""

    step: int
    steps: int
    loss: float
    patches_per_s: float


MAX_BAD_STEPS = 10


class Trainer:
    """One run: its network, running average, optimiser and step."""

    def __init__(self, variant: Variant, recipe: TrainingRecipe, device: str = "cpu") -> None:
        self.recipe, self.device, self.step, self.bad_steps = recipe, torch.device(device), 0, 0
        self.network = ConvBEERS(variant)
        initialise(self.network, torch.Generator().manual_seed(recipe.seed))
        self.network.to(self.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=recipe.learning_rate)

    def run(
        self,
        source: PatchSource,
        checkpoint: Path,
        report: Callable[[Progress], None],
        every: int = 100,
        save_every_s: float = 120.0,
    ) -> None:
        """Train to the last step, reporting every so many steps and saving a checkpoint now and then.

        Raises:
            ModelError: the loss or the gradient stayed non-finite.
        """
        batches = source.batches(self.step)
        started, saved, first, total = time.perf_counter(), time.perf_counter(), self.step, 0.0
        while self.step < self.recipe.steps:
            total += self._train_step(*next(batches))
            if self.step % every == 0 or self.step == self.recipe.steps:
                done = self.step - first
                rate = done * self.recipe.batch / (time.perf_counter() - started)
                report(Progress(self.step, self.recipe.steps, total / (self.step % every or every), rate))
                total = 0.0
            if time.perf_counter() - saved > save_every_s:
                self.save(checkpoint)
                saved = time.perf_counter()
        self.save(checkpoint)

    def _train_step(self, degraded: Tensor, reference: Tensor) -> float:
        for group in self.optimiser.param_groups:
            group["lr"] = self.recipe.rate_at(self.step)
        degraded = degraded.to(self.device, memory_format=torch.channels_last)
        loss = (mixed_forward(self.network, degraded) - reference.to(self.device)).abs().mean()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.gradient_norm)
        self.step += 1
        if not (torch.isfinite(loss) and torch.isfinite(norm)):
            self._count_bad_step()
            return 0.0
        self.optimiser.step()
        self._average()
        return float(loss.detach())

    def _count_bad_step(self) -> None:
        self.bad_steps += 1
        if self.bad_steps > MAX_BAD_STEPS:
            raise ModelError(
                f"training step {self.step}",
                expected="a finite loss",
                got=f"{self.bad_steps} non-finite steps",
                remedy="lower the learning rate or check the images",
            )

    def _average(self) -> None:
        decay = min(self.recipe.ema_decay, (1 + self.step) / (10 + self.step))
        for name, value in self.network.state_dict().items():
            self.average[name].lerp_(value, 1 - decay)

    def averaged(self) -> ConvBEERS:
        """The network with its running-average weights: the one to ship."""
        network = ConvBEERS(self.network.variant)
        network.load_state_dict(self.average)
        return network.eval()

    def save(self, path: Path) -> None:
        """Write all that an exact resume needs."""
        tensors = {f"network.{k}": v for k, v in self.network.state_dict().items()}
        tensors |= {f"average.{k}": v for k, v in self.average.items()}
        for name, parameter in self.network.named_parameters():
            for moment, value in self.optimiser.state.get(parameter, {}).items():
                tensors[f"adam.{name}.{moment}"] = value
        write_tensors(path, tensors, {"step": self.step, "bad_steps": self.bad_steps, "recipe": asdict(self.recipe)})

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of the same recipe.

        Raises:
            ModelError: not a checkpoint, or one of another recipe.
        """
        tensors, header = read_tensors(path)
        if header.get("recipe") != asdict(self.recipe):
            raise ModelError(
                str(path),
                expected=f"a checkpoint of {self.recipe}",
                got="another recipe",
                remedy="choose another --out",
            )
        self.network.load_state_dict(_part(tensors, "network."))
        self.average = {k: v.to(self.device) for k, v in _part(tensors, "average.").items()}
        for name, parameter in self.network.named_parameters():
            moments = _part(tensors, f"adam.{name}.")
            self.optimiser.state[parameter] = {k: _placed(k, v, parameter) for k, v in moments.items()}
        self.step, self.bad_steps = int(str(header["step"])), int(str(header["bad_steps"]))


def mixed_forward(network: ConvBEERS, image: Tensor) -> Tensor:
    """The network with its body in bfloat16, (N, 1, H, W).

    Head, tail and the global add stay float32: 8 bits of mantissa would round a 12-bit image.
    """
    shallow = network.head(image)
    with torch.autocast(image.device.type, dtype=torch.bfloat16):
        deep = network.body_end(network.body(shallow))
    correction: Tensor = network.tail(shallow + deep.float())
    return image + correction


def finish(trainer: Trainer, path: Path, recipe: dict[str, object]) -> ConvBEERS:
    """Write the averaged weights with the recipe that made them, and read them back.

    Raises:
        ModelError: a weight is not finite.
    """
    network = trainer.averaged()
    if not all_finite(network.state_dict()):
        raise ModelError(
            str(path), expected="finite weights", got="NaN or infinity", remedy="lower the learning rate"
        )
    save_network(path, network, recipe)
    return load_network(path)[0]


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _placed(moment: str, value: Tensor, parameter: Tensor) -> Tensor:
    """Adam keeps its step count on the CPU and its moments with (and laid out as) the parameter."""
    return value if moment == "step" else torch.empty_like(parameter).copy_(value)
