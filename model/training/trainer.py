"""The steps of a run: Adam, warm-up and cosine, clipped gradients, averaged weights, on several processes.

Batches are keyed by (seed, step): a run that was killed and resumed ends with the same weights as one that was not.
"""

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from beers_deploy.model.convbeers import BankedConvBEERS, ConvBEERS, Network, Rounding, arrays, initialise
from beers_deploy.model.io.tensors import write_tensors
from beers_deploy.model.progress import held_back
from beers_deploy.model.training.checkpoint import MOMENTS, Guards, TrainingRecipe, read_checkpoint, tensors_sha256
from beers_deploy.model.training.losses import RestorationLoss
from beers_deploy.model.variants import Variant
from beers_deploy.profiles.errors import MachineError, OptionError


@dataclass(frozen=True)
class Worker:
    """This process among those of the run: torchrun starts them, and says so in the environment."""

    rank: int = 0
    count: int = 1
    local_rank: int = 0

    @property
    def first(self) -> bool:
        """Whether this one writes and reports."""
        return self.rank == 0

    def device(self, name: str) -> torch.device:
        """The device of that name; of several GPUs, this worker's own."""
        device = torch.device(name)
        if device.type == "cuda" and not torch.cuda.is_available():
            remedy = "choose the device cpu, or install a build of PyTorch for it"
            raise MachineError("device", expected="a CUDA device", got="none that PyTorch can see", remedy=remedy)
        if name == "cuda":
            return torch.device("cuda", self.local_rank)
        return device

    def any(self, flag: bool, device: torch.device) -> bool:
        """Whether any worker raises the flag; all get the same answer."""
        if self.count == 1:
            return flag
        raised: Tensor = torch.tensor(float(flag), device=device)
        torch.distributed.all_reduce(raised, torch.distributed.ReduceOp.MAX)
        return bool(raised > 0)


@contextmanager
def joined(device: str) -> Iterator[Worker]:
    """Join the run that torchrun started, or be the only one."""
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield Worker()
        return
    torch.distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
    try:
        yield Worker(torch.distributed.get_rank(), count, int(os.environ.get("LOCAL_RANK", "0")))
    finally:
        torch.distributed.destroy_process_group()


Batches = Callable[[int], Iterator[tuple[np.ndarray, ...]]]
"""The batches from a number on: (degraded, reference), (N, 1, P, P) in [0, 1] each, of patches made on the fly or of
stored pairs; for a conditioned network (degraded, reference, sensor vectors (N, 4))."""

Precision = Literal["float32", "bfloat16"]
"""The number format of the blocks. Head, tail and what is added stay float32: 8 bits would round a 12-bit image."""


@dataclass(frozen=True)
class Schedule:
    """How often a run reports, looks at the validation images, and saves.

    `report` is told the step, the means of the loss's terms since the last report, and patches a second.
    """

    report_steps: int = 100
    save_s: float = 120.0
    validate_steps: int = 0  # 0: never
    report: Callable[[int, Mapping[str, float], float], None] = field(default=lambda *_: None)
    validate: Callable[[int, Network], None] = field(default=lambda *_: None)


class Trainer:
    """One run: its network, running average, optimiser and step.

    Args:
        variant: the network's size.
        recipe: see there.
        loss: the loss that the recipe weighs.
        worker: this process among those of the run.
        device: where the steps are computed.
        start: a network of the same kind and size to go on from; None draws new weights.
        precision: what the body is computed in; it is the machine's, and a resumed run may take another.
        conditioned: whether the network is given the sensor of each patch.
        rounding: of a conditioned network's maps, as its INT8 file rounds them; None leaves them as they are.

    Attributes:
        data: digest of all that the run learns from; a checkpoint belongs to one.
    """

    def __init__(
        self,
        variant: Variant,
        recipe: TrainingRecipe,
        loss: RestorationLoss | None = None,
        worker: Worker | None = None,
        device: str = "cpu",
        start: Network | None = None,
        precision: Precision = "float32",
        conditioned: bool = False,
        rounding: Rounding | None = None,
    ) -> None:
        self.recipe, self.worker = recipe, worker or Worker()
        self.loss, self.device = loss or RestorationLoss(recipe.loss), self.worker.device(device)
        require_loss(self.loss)
        self.step, self.guards, self.data = 0, Guards(), ""
        self.network: Network = (BankedConvBEERS if conditioned else ConvBEERS)(variant)
        initialise(self.network, torch.Generator().manual_seed(recipe.seed))
        if start is not None:
            self.network.load_state_dict(start.state_dict())
        self.network.to(self.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.bfloat16 = precision == "bfloat16"
        self.rounding = {"rounding": rounding} if rounding else {}
        # Gradients are averaged over the workers.
        self.forward: nn.Module = self.network if self.worker.count == 1 else DistributedDataParallel(self.network)
        self.average = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=recipe.learning_rate)

    def run(self, batches: Batches, checkpoint: Path, schedule: Schedule) -> None:
        """Train to the last step. Ctrl-C leaves a checkpoint of the last whole step.

        Args:
            batches: from a number on, all that follow.
            checkpoint: the file.
            schedule: see there; of several workers, the first keeps to it.
        """
        schedule = schedule if self.worker.first else Schedule()
        seen, begun, saved = list[Mapping[str, Tensor]](), time.monotonic(), time.monotonic()
        with held_back() as interrupt:
            following = batches(self.step)
            while self.step < self.recipe.steps and not self.worker.any(interrupt.asked, self.device):
                seen.append(self.train_step(*map(torch.from_numpy, next(following))))
                if self._due(schedule.report_steps):
                    schedule.report(self.step, *self._summary(seen, time.monotonic() - begun))
                    seen, begun = [], time.monotonic()
                if self._due(schedule.validate_steps):
                    schedule.validate(self.step, self.averaged())
                if time.monotonic() - saved > schedule.save_s:
                    self.save(checkpoint)
                    saved = time.monotonic()
        self.save(checkpoint)
        if self.step < self.recipe.steps:
            raise KeyboardInterrupt

    def _due(self, every: int) -> bool:
        """Whether so many steps have passed again, or it is the end; of 0 it never is."""
        return every > 0 and (self.step % every == 0 or self.step == self.recipe.steps)

    def _summary(self, seen: Sequence[Mapping[str, Tensor]], elapsed_s: float) -> tuple[dict[str, float], float]:
        """Of the steps since the last report: the means of their terms, but of those skipped; patches a second."""
        kept = [terms for terms in seen if terms]
        means = {name: sum(float(terms[name]) for terms in kept) / len(kept) for name in (kept or [{}])[0]}
        return means, len(seen) * self.recipe.batch * self.worker.count / max(elapsed_s, 1e-9)

    def train_step(self, degraded: Tensor, reference: Tensor, *vectors: Tensor) -> Mapping[str, Tensor]:
        """One step on a batch, (N, 1, P, P) each; the loss's terms, none for a step that was skipped.

        A conditioned network takes the sensor vectors (N, 4) too.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self.recipe.rate_at(self.step)
        degraded = degraded.to(self.device, memory_format=torch.channels_last)
        known = (vector.to(self.device) for vector in vectors)
        restored = self.forward(degraded, *known, bfloat16=self.bfloat16, **self.rounding)
        total, terms = self.loss(restored, reference.to(self.device))
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.gradient_norm)
        self.step += 1
        # All workers skip a step that is bad for one of them, or their weights would part.
        bad = not bool(torch.isfinite(total) & torch.isfinite(norm))
        if self.worker.any(bad, self.device):
            self.guards.skipped(self.step)
            return {}
        self.optimiser.step()
        self._average()
        self.guards.passed(self.step, float(total.detach()))
        return terms

    def _average(self) -> None:
        # Early on the average follows fast, or the first random weights would stay in it for long.
        decay = min(self.recipe.ema_decay, (1 + self.step) / (10 + self.step))
        for name, value in self.network.state_dict().items():
            self.average[name].lerp_(value, 1 - decay)

    def averaged(self) -> Network:
        """The network with its running-average weights, on the CPU: the one to ship."""
        network = type(self.network)(self.network.variant)
        network.load_state_dict(self.average)
        return network.eval()

    def save(self, path: Path) -> None:
        """Write all that an exact resume needs, as safetensors; of several workers, the first does."""
        if not self.worker.first:
            return
        tensors = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        tensors |= {f"average.{name}": value for name, value in self.average.items()}
        for name, parameter in self.network.named_parameters():
            for moment, value in self.optimiser.state.get(parameter, {}).items():
                tensors[f"moment.{name}.{moment}"] = value
        header: dict[str, object] = {"step": self.step, "guards": asdict(self.guards), "recipe": asdict(self.recipe)}
        header |= {"data": self.data, "sha256": tensors_sha256(tensors)}
        write_tensors(path, arrays(tensors), header)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of the same recipe, begun on this processor or another."""
        tensors, self.step, self.guards = read_checkpoint(path, self.network, self.recipe, self.data)
        self.network.load_state_dict({name: tensors[f"network.{name}"] for name in self.average})
        for name, value in self.average.items():
            value.copy_(tensors[f"average.{name}"])
        if len(tensors) == 2 * len(self.average):  # from before the first step
            return
        for name, parameter in self.network.named_parameters():
            # Adam keeps its step count on the CPU and its moments with (and laid out as) the parameter.
            moments = {key: torch.empty_like(parameter).copy_(tensors[f"moment.{name}.{key}"]) for key in MOMENTS}
            self.optimiser.state[parameter] = {"step": tensors[f"moment.{name}.step"], **moments}


def require_loss(loss: RestorationLoss) -> None:
    """Refuse a loss that is 0 whatever the network gives: such a run learns nothing."""
    weights = loss.weights
    if loss.perceptual is not None or weights.l1 + weights.fft + weights.psnr > 0:
        return
    left_out = ", and none but LPIPS, which lacks its weights" if weights.lpips else ""
    remedy = "raise one of `l1_weight`, `fft_weight`, `psnr_weight`"
    raise OptionError("loss", expected="a term of weight above 0", got=f"weights of 0{left_out}", remedy=remedy)
