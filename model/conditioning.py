"""The sensors that a network for every sensor is trained on, and what it is told of each."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from model.specialise import LEAST_ALONG, RANGES, sensor_vector
from profiles.sensor import Sensor

SNR_BRIGHT = (35.0, 220.0)
"""Of the sensors trained on."""

EDGE = 0.05
"""Draws reach this share of a range beyond its ends and are brought back: no draws from outside train the ends."""


def vector_tensor(sensor: Sensor) -> Tensor:
    """The sensor vector (4,) float32, clamped to the ranges."""
    return torch.tensor(sensor_vector(sensor).values)


def transposed(vector: Tensor) -> Tensor:
    """The sensor vector (..., 4) of an image whose rows and columns have changed places: (..., 4)."""
    return vector[..., [1, 0, 2, 3]]


@dataclass(frozen=True)
class SensorFamily:
    """The sensors that a network is trained on: every number log-uniform over its range.

    Attributes:
        like: gives gain and bits; its MTF and noise do not matter.
        snr_bright: at 1/4 of full scale; at 1/16 all that physics allows for it.
    """

    like: Sensor
    snr_bright: tuple[float, float] = SNR_BRIGHT

    def draw(self, generator: np.random.Generator) -> Sensor:
        """One sensor. The MTF along the track is more often near that across than far below it."""
        mtf = _log_uniform(generator, *RANGES["mtf_across"])
        # The square draws more sensors with axes that are nearly alike, as real ones have.
        along = max(mtf * LEAST_ALONG ** float(generator.uniform() ** 2), RANGES["mtf_along"][0])
        full_scale = self.like.max_dn / self.like.gain_dn_per_radiance
        sigma = full_scale / 4 / _log_uniform(generator, *self.snr_bright)
        # Variance alpha L + beta: all of it in alpha halves sigma at a quarter of the radiance, all in beta keeps it.
        dark = sigma * _log_uniform(generator, 0.5, 1.0)
        alpha = max(sigma**2 - dark**2, 0.0) / (full_scale * 3 / 16)
        beta = max(dark**2 - alpha * full_scale / 16, 0.0)
        return Sensor(mtf, alpha, beta, self.like.gain_dn_per_radiance, self.like.bits, {}, along, full_scale / 4)


def _log_uniform(generator: np.random.Generator, low: float, high: float) -> float:
    share = min(max(float(generator.uniform(-EDGE, 1 + EDGE)), 0.0), 1.0)
    return min(low * math.exp(share * math.log(high / low)), high)
