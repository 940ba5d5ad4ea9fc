"""What the map of a detector should say, and how far it is from that.

Centres are Gaussian bumps, as wide as the object; the boxes of all cells within a bump are held to the object's, each
weighed by the bump: it is what makes training quick (TTFNet: Liu et al., AAAI 2020, arXiv 1909.00700).
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from benchmarks.detector.network import STRIDE_PX, decoded

SPREAD = 0.54
"""TTFNet's alpha: half the width of a bump over half the object's."""
LEAST_SIGMA = 0.35
"""In cells: an object smaller than a cell is learnt in one."""
BOX_WEIGHT = 5.0
"""Of the boxes' loss against that of the classes, as in TTFNet."""


@dataclass(frozen=True)
class Targets:
    """For a batch: bumps (N, classes, h, w) in [0, 1], boxes (N, 4, h, w) in input pixels, weights (N, 1, h, w)."""

    bumps: Tensor
    boxes: Tensor
    weights: Tensor


def targets_of(corners: np.ndarray, classes: np.ndarray, count: int, height: int, width: int) -> list[np.ndarray]:
    """The targets of one image of height x width cells with boxes (N, 4) in its pixels: bumps, boxes, weights.

    Where two objects claim a cell, the smaller one has its box.
    """
    bumps, weights = np.zeros((count, height, width), np.float32), np.zeros((1, height, width), np.float32)
    boxes = np.zeros((4, height, width), np.float32)
    sizes = (corners[:, 2:] - corners[:, :2]).prod(1)
    for k in np.argsort(-sizes):
        (rows, columns), bump = _bump(corners[k] / STRIDE_PX, height, width)
        place = bumps[classes[k], rows, columns]
        np.maximum(place, bump, out=place)
        inside = bump > 0
        boxes[:, rows, columns] = np.where(inside, corners[k][:, None, None], boxes[:, rows, columns])
        # Every object counts the same in all, and a larger one a little more: the logarithm of its area, in pixels.
        share = bump / bump.sum() * np.log(max(sizes[k], 2.0))
        weights[0, rows, columns] = np.where(inside, share, weights[0, rows, columns])
    return [bumps, boxes, weights]


def _bump(corners: np.ndarray, height: int, width: int) -> tuple[tuple[slice, slice], np.ndarray]:
    """The cells around the centre of a box in cells, and the Gaussian there: 1 in the cell that holds the centre."""
    middle, half = (corners[:2] + corners[2:]) / 2, SPREAD * (corners[2:] - corners[:2]) / 2
    column, row = (int(v) for v in np.clip(np.floor(middle), 0, (width - 1, height - 1)))
    reach_x, reach_y = (int(v) for v in np.floor(half))
    rows = slice(max(row - reach_y, 0), min(row + reach_y + 1, height))
    columns = slice(max(column - reach_x, 0), min(column + reach_x + 1, width))
    y, x = np.ogrid[rows, columns]
    sigma_x, sigma_y = np.maximum((2 * half + 1) / 6, LEAST_SIGMA)
    bump = np.exp(-((x - column) ** 2 / (2 * sigma_x**2) + (y - row) ** 2 / (2 * sigma_y**2)))
    return (rows, columns), bump.astype(np.float32)


def loss_of(found: Tensor, targets: Targets) -> tuple[Tensor, Tensor]:
    """The losses of classes and boxes, () each, of a map (N, 4 + classes, h, w)."""
    return focal_loss(found[:, 4:], targets.bumps), BOX_WEIGHT * box_loss(found[:, :4], targets)


def focal_loss(logits: Tensor, bumps: Tensor) -> Tensor:
    """CenterNet's penalty-reduced focal loss, over the number of objects."""
    score, centre = torch.sigmoid(logits), bumps.eq(1)
    at_centre = (1 - score) ** 2 * functional.logsigmoid(logits) * centre
    elsewhere = score**2 * functional.logsigmoid(-logits) * (1 - bumps) ** 4 * ~centre
    return -(at_centre + elsewhere).sum() / centre.sum().clamp(min=1)


def box_loss(boxes: Tensor, targets: Targets) -> Tensor:
    """1 less the generalised overlap (GIoU: Rezatofighi et al., 2019, arXiv 1902.09630), weighed."""
    centre, size = torch.tensor_split(decoded(boxes), 2, dim=1)
    found = torch.cat([centre - size / 2, centre + size / 2], dim=1)
    overlap = generalised_iou(found, targets.boxes)
    return (targets.weights * (1 - overlap)).sum() / targets.weights.sum().clamp(min=1)


def generalised_iou(one: Tensor, other: Tensor) -> Tensor:
    """GIoU (N, 1, h, w) of boxes x1, y1, x2, y2 along dimension 1."""
    low, high = torch.maximum(one[:, :2], other[:, :2]), torch.minimum(one[:, 2:], other[:, 2:])
    shared = (high - low).clamp(min=0).prod(1, keepdim=True)
    areas = sum((each[:, 2:] - each[:, :2]).prod(1, keepdim=True) for each in (one, other))
    hull = (torch.maximum(one[:, 2:], other[:, 2:]) - torch.minimum(one[:, :2], other[:, :2])).prod(1, keepdim=True)
    union = areas - shared
    result: Tensor = shared / union.clamp(min=1e-6) - (hull - union) / hull.clamp(min=1e-6)
    return result
