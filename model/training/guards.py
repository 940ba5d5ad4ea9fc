"""What stops a run that has gone wrong, with a sentence instead of a night of wasted steps."""

import math

import torch

from beers_deploy.model.convbeers import Network, told
from beers_deploy.model.family import RANGES
from beers_deploy.profiles.errors import ModelError

MAX_BAD_STEPS = 10
WINDOW_STEPS = 200
TEST_PLACES = 65
DIVERGED = 5.0
"""A mean loss this many times the best one so far is no fluctuation: batches vary by a factor of two."""


class Guards:
    """Counts skipped steps, and compares the loss of each window of steps with the best window so far.

    Attributes:
        bad_steps: steps whose gradient was not finite: skipped.
        best: the lowest mean loss of a window.
    """

    def __init__(self, bad_steps: int = 0, best: float = math.inf) -> None:
        self.bad_steps, self.best = bad_steps, best
        self._sum, self._count = 0.0, 0

    def skipped(self, step: int) -> None:
        """Count a step whose loss or gradient was not finite."""
        self.bad_steps += 1
        if self.bad_steps > MAX_BAD_STEPS:
            raise _error(step, "a finite loss", f"{self.bad_steps} non-finite steps")

    def passed(self, step: int, loss: float) -> None:
        """Take note of a step's loss."""
        self._sum, self._count = self._sum + loss, self._count + 1
        if self._count < WINDOW_STEPS:
            return
        mean, self._sum, self._count = self._sum / self._count, 0.0, 0
        if mean > DIVERGED * self.best:
            raise _error(step, f"a loss near {self.best:.4g}", f"{mean:.4g}: it diverged")
        self.best = min(self.best, mean)

    def to_json(self) -> dict[str, object]:
        """What a resumed run must know."""
        best = self.best if math.isfinite(self.best) else None
        return {"bad_steps": self.bad_steps, "best": best, "sum": self._sum, "count": self._count}

    @classmethod
    def from_json(cls, kept: dict[str, object]) -> "Guards":
        """The guards as they were."""
        best = kept["best"]
        guards = cls(int(str(kept["bad_steps"])), math.inf if best is None else float(str(best)))
        guards._sum, guards._count = float(str(kept["sum"])), int(str(kept["count"]))
        return guards


def require_finite_output(network: Network, where: str, remedy: str = "lower the learning rate") -> None:
    """Refuse a network that makes NaN or infinity of an image in [0, 1]: its weights may be finite all the same.

    Args:
        network: on the CPU; a conditioned one is told the middle of every range.
        where: what to name in the message.
        remedy: what to do about it.
    """
    side_px = network.variant.scale * TEST_PLACES
    image = torch.rand((1, 1, side_px, side_px), generator=torch.Generator().manual_seed(0))
    images = torch.cat([torch.zeros_like(image), image, torch.ones_like(image)])
    with torch.inference_mode():
        restored = told(network, torch.zeros(len(RANGES)))(images)
    if not bool(torch.isfinite(restored).all()):
        raise ModelError(where, expected="finite pixels of a test image", got="NaN or infinity", remedy=remedy)


def _error(step: int, expected: str, got: str) -> ModelError:
    remedy = "lower the learning rate or check the images"
    return ModelError(f"training step {step}", expected=expected, got=got, remedy=remedy)
