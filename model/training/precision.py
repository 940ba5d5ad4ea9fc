"""The number format of a training step's convolutions: float32, or bfloat16 where that is faster.

It belongs to the machine and not to the recipe, so a run begun in one format goes on in the other.
"""

from typing import Literal

import torch
from torch import Tensor, nn

from model.conditioning import ConditionedConvBEERS, Network, each_through
from model.convbeers import ConvBEERS
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
    """A network with its body in the run's precision, (N, 1, H, W) in [0, 1] to the same.

    Head, tail and the global add stay float32 in any case: 8 bits of mantissa would round a 12-bit image.
    """

    def __init__(self, network: ConvBEERS, precision: Precision) -> None:
        super().__init__()
        self.network, self.precision = network, precision

    def forward(self, image: Tensor) -> Tensor:
        """(N, 1, H, W) to the same."""
        shallow = self.network.entered(image)
        with torch.autocast(image.device.type, dtype=torch.bfloat16, enabled=self.precision == "bfloat16"):
            deep = self.network.body_end(self.network.body(shallow))
        return image + self.network.left(shallow + deep.float())


class ConditionedMixedPrecision(nn.Module):
    """As `MixedPrecision`, each image with the weights for its own sensor; these are mixed in float32."""

    def __init__(self, network: ConditionedConvBEERS, precision: Precision) -> None:
        super().__init__()
        self.network, self.plain = network, MixedPrecision(network.base, precision)

    def forward(self, image: Tensor, vectors: Tensor) -> Tensor:
        """(N, 1, H, W) and sensor vectors (N, 4) to (N, 1, H, W)."""
        return each_through(self.plain, "network.", self.network.weights(vectors), image)


def in_precision(network: Network, precision: Precision) -> nn.Module:
    """The network as it is trained."""
    if isinstance(network, ConditionedConvBEERS):
        return ConditionedMixedPrecision(network, precision)
    return MixedPrecision(network, precision)
