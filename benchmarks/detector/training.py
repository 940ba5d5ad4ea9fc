"""Training of the small detector: the pictures, the targets of its map, and the optimiser steps.

The same seed and pictures give the same weights on one machine. Centres are Gaussian bumps as wide
as the object. All cells within a bump are trained on the object's box, weighted by the bump, which
makes training quick (TTFNet: Liu et al., AAAI 2020, arXiv 1909.00700).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from beers_deploy.model.io.pictures import stretch_of
from beers_deploy.model.simulator.acquire import acquire_padded
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import REFERENCE
from benchmarks.detector.network import STRIDE_PX, DetectorNetwork, decoded, initialise
from benchmarks.detector.scenes import synthetic_scene

OVERSAMPLING = 3
"""Scene pixels per pixel of a drawn picture along each axis."""
STREAM = 0x64726177
"""Seed word that separates the training scenes from those that a study draws, for any seed."""


@dataclass(frozen=True)
class Picture:
    """An image as the detector reads it, and the objects in it.

    Attributes:
        image: (3, H, W) uint8.
        corners: (N, 4) float64, x1, y1, x2, y2 in its pixels. Pixel i extends from i to i + 1.
        classes: (N,) int64.
    """

    image: np.ndarray
    corners: np.ndarray
    classes: np.ndarray


def picture_of(rgb: np.ndarray, corners: np.ndarray, classes: np.ndarray) -> Picture:
    """Return a picture from an image (3, H, W) float32 in [0, 1]."""
    return Picture(np.rint(255 * rgb).astype(np.uint8), corners, classes)


def drawn_picture(side_px: int, seed: int, number: int) -> Picture:
    """Simulate the synthetic scene with this number as the reference sensor sees it. The picture
    has its own contrast stretch and is `side_px` pixels a side.
    """
    side = side_px * OVERSAMPLING
    sensor = Sensor.load(REFERENCE).nominal()
    radiance, truth = synthetic_scene(np.random.default_rng([STREAM, seed, number]), side, side)
    dn = acquire_padded(radiance, sensor, OVERSAMPLING, Draw(seed, number), "reference")
    rgb = stretch_of(dn).to_srgb(dn).transpose(2, 0, 1)
    return picture_of(rgb, truth.corners / OVERSAMPLING, truth.classes)


SPREAD = 0.54
"""TTFNet's alpha: half the width of a bump divided by half the width of the object."""
LEAST_SIGMA = 0.35
"""The smallest sigma in cells. An object smaller than a cell is trained in one cell."""
BOX_WEIGHT = 5.0
"""The weight of the box loss relative to the class loss, as in TTFNet."""


@dataclass(frozen=True)
class Targets:
    """The targets of a batch: bumps (N, classes, h, w) in [0, 1], boxes (N, 4, h, w) in input
    pixels, and weights (N, 1, h, w).
    """

    bumps: Tensor
    boxes: Tensor
    weights: Tensor


def targets_of(
    corners: np.ndarray, classes: np.ndarray, count: int, height: int, width: int
) -> list[np.ndarray]:
    """Return bumps, boxes and weights of one image of height x width cells with boxes (N, 4) in its
    pixels.

    Where two objects claim a cell, the cell has the box of the smaller one.
    """
    bumps = np.zeros((count, height, width), np.float32)
    weights = np.zeros((1, height, width), np.float32)
    boxes = np.zeros((4, height, width), np.float32)
    sizes = (corners[:, 2:] - corners[:, :2]).prod(1)
    # The largest object comes first, so that the smaller one has the box where two claim a cell.
    for k in np.argsort(-sizes):
        (rows, columns), bump = _bump(corners[k] / STRIDE_PX, height, width)
        place = bumps[classes[k], rows, columns]
        np.maximum(place, bump, out=place)
        inside = bump > 0
        boxes[:, rows, columns] = np.where(
            inside, corners[k][:, None, None], boxes[:, rows, columns]
        )
        # Every object counts the same in all, and a larger one a little more: the logarithm of its
        # area, in pixels.
        share = bump / bump.sum() * np.log(max(sizes[k], 2.0))
        weights[0, rows, columns] = np.where(inside, share, weights[0, rows, columns])
    return [bumps, boxes, weights]


def _bump(corners: np.ndarray, height: int, width: int) -> tuple[tuple[slice, slice], np.ndarray]:
    """Return the slices of the cells around a box's centre, and the Gaussian there. The box is in
    cells. The Gaussian is 1 in the cell that holds the centre.
    """
    middle = (corners[:2] + corners[2:]) / 2
    half = SPREAD * (corners[2:] - corners[:2]) / 2
    column, row = (int(v) for v in np.clip(np.floor(middle), 0, (width - 1, height - 1)))
    reach_x, reach_y = (int(v) for v in np.floor(half))
    rows = slice(max(row - reach_y, 0), min(row + reach_y + 1, height))
    columns = slice(max(column - reach_x, 0), min(column + reach_x + 1, width))
    y, x = np.ogrid[rows, columns]
    # An object smaller than a cell is learnt in one cell.
    sigma_x, sigma_y = np.maximum((2 * half + 1) / 6, LEAST_SIGMA)
    bump = np.exp(-((x - column) ** 2 / (2 * sigma_x**2) + (y - row) ** 2 / (2 * sigma_y**2)))
    return (rows, columns), bump.astype(np.float32)


def loss_of(output: Tensor, targets: Targets) -> tuple[Tensor, Tensor]:
    """Return the loss of the classes and the loss of the boxes, each of shape (), for a map (N, 4 +
    classes, h, w).
    """
    return focal_loss(output[:, 4:], targets.bumps), BOX_WEIGHT * box_loss(output[:, :4], targets)


def focal_loss(logits: Tensor, bumps: Tensor) -> Tensor:
    """Compute CenterNet's penalty-reduced focal loss, divided by the number of objects."""
    score = torch.sigmoid(logits)
    centre = bumps.eq(1)
    at_centre = (1 - score) ** 2 * functional.logsigmoid(logits) * centre
    # CenterNet lowers the penalty of a cell near a centre by (1 - bump)^4.
    elsewhere = score**2 * functional.logsigmoid(-logits) * (1 - bumps) ** 4 * ~centre
    return -(at_centre + elsewhere).sum() / centre.sum().clamp(min=1)


def box_loss(boxes: Tensor, targets: Targets) -> Tensor:
    """Compute 1 minus the generalised IoU (GIoU: Rezatofighi et al., 2019, arXiv 1902.09630),
    averaged by the weights.
    """
    centre, size = torch.tensor_split(decoded(boxes), 2, dim=1)
    corners = torch.cat([centre - size / 2, centre + size / 2], dim=1)
    overlap = generalised_iou(corners, targets.boxes)
    return (targets.weights * (1 - overlap)).sum() / targets.weights.sum().clamp(min=1)


def generalised_iou(one: Tensor, other: Tensor) -> Tensor:
    """Compute the GIoU (N, 1, h, w) of boxes given as x1, y1, x2, y2 along dimension 1."""
    low = torch.maximum(one[:, :2], other[:, :2])
    high = torch.minimum(one[:, 2:], other[:, 2:])
    shared = (high - low).clamp(min=0).prod(1, keepdim=True)
    areas = sum((boxes[:, 2:] - boxes[:, :2]).prod(1, keepdim=True) for boxes in (one, other))
    hull = (torch.maximum(one[:, 2:], other[:, 2:]) - torch.minimum(one[:, :2], other[:, :2])).prod(
        1, keepdim=True
    )
    union = areas - shared
    result: Tensor = shared / union.clamp(min=1e-6) - (hull - union) / hull.clamp(min=1e-6)
    return result


@dataclass(frozen=True)
class DetectorRecipe:
    """The settings with which a detector is trained.

    Attributes:
        steps: the number of steps of the optimiser, AdamW.
        batch: pictures per step.
        learning_rate: the peak, after a warm-up over a twentieth of the steps and before a cosine
            decay to zero.
        weight_decay: the weight decay of AdamW.
        seed: determines the weights, and the order, rotation and mirroring of the pictures.
        precision: of the convolutions. The losses are computed in float32.
    """

    steps: int = 2000
    batch: int = 8
    learning_rate: float = 3e-3
    weight_decay: float = 1e-3
    seed: int = 0
    precision: Literal["float32", "bfloat16"] = "float32"

    def rate_at(self, step: int) -> float:
        """Return the learning rate of a step."""
        warm = max(self.steps // 20, 1)
        return self.learning_rate * min(
            (step + 1) / warm, 0.5 + 0.5 * math.cos(math.pi * step / self.steps)
        )


def train_detector(
    pictures: Sequence[Picture],
    classes: int,
    recipe: DetectorRecipe,
    tick: Callable[[float], None] = lambda _: None,
) -> DetectorNetwork:
    """Train a detector. Each picture is rotated and mirrored at random whenever it is drawn.

    Args:
        pictures: all of one size, sides multiples of 8.
        classes: the number of classes.
        recipe: the settings of the training.
        tick: is called after each step with its loss.

    Returns:
        The network with the running average of the weights, in evaluation mode.

    Raises:
        ModelError: the loss is not finite.
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
    averaged = DetectorNetwork(classes)
    averaged.load_state_dict(average)
    return averaged.eval()


def _step(
    network: DetectorNetwork,
    optimiser: torch.optim.Optimizer,
    images: Tensor,
    targets: Targets,
    precision: str,
) -> float:
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=precision == "bfloat16"):
        output = network(images)
    # Only the convolutions are in bfloat16. The losses are computed in float32.
    loss = torch.stack(loss_of(output.float(), targets)).sum()
    value = float(loss.detach())
    if not math.isfinite(value):
        raise ModelError(
            f"The loss of the detector is {value}. Train with a lower learning rate, and check "
            "the boxes."
        )
    optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
    optimiser.step()
    return value


def _average(average: dict[str, Tensor], network: DetectorNetwork, step: int) -> None:
    """Update the running average, fast at first. Otherwise the random initial weights would persist
    for long.
    """
    decay = min(0.998, (1 + step) / (10 + step))
    for name, value in network.state_dict().items():
        if value.is_floating_point():
            average[name].lerp_(value, 1 - decay)


def _batch(
    pictures: Sequence[Picture], classes: int, count: int, generator: np.random.Generator
) -> tuple[Tensor, Targets]:
    """Draw pictures with replacement, each in one of the square's eight symmetries and slightly
    lighter or darker.
    """
    batch = [
        turned(pictures[int(k)], generator) for k in generator.integers(len(pictures), size=count)
    ]
    images = np.stack([_lit(picture.image, generator) for picture in batch])
    height, width = (side // STRIDE_PX for side in images.shape[2:])
    targets = [targets_of(p.corners, p.classes, classes, height, width) for p in batch]
    bumps, boxes, weights = (
        torch.from_numpy(np.stack(kind)) for kind in zip(*targets, strict=True)
    )
    return torch.from_numpy(images).contiguous(memory_format=torch.channels_last), Targets(
        bumps, boxes, weights
    )


def _lit(image: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return an image (3, H, W) uint8 as float32 in [0, 1], raised to a random power near 1."""
    power = np.float32(math.exp(generator.normal(0, 0.1)))
    return np.asarray((image.astype(np.float32) / 255) ** power)


def turned(picture: Picture, generator: np.random.Generator) -> Picture:
    """Return a square picture, with its boxes, in one of the square's eight symmetries."""
    image = picture.image
    corners = picture.corners
    height, width = image.shape[1:]
    if generator.random() < 0.5:
        image = image[..., ::-1]
        corners = np.stack(
            [width - corners[:, 2], corners[:, 1], width - corners[:, 0], corners[:, 3]], axis=1
        )
    if generator.random() < 0.5:
        image = image[:, ::-1]
        corners = np.stack(
            [corners[:, 0], height - corners[:, 3], corners[:, 2], height - corners[:, 1]], axis=1
        )
    if generator.random() < 0.5 and height == width:
        image = image.transpose(0, 2, 1)
        corners = corners[:, [1, 0, 3, 2]]
    return Picture(image, corners, picture.classes)
