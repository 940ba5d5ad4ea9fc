"""Signal-dependent noise: the variance grows with the light."""

import numpy as np
import torch
from torch import Tensor

from profiles.sensor import Sensor

NOISE_LIMIT = 6.0
"""Draws are clipped here (two in a billion), so that the effect of noise has a bound."""


def noise_sigma(radiance: Tensor, sensor: Sensor) -> Tensor:
    """sigma(L) = sqrt(alpha L + beta), in W/m2/sr/um (paper, section 3.3).

    Ringing can push L below zero, where there is no light to be noisy about: L counts as 0 there. A negative
    variance (possible only for a sensor built by hand) counts as 0 too.
    """
    return (sensor.alpha * radiance.clamp(min=0) + sensor.beta).clamp(min=0).sqrt()


def add_noise(radiance: Tensor, sensor: Sensor, generator: np.random.Generator) -> Tensor:
    """L + sigma(L) * n, n standard normal and independent per pixel; shape and device kept."""
    normal = generator.standard_normal(tuple(radiance.shape), dtype=np.float32)
    np.clip(normal, -NOISE_LIMIT, NOISE_LIMIT, out=normal)
    return radiance + noise_sigma(radiance, sensor) * torch.from_numpy(normal).to(radiance.device)
