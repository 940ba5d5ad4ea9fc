"""One process or several: torchrun starts them, and says so in the environment."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from beers_deploy.profiles.errors import MachineError


@dataclass(frozen=True)
class Worker:
    """This process among those of the run."""

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

    def wrap(self, module: nn.Module) -> nn.Module:
        """The module with gradients averaged over the workers."""
        return nn.parallel.DistributedDataParallel(module) if self.count > 1 else module

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
