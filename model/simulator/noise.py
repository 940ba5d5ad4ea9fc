"""Signal-dependent noise: the variance grows with the light."""

import numpy as np
import torch
from torch import Tensor

from profiles.sensor import Sensor


def noise_sigma(radiance: Tensor, sensor: Sensor) -> Tensor:
    """sigma(L) = sqrt(alpha L + beta), in W/m2/sr/um (paper, section 3.3).

    Ringing can push L below zero, where there is no light to be noisy about: L counts as 0 there. A negative
    variance (possible only for a sensor built by hand) counts as 0 too.
    """
    return (sensor.alpha * radiance.clamp(min=0) + sensor.beta).clamp(min=0).sqrt()


def add_noise(radiance: Tensor, sensor: Sensor, generator: np.random.Generator) -> Tensor:
    """L + sigma(L) * n, n standard normal and independent per pixel; shape and device kept."""
    normal = torch.from_numpy(generator.standard_normal(tuple(radiance.shape), dtype=np.float32))
    return radiance + noise_sigma(radiance, sensor) * normal.to(radiance.device)
