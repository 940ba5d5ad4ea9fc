"""Run the steps of a training: Adam, warm-up and cosine, clipped gradients, averaged weights, on
one or several processes.

Batches are keyed by (seed, step): a run that was killed and resumed ends with the same weights as
one that was not.
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

from beers_deploy.model.convbeers import (
    BankedConvBEERS,
    ConvBEERS,
    Rounding,
    TrainableNetwork,
    arrays,
    initialise,
)
from beers_deploy.model.io.tensors import write_tensors
from beers_deploy.model.progress import held_back
from beers_deploy.model.training.checkpoint import (
    MOMENTS,
    Guards,
    TrainingRecipe,
    checkpoint_sha256,
    read_checkpoint,
)
from beers_deploy.model.training.losses import RestorationLoss
from beers_deploy.model.training.source import Batch
from beers_deploy.model.training.step import Step
from beers_deploy.model.variants import Variant
from beers_deploy.profiles.errors import MachineError, OptionError


@dataclass(frozen=True)
class Worker:
    """One of the processes that train a network together, as torchrun starts them.

    Attributes:
        rank: the number of this process among all, from 0.
        count: the number of processes.
        local_rank: the number of this process among those of its host, which chooses its GPU.
    """

    rank: int = 0
    count: int = 1
    local_rank: int = 0

    @property
    def first(self) -> bool:
        """True if this worker writes and reports."""
        return self.rank == 0

    def device(self, name: str) -> torch.device:
        """Return the device of that name; with several GPUs, the one of this worker."""
        if name.partition(":")[0] not in ("cpu", "cuda"):
            raise OptionError(f"`device` must be cpu or cuda, got {name!r}.")
        device = torch.device(name)
        if device.type == "cuda" and not torch.cuda.is_available():
            raise MachineError(
                f"`device` is {name!r}, but PyTorch finds no CUDA device. Choose cpu, or install "
                "a build of PyTorch with CUDA."
            )
        if name == "cuda":
            return torch.device("cuda", self.local_rank)
        return device

    def any(self, flag: bool, device: torch.device) -> bool:
        """Return True if any worker raises the flag; all workers get the same answer."""
        if self.count == 1:
            return flag
        return bool(largest_of_all(torch.tensor(float(flag), device=device)) > 0)


@contextmanager
def joined(device: str) -> Iterator[Worker]:
    """Join the processes that torchrun started, for as long as the block runs.

    Args:
        device: the name of the device of the training, such as "cpu" or "cuda".

    Yields:
        This process; the only one if torchrun started none.
    """
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield Worker()
        return
    torch.distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
    try:
        yield Worker(torch.distributed.get_rank(), count, int(os.environ.get("LOCAL_RANK", "0")))
    finally:
        torch.distributed.destroy_process_group()


Batches = Callable[[int], Iterator[Batch]]
"""A function that returns all batches from a number on, of simulated patches or of stored pairs."""

UNSEEN_STEPS = 25
"""The number of steps on a GPU before their results are read."""

Precision = Literal["float32", "bfloat16"]
"""The number format of the blocks.

Head, tail and sums remain float32, because 8 bits of precision would round a 12-bit image.
"""


@dataclass(frozen=True)
class Schedule:
    """The number of steps between reports, validations and checkpoints.

    `report` is called with the step, and with three figures since the last report: the means of the
    loss's terms, the number of patches per second, and the share of the time in which the steps
    waited for patches.
    """

    report_steps: int = 100
    save_s: float = 120.0
    validate_steps: int = 0  # 0 stands for never.
    report: Callable[[int, Mapping[str, float], float, float], None] = field(
        default=lambda *_: None
    )
    validate: Callable[[int, TrainableNetwork], None] = field(default=lambda *_: None)


def largest_of_all(flag: Tensor) -> Tensor:
    """Return the maximum of a flag over all workers."""
    torch.distributed.all_reduce(flag, torch.distributed.ReduceOp.MAX)
    return flag


class Trainer:
    """One run: its network, running average, optimiser and step.

    Args:
        variant: the size of the network.
        recipe: the parameters of the run.
        loss: the loss; None builds that of the recipe's weights.
        worker: this process among those that train together; None trains alone.
        device: the device that computes the steps.
        start: a network of the same kind and size to continue from; None draws new weights.
        precision: number format of the body; it depends on the machine, and a resumed run may use
            another.
        conditioned: True if the network reads the sensor of each patch.
        rounding: the steps by which the INT8 file of a conditioned network rounds its feature maps,
            so that the training rounds them too; None trains without rounding.

    Attributes:
        data: digest of all data that the run learns from. A checkpoint of other data is refused.
    """

    def __init__(
        self,
        variant: Variant,
        recipe: TrainingRecipe,
        loss: RestorationLoss | None = None,
        worker: Worker | None = None,
        device: str = "cpu",
        start: TrainableNetwork | None = None,
        precision: Precision = "float32",
        conditioned: bool = False,
        rounding: Rounding | None = None,
    ) -> None:
        self.recipe = recipe
        self.worker = worker or Worker()
        self.loss = loss or RestorationLoss(recipe.loss)
        self.device = self.worker.device(device)
        weights = self.loss.weights
        # A run whose loss is 0 for every network learns nothing.
        if self.loss.perceptual is None and not weights.l1 + weights.fft + weights.psnr > 0:
            lpips = ", except that of LPIPS, whose network was not found" if weights.lpips else ""
            raise OptionError(
                f"The loss is always 0, because the weights of all its terms are 0{lpips}. "
                "Raise one of `l1_weight`, `fft_weight`, `psnr_weight`."
            )
        self.step = 0
        self.guards = Guards()
        self.data = ""
        self.network: TrainableNetwork = (BankedConvBEERS if conditioned else ConvBEERS)(variant)
        initialise(self.network, torch.Generator().manual_seed(recipe.seed))
        if start is not None:
            self.network.load_state_dict(start.state_dict())
        self.network.to(self.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        several = self.worker.count > 1
        # Gradients are averaged over the workers.
        forward: nn.Module = DistributedDataParallel(self.network) if several else self.network
        self._take = Step(
            self.network,
            self.loss,
            forward,
            gradient_norm=recipe.gradient_norm,
            bfloat16=precision == "bfloat16",
            rounding=rounding,
            agree=largest_of_all if several else None,
        )
        self.average = self._take.average
        self.optimiser = self._take.optimiser
        self._unseen = list[Tensor]()

    def run(self, batches: Batches, checkpoint: Path, schedule: Schedule) -> None:
        """Train to the last step. Ctrl-C leaves a checkpoint of the last whole step.

        Args:
            batches: function that returns all batches from a number on.
            checkpoint: the path of the checkpoint to write.
            schedule: when to report, validate and save; with several workers, the first does.
        """
        schedule = schedule if self.worker.first else Schedule()
        reported_at = saved_at = time.monotonic()
        waited_s = 0.0
        rows = list[list[float]]()
        # The results of a GPU are read rarely, so that it does not wait.
        most_unseen = UNSEEN_STEPS if self.device.type == "cuda" else 1
        with held_back() as interrupt:
            following = batches(self.step)
            while self.step < self.recipe.steps and not self.worker.any(
                interrupt.asked, self.device
            ):
                asked_at = time.monotonic()
                batch = next(following)
                waited_s += time.monotonic() - asked_at
                self.train_step(batch)
                now = time.monotonic()
                save = now - saved_at > schedule.save_s
                reports = self._due(schedule.report_steps)
                validates = self._due(schedule.validate_steps)
                if save or reports or validates or len(self._unseen) >= most_unseen:
                    rows += self.collected()
                if reports:
                    patches = len(rows) * self.recipe.batch * self.worker.count
                    elapsed_s = max(now - reported_at, 1e-9)
                    means = self._means(rows)
                    schedule.report(self.step, means, patches / elapsed_s, waited_s / elapsed_s)
                    rows = []
                    reported_at = now
                    waited_s = 0.0
                if validates:
                    schedule.validate(self.step, self.averaged())
                if save:
                    self.save(checkpoint)
                    saved_at = time.monotonic()
        self.collected()
        self.save(checkpoint)
        if self.step < self.recipe.steps:
            raise KeyboardInterrupt

    def _due(self, every: int) -> bool:
        """Return True if `every` steps have passed again, or at the last step; never if it is 0."""
        return every > 0 and (self.step % every == 0 or self.step == self.recipe.steps)

    def _means(self, rows: Sequence[Sequence[float]]) -> dict[str, float]:
        """Return the means of the terms of the steps since the last report, without
        skipped steps.
        """
        counted = [terms for skipped, _, *terms in rows if not skipped]
        if not counted:
            return {}
        return dict(zip(self._take.names, np.mean(counted, 0).tolist(), strict=True))

    def train_step(self, batch: Batch) -> None:
        """Take one step on a batch; `collected` reads its result later."""
        # Early on the average follows fast, or the first random weights would stay in it for long.
        step = self.step + 1
        decay = min(self.recipe.ema_decay, (1 + step) / (10 + step))
        self._unseen.append(self._take(batch, self.recipe.rate_at(self.step), 1 - decay))
        self.step = step

    def collected(self) -> list[list[float]]:
        """Read the results of the steps since the last call, and stop a failing run.

        Returns:
            For each step 1 if it was skipped, else 0; its loss; and the loss's terms.
        """
        rows: list[list[float]] = torch.stack(self._unseen).tolist() if self._unseen else []
        first = self.step - len(rows) + 1
        self._unseen = []
        for number, (skipped, total, *_) in enumerate(rows, first):
            if skipped:
                self.guards.skipped(number)
            else:
                self.guards.passed(number, total)
        return rows

    def averaged(self) -> TrainableNetwork:
        """Return the network with its running-average weights on the CPU: the one that is
        shipped.
        """
        network = type(self.network)(self.network.variant)
        network.load_state_dict(self.average)
        return network.eval()

    def save(self, path: Path) -> None:
        """Write all that an exact resume needs, as safetensors; of several
        workers, the first does.
        """
        if not self.worker.first:
            return
        tensors = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        tensors |= {f"average.{name}": value for name, value in self.average.items()}
        for name, parameter in self.network.named_parameters():
            for moment, value in self.optimiser.state.get(parameter, {}).items():
                tensors[f"moment.{name}.{moment}"] = value
        header: dict[str, object] = {
            "step": self.step,
            "guards": asdict(self.guards),
            "recipe": asdict(self.recipe),
            "data": self.data,
        }
        header["sha256"] = checkpoint_sha256(tensors, header)
        write_tensors(path, arrays(tensors), header)

    def resume(self, path: Path) -> None:
        """Continue from a checkpoint of the same recipe, written on this device or another."""
        tensors, self.step, self.guards = read_checkpoint(
            path, self.network, self.recipe, self.data
        )
        self.network.load_state_dict({name: tensors[f"network.{name}"] for name in self.average})
        for name, value in self.average.items():
            value.copy_(tensors[f"average.{name}"])
        # A checkpoint from before the first step has no moments.
        if len(tensors) == 2 * len(self.average):
            return
        for name, parameter in self.network.named_parameters():
            # Adam keeps its step count and its moments with (and laid out as) the parameter.
            moments = {
                key: torch.empty_like(parameter).copy_(tensors[f"moment.{name}.{key}"])
                for key in MOMENTS
            }
            step_count = tensors[f"moment.{name}.step"].to(self.device)
            self.optimiser.state[parameter] = {"step": step_count, **moments}
