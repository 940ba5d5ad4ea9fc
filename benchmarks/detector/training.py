"""Make the small detector: draw synthetic pictures, train, write its file, and evaluate it.

    OMP_NUM_THREADS=1 python -m benchmarks.detector.training [FILE]

The file is detector.onnx in this folder, or FILE. The same machine produces the same bytes.
Training takes most of the time: detector.md reports how long. --steps, --pictures and --held-out
shorten it for a trial.

Centres are Gaussian bumps as wide as the object. All cells within a bump are trained on the
object's box, weighted by the bump, which makes training quick (TTFNet: Liu et al., AAAI 2020, arXiv
1909.00700).
"""

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from beers_deploy.model.io.pictures import stretch_of
from beers_deploy.model.progress import steps
from beers_deploy.model.simulator.acquire import acquire_padded
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import REFERENCE
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.studies.detection.average_precision import interval, score, site_weights
from beers_deploy.studies.detection.boxes import Boxes
from beers_deploy.studies.detection.detector import open_detector
from beers_deploy.studies.detection.matching import find_hits
from benchmarks.detector.network import (
    DETECTOR,
    STRIDE_PX,
    DetectorNetwork,
    decoded,
    detector_to_onnx,
    initialise,
)
from benchmarks.detector.scenes import CLASSES, synthetic_scene

SIDE_PX = 256
OVERSAMPLING = 3
"""Scene pixels per pixel of a drawn picture along each axis."""
STREAM = 0x64726177
"""Seed word that separates the training scenes from those that a study draws, for any seed."""
ALPHA = 0.54
"""TTFNet's alpha: half the width of a bump divided by half the width of the object."""
MIN_SIGMA = 0.35
"""The smallest sigma in cells. An object smaller than a cell is trained in one cell."""
BOX_WEIGHT = 5.0
"""The weight of the box loss relative to the class loss, as in TTFNet."""


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


def drawn_picture(side_px: int, seed: int, number: int) -> Picture:
    """Simulate the synthetic scene with this number as the reference sensor sees it. The picture
    has its own contrast stretch and is `side_px` pixels a side.
    """
    side = side_px * OVERSAMPLING
    sensor = Sensor.load(REFERENCE).nominal()
    radiance, truth = synthetic_scene(np.random.default_rng([STREAM, seed, number]), side, side)
    dn = acquire_padded(radiance, sensor, OVERSAMPLING, Draw(seed, number), "reference")
    rgb = np.rint(255 * stretch_of(dn).to_srgb(dn)).astype(np.uint8)
    return Picture(rgb.transpose(2, 0, 1), truth.corners / OVERSAMPLING, truth.classes)


def targets_of(picture: Picture, classes: int) -> list[np.ndarray]:
    """Return bumps (classes, h, w), boxes (4, h, w) in pixels, and weights (1, h, w) of the cells
    of a picture.

    Where two objects claim a cell, the cell has the box of the smaller one.
    """
    height, width = (side // STRIDE_PX for side in picture.image.shape[1:])
    bumps = np.zeros((classes, height, width), np.float32)
    weights = np.zeros((1, height, width), np.float32)
    boxes = np.zeros((4, height, width), np.float32)
    corners = picture.corners
    sizes = (corners[:, 2:] - corners[:, :2]).prod(1)
    # The largest object comes first, so that the smaller one has the box where two claim a cell.
    for k in np.argsort(-sizes):
        (rows, columns), bump = _bump(corners[k] / STRIDE_PX, height, width)
        place = bumps[picture.classes[k], rows, columns]
        np.maximum(place, bump, out=place)
        boxes[:, rows, columns] = corners[k][:, None, None]
        # Every object counts the same in all, and a larger one a little more: the logarithm of its
        # area, in pixels.
        weights[0, rows, columns] = bump / bump.sum() * np.log(max(sizes[k], 2.0))
    return [bumps, boxes, weights]


def _bump(corners: np.ndarray, height: int, width: int) -> tuple[tuple[slice, slice], np.ndarray]:
    """Return the slices of the cells around a box's centre, and the Gaussian there. The box is in
    cells. The Gaussian is 1 in the cell that holds the centre.
    """
    middle = (corners[:2] + corners[2:]) / 2
    half = ALPHA * (corners[2:] - corners[:2]) / 2
    column, row = (int(v) for v in np.clip(np.floor(middle), 0, (width - 1, height - 1)))
    reach_x, reach_y = (int(v) for v in np.floor(half))
    rows = slice(max(row - reach_y, 0), row + reach_y + 1)
    columns = slice(max(column - reach_x, 0), column + reach_x + 1)
    y, x = np.ogrid[:height, :width]
    sigma_x, sigma_y = np.maximum((2 * half + 1) / 6, MIN_SIGMA)
    bump = np.exp(-((x - column) ** 2 / (2 * sigma_x**2) + (y - row) ** 2 / (2 * sigma_y**2)))
    return (rows, columns), bump[rows, columns].astype(np.float32)


def focal_loss(logits: Tensor, bumps: Tensor) -> Tensor:
    """Compute CenterNet's penalty-reduced focal loss, divided by the number of objects."""
    score = torch.sigmoid(logits)
    centre = bumps.eq(1)
    at_centre = (1 - score) ** 2 * functional.logsigmoid(logits) * centre
    # CenterNet lowers the penalty of a cell near a centre by (1 - bump)^4.
    elsewhere = score**2 * functional.logsigmoid(-logits) * (1 - bumps) ** 4 * ~centre
    return -(at_centre + elsewhere).sum() / centre.sum().clamp(min=1)


def box_loss(output: Tensor, boxes: Tensor, weights: Tensor) -> Tensor:
    """Compute 1 minus the generalised IoU (GIoU: Rezatofighi et al., 2019, arXiv 1902.09630) of the
    boxes of a map (N, 4, h, w), averaged by the weights.
    """
    centre, size = torch.tensor_split(decoded(output), 2, dim=1)
    one_low = centre - size / 2
    one_high = centre + size / 2
    low, high = torch.tensor_split(boxes, 2, dim=1)
    sides = torch.minimum(one_high, high) - torch.maximum(one_low, low)
    shared = sides.clamp(min=0).prod(1, keepdim=True)
    areas = (one_high - one_low).prod(1, keepdim=True) + (high - low).prod(1, keepdim=True)
    spanned = torch.maximum(one_high, high) - torch.minimum(one_low, low)
    hull = spanned.prod(1, keepdim=True)
    union = areas - shared
    overlap = shared / union.clamp(min=1e-6) - (hull - union) / hull.clamp(min=1e-6)
    return (weights * (1 - overlap)).sum() / weights.sum().clamp(min=1)


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
    precision: str = "bfloat16"

    def rate_at(self, step: int) -> float:
        """Return the learning rate of a step."""
        warm = max(self.steps // 20, 1)
        return self.learning_rate * min(
            (step + 1) / warm, 0.5 + 0.5 * math.cos(math.pi * step / self.steps)
        )


def train_detector(
    pictures: Sequence[Picture], classes: int, recipe: DetectorRecipe
) -> DetectorNetwork:
    """Train a detector. Each picture is rotated and mirrored at random whenever it is drawn.

    Args:
        pictures: square, all of one size, sides multiples of 8.
        classes: the number of classes.
        recipe: the settings of the training.

    Returns:
        The network with the running average of the weights, in evaluation mode.
    """
    network = DetectorNetwork(classes)
    initialise(network, torch.Generator().manual_seed(recipe.seed))
    network.to(memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    averaged = DetectorNetwork(classes)
    averaged.load_state_dict(network.state_dict())
    average = averaged.state_dict()
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=recipe.weight_decay)
    generator = np.random.default_rng([recipe.seed, len(pictures)])
    with steps("training", recipe.steps) as bar:
        for step in range(recipe.steps):
            for group in optimiser.param_groups:
                group["lr"] = recipe.rate_at(step)
            drawn = generator.integers(len(pictures), size=recipe.batch)
            batch = [turned(pictures[int(k)], generator) for k in drawn]
            images = np.stack([_lit(picture.image, generator) for picture in batch])
            targets = zip(*(targets_of(picture, classes) for picture in batch), strict=True)
            bumps, boxes, weights = (torch.from_numpy(np.stack(kind)) for kind in targets)
            stacked = torch.from_numpy(images).contiguous(memory_format=torch.channels_last)
            with torch.autocast("cpu", dtype=getattr(torch, recipe.precision)):
                output = network(stacked)
            # Only the convolutions are in bfloat16. The losses are computed in float32.
            output = output.float()
            of_boxes = BOX_WEIGHT * box_loss(output[:, :4], boxes, weights)
            loss = focal_loss(output[:, 4:], bumps) + of_boxes
            optimiser.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
            optimiser.step()
            # Fast at first: otherwise the random initial weights would persist for long.
            decay = min(0.998, (1 + step) / (10 + step))
            for name, value in network.state_dict().items():
                if value.is_floating_point():
                    average[name].lerp_(value, 1 - decay)
            bar.advance(note=f"loss {float(loss.detach()):.2f}")
    return averaged.eval()


def _lit(image: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return an image (3, H, W) uint8 as float32 in [0, 1], raised to a random power near 1."""
    power = np.float32(math.exp(generator.normal(0, 0.1)))
    return np.asarray((image.astype(np.float32) / 255) ** power)


def turned(picture: Picture, generator: np.random.Generator) -> Picture:
    """Return a square picture, with its boxes, in one of the square's eight symmetries."""
    image = picture.image
    corners = picture.corners
    side = image.shape[1]
    if generator.random() < 0.5:
        image = image[..., ::-1]
        corners = np.abs(np.array([side, 0, side, 0]) - corners[:, [2, 1, 0, 3]])
    if generator.random() < 0.5:
        image = image[:, ::-1]
        corners = np.abs(np.array([0, side, 0, side]) - corners[:, [0, 3, 2, 1]])
    if generator.random() < 0.5:
        image = image.transpose(0, 2, 1)
        corners = corners[:, [1, 0, 3, 2]]
    return Picture(image, corners, picture.classes)


def judge(pictures: Sequence[Picture], file: Path) -> None:
    """Print the average precisions with intervals, on pictures that were not used for training."""
    truths = [Boxes.of(picture.corners, picture.classes) for picture in pictures]
    detector = open_detector(file)
    detections = [
        detector.detect((picture.image.astype(np.float32) / 255).transpose(1, 2, 0))
        for picture in pictures
    ]
    hits = find_hits(truths, detections, len(CLASSES))
    values = score(hits, CLASSES, site_weights([str(k) for k in range(len(pictures))], 0))
    for key in ("mAP50", "mAP50-95", *(f"mAP50 of {name}" for name in CLASSES)):
        print(key, f"{values[key][0]:.4f}", interval(values[key], len(pictures)))


def main() -> None:
    """Draw the pictures, train the detector and evaluate it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", nargs="?", type=Path, default=DETECTOR)
    parser.add_argument("--pictures", type=int, default=400, help="drawn for training")
    parser.add_argument("--held-out", type=int, default=60, help="drawn from another seed to judge")
    parser.add_argument("--steps", type=int, default=DetectorRecipe.steps)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    recipe = replace(DetectorRecipe(), steps=arguments.steps)
    pictures = [drawn_picture(SIDE_PX, 0, number) for number in range(arguments.pictures)]
    network = train_detector(pictures, len(CLASSES), recipe)
    save_onnx(detector_to_onnx(network, CLASSES, SIDE_PX, str(recipe)), arguments.file)
    held_out = [drawn_picture(SIDE_PX, 1, number) for number in range(arguments.held_out)]
    judge(held_out, arguments.file)


if __name__ == "__main__":
    main()
