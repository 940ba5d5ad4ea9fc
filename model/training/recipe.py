"""What decides the weights, besides the pairs."""

import math
from dataclasses import asdict, dataclass
from typing import Literal

from model.training.losses import PAPER, LossWeights
from profiles.errors import OptionError

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
