"""Saturation of the detectors, and what spills over along their column."""

import torch
from torch import Tensor

from profiles.effects import FullWell


def saturate(radiance: Tensor, well: FullWell) -> Tensor:
    """L' = min(L + share * (k * max(L - well, 0)), well), in W/m2/sr/um.

    k spreads the excess up and down the column, falling by e every `blooming_px` pixels, and sums to 1 at most
    (what leaves the image is lost). Limits: below the well nothing changes; share 0 is a plain clip.
    """
    excess = (radiance - well.radiance).clamp(min=0)
    if well.blooming_share > 0 and well.blooming_px > 0 and bool((excess > 0).any()):
        radiance = radiance + well.blooming_share * _spread(excess, well.blooming_px)
    return radiance.clamp(max=well.radiance)


def _spread(excess: Tensor, length_px: float) -> Tensor:
    """Convolve each column of (..., H, W) with the two-sided exponential without its centre, normalised."""
    radius = min(int(6 * length_px) + 1, excess.shape[-2] - 1)
    if radius < 1:
        return torch.zeros_like(excess)
    distance = torch.arange(-radius, radius + 1, dtype=torch.float64).abs()
    kernel = torch.exp(-distance / length_px) * (distance > 0)
    if kernel.sum() == 0:  # so short that not even a neighbour is reached
        return torch.zeros_like(excess)
    kernel = (kernel / kernel.sum()).to(excess)
    columns = excess.reshape(-1, 1, *excess.shape[-2:])
    return torch.nn.functional.conv2d(columns, kernel[None, None, :, None], padding=(radius, 0)).reshape(excess.shape)
