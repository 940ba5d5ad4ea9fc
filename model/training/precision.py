"""The number format of a training step's convolutions: float32, or bfloat16 where that is faster.

It belongs to the machine and not to the recipe, so a run begun in one format goes on in the other.
"""

from typing import Literal

import torch
from torch import Tensor, nn

from model.convbeers import Network
from model.processor import bfloat16_speed
from model.training.workers import Worker

Precision = Literal["float32", "bfloat16"]

CLEARLY_SLOWER = 0.5
"""Below this speed a run that was begun in bfloat16 does not go on in it. Emulated, it has a tenth."""


def choose_precision(
    wanted: Precision | None, begun: Precision | None, worker: Worker, device: torch.device
) -> Precision:
    """What a run computes in: what is wanted, else what it was begun in, else what is faster on every worker.

    A resumed run keeps to its format where that costs little, so that it ends with the same weights as one that was
    never interrupted: a measurement that comes out differently on a busy machine must not change them.

    Args:
        wanted: by the user, or None.
        begun: what the checkpoint states, or None for a new run.
        worker: this process among those of the run.
        device: where the steps are computed; on a GPU bfloat16 always pays.
    """
    if wanted is not None:
        return wanted
    if begun == "float32":
        return begun
    enough = CLEARLY_SLOWER if begun else 1.0
    slow = device.type == "cpu" and bfloat16_speed() < enough
    return "float32" if worker.any(slow, device) else "bfloat16"


class MixedPrecision(nn.Module):
    """A network with its blocks in the run's precision; what it takes and gives is the network's own.

    Head, tail and what is added stay float32 in any case: 8 bits of mantissa would round a 12-bit image.
    """

    def __init__(self, network: Network, precision: Precision) -> None:
        super().__init__()
        self.network, self.precision = network, precision

    def forward(self, *given: Tensor) -> Tensor:
        """Images (N, 1, H, W), and sensor vectors (N, 4) of a network that is told them, to (N, 1, H, W)."""
        restored: Tensor = self.network(*given, bfloat16=self.precision == "bfloat16")
        return restored
