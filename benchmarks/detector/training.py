"""Training of the small detector, and its file: the same seed and pictures give the same weights on one machine."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from beers_deploy.profiles.errors import ModelError
from benchmarks.detector.network import STRIDE_PX, DetectorNetwork, initialise
from benchmarks.detector.pictures import Picture
from benchmarks.detector.targets import Targets, loss_of, targets_of


@dataclass(frozen=True)
class DetectorRecipe:
    """How a detector is trained.

    Attributes:
        steps: of the optimiser, AdamW.
        batch: pictures a step.
        learning_rate: at its height, behind a twentieth of the steps of warm-up and before a cosine to zero.
        weight_decay: AdamW's.
        seed: of the weights, and of the order and the turning of the pictures.
        precision: of the convolutions; the losses are in float32.
    """

    steps: int = 2000
    batch: int = 8
    learning_rate: float = 3e-3
    weight_decay: float = 1e-3
    seed: int = 0
    precision: Literal["float32", "bfloat16"] = "float32"

    def rate_at(self, step: int) -> float:
        """The learning rate of a step."""
        warm = max(self.steps // 20, 1)
        return self.learning_rate * min((step + 1) / warm, 0.5 + 0.5 * math.cos(math.pi * step / self.steps))


def train_detector(
    pictures: Sequence[Picture],
    classes: int,
    recipe: DetectorRecipe,
    tick: Callable[[float], None] = lambda _: None,
) -> DetectorNetwork:
    """Train a detector, each picture turned and mirrored anew at each visit.

    Args:
        pictures: all of one size, sides multiples of 8.
        classes: how many there are.
        recipe: the steps.
        tick: called after each step with its loss.

    Returns:
        The running average of the weights, in evaluation mode.

    Raises:
        ModelError: the loss is no finite number.
    """
    network = DetectorNetwork(classes)
    initialise(network, torch.Generator().manual_seed(recipe.seed))
    network.to(memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    average = {name: value.detach().clone() for name, value in network.state_dict().items()}
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=recipe.weight_decay)
    generator = np.random.default_rng([recipe.seed, len(pictures)])
    for step in range(recipe.steps):
        for group in optimiser.param_groups:
            group["lr"] = recipe.rate_at(step)
        images, targets = _batch(pictures, classes, recipe.batch, generator)
        loss = _step(network, optimiser, images, targets, recipe.precision)
        _average(average, network, step)
        tick(loss)
    return _averaged(average, classes)


def _step(
    network: DetectorNetwork, optimiser: torch.optim.Optimizer, images: Tensor, targets: Targets, precision: str
) -> float:
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=precision == "bfloat16"):
        found = network(images)
    loss = torch.stack(loss_of(found.float(), targets)).sum()
    value = float(loss.detach())
    if not math.isfinite(value):
        remedy = "train with a lower learning rate, and look at the boxes"
        raise ModelError("detector", expected="a finite loss", got=str(value), remedy=remedy)
    optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
    optimiser.step()
    return value


def _average(average: dict[str, Tensor], network: DetectorNetwork, step: int) -> None:
    """Follow the weights fast at first, or the first random ones would stay for long."""
    decay = min(0.998, (1 + step) / (10 + step))
    for name, value in network.state_dict().items():
        if value.is_floating_point():
            average[name].lerp_(value, 1 - decay)


def _averaged(average: dict[str, Tensor], classes: int) -> DetectorNetwork:
    network = DetectorNetwork(classes)
    network.load_state_dict(average)
    return network.eval()


def _batch(
    pictures: Sequence[Picture], classes: int, count: int, generator: np.random.Generator
) -> tuple[Tensor, Targets]:
    """Pictures drawn with replacement, each in one of the square's eight symmetries, a little lighter or darker."""
    chosen = [turned(pictures[int(k)], generator) for k in generator.integers(len(pictures), size=count)]
    images = np.stack([_lit(picture.image, generator) for picture in chosen])
    height, width = (side // STRIDE_PX for side in images.shape[2:])
    each = [targets_of(p.corners, p.classes, classes, height, width) for p in chosen]
    bumps, boxes, weights = (torch.from_numpy(np.stack(kind)) for kind in zip(*each, strict=True))
    return torch.from_numpy(images).contiguous(memory_format=torch.channels_last), Targets(bumps, boxes, weights)


def _lit(image: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """An image (3, H, W) uint8 as float32 in [0, 1], its curve bent by a power near 1."""
    power = np.float32(math.exp(generator.normal(0, 0.1)))
    return np.asarray((image.astype(np.float32) / 255) ** power)


def turned(picture: Picture, generator: np.random.Generator) -> Picture:
    """A picture of equal sides in one of the square's eight symmetries, its boxes with it."""
    image, corners = picture.image, picture.corners
    height, width = image.shape[1:]
    if generator.random() < 0.5:
        image = image[..., ::-1]
        corners = np.stack([width - corners[:, 2], corners[:, 1], width - corners[:, 0], corners[:, 3]], axis=1)
    if generator.random() < 0.5:
        image = image[:, ::-1]
        corners = np.stack([corners[:, 0], height - corners[:, 3], corners[:, 2], height - corners[:, 1]], axis=1)
    if generator.random() < 0.5 and height == width:
        image, corners = image.transpose(0, 2, 1), corners[:, [1, 0, 3, 2]]
    return Picture(image, corners, picture.classes)
