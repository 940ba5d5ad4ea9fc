"""The training loss of a hard case beside a noisy copy of it: finite, its gradient finite and bounded."""

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from deploy.stress.cases import FULL_DN, Case
from deploy.stress.checks import Measure
from deploy.stress.subject import Subject
from model.metrics.backbone_files import read_tensors
from model.metrics.backbones import Backbone
from model.metrics.perceptual import PUBLISHED, Lpips
from model.training.losses import LossWeights, RestorationLoss

NOISE = 5.0 / FULL_DN
RELATIVE = 1e-4
LPIPS_GRADIENT = 1e4


def losses(_: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """L1 + 0.1 FFT, and LPIPS over a backbone of random weights; of lost pixels none may give a number."""
    reference = torch.from_numpy(np.asarray(image, np.float32) / np.float32(FULL_DN))[None, None]
    noise = np.random.default_rng(0).standard_normal(image.shape).astype(np.float32)
    restored = reference + torch.from_numpy(NOISE * noise)
    if case.pixels in ("missing", "infinite"):
        value, _gradient = _with_gradient(RestorationLoss(), restored, reference)
        return [Measure("number from lost pixels", float(math.isfinite(value)), 0, "figures")]
    pairs = ((restored, reference), (reference, reference))
    measures = [measure for pair in pairs for measure in _loss(*pair)]
    if case.large or min(image.shape) < _lpips().backbone.spec.min_side_px:
        return measures
    return [*measures, *(measure for pair in pairs for measure in _perceptual(*pair))]


def _loss(restored: Tensor, reference: Tensor) -> list[Measure]:
    loss = RestorationLoss()
    value, gradient = _with_gradient(loss, restored, reference)
    again, gradient_again = _with_gradient(loss, restored, reference)
    pixels = gradient.numel()
    # Of the mean size of F, orthonormal, each pixel moves every F by 1 / sqrt(pixels) at most: proven.
    allowed = 1 + loss.weights.fft * math.sqrt(pixels)
    exact = _float64(loss.weights, restored.double(), reference.double())
    return [
        _lost(value, gradient),
        Measure("runs differ", float(value != again) + float((gradient != gradient_again).sum()), 0, "px"),
        Measure("gradient beyond its proof", pixels * float(gradient.abs().max()) / allowed, 1 + RELATIVE, "times"),
        Measure("error against float64", abs(value - exact) / max(exact, NOISE), RELATIVE, "relative"),
    ]


def _perceptual(restored: Tensor, reference: Tensor) -> list[Measure]:
    value, gradient = _with_gradient(_lpips(), restored, reference)
    largest = gradient.numel() * float(gradient.abs().max())
    return [_lost(value, gradient), Measure("LPIPS gradient", largest, LPIPS_GRADIENT, "per pixel")]


def _lost(value: float, gradient: Tensor) -> Measure:
    lost = float((~torch.isfinite(gradient)).sum()) + float(not math.isfinite(value))
    return Measure("not finite", lost, 0, "px")


def _with_gradient(loss: "RestorationLoss | Lpips", restored: Tensor, reference: Tensor) -> tuple[float, Tensor]:
    image = restored.clone().requires_grad_()
    result = loss(image, reference)
    total = result[0] if isinstance(result, tuple) else result.mean()
    total.backward()
    assert image.grad is not None  # noqa: S101 - it was asked for
    return float(total.detach()), image.grad


def _float64(weights: LossWeights, restored: Tensor, reference: Tensor) -> float:
    difference = restored - reference
    spectrum = torch.fft.rfft2(difference, norm="ortho").abs().mean()
    return float(weights.l1 * difference.abs().mean() + weights.fft * spectrum)


@lru_cache(maxsize=1)
def _lpips() -> Lpips:
    """Random weights: what is looked at is the arithmetic, not the figure."""
    generator = torch.Generator().manual_seed(0)
    backbone = Backbone("squeeze")
    with torch.no_grad():
        for value in backbone.parameters():
            value.normal_(0, 0.05, generator=generator)
    names = [f"lin{layer}" for layer in range(len(backbone.spec.taps))]
    heads = read_tensors(PUBLISHED / "lpips-squeeze.safetensors", names)
    return Lpips(backbone, [heads[name] for name in names])
