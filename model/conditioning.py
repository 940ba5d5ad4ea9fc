"""The network that is conditioned on its sensor, as it is trained: one set of weights for a whole range of sensors.

What it is given of a sensor, and how it becomes a plain network for one, says `model.specialise`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call

from model.convbeers import ConvBEERS, plain_network
from model.specialise import DIRECTIONS, HIDDEN, LEAST_ALONG, RANGES, SensorVector, sensor_vector, specialised
from model.variants import Variant
from profiles.sensor import Sensor

SNR_BRIGHT = (35.0, 220.0)
"""Of the sensors trained on, at 1/4 of full scale; at 1/16 all that physics allows for it."""

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
    """The sensors that a conditioned network is trained on: every number log-uniform over its range.

    Attributes:
        like: gives gain and bits; its MTF and noise do not matter.
    """

    like: Sensor

    def draw(self, generator: np.random.Generator) -> Sensor:
        """One sensor. The MTF along the track is more often near that across than far below it."""
        mtf = _log_uniform(generator, *RANGES["mtf_across"])
        # The square draws more sensors with axes that are nearly alike, as real ones have.
        along = max(mtf * LEAST_ALONG ** float(generator.uniform() ** 2), RANGES["mtf_along"][0])
        full_scale = self.like.max_dn / self.like.gain_dn_per_radiance
        sigma = full_scale / 4 / _log_uniform(generator, *SNR_BRIGHT)
        # Variance alpha L + beta: all of it in alpha halves sigma at a quarter of the radiance, all in beta keeps it.
        dark = sigma * _log_uniform(generator, 0.5, 1.0)
        alpha = max(sigma**2 - dark**2, 0.0) / (full_scale * 3 / 16)
        beta = max(dark**2 - alpha * full_scale / 16, 0.0)
        return Sensor(mtf, alpha, beta, self.like.gain_dn_per_radiance, self.like.bits, {}, along, full_scale / 4)


def _log_uniform(generator: np.random.Generator, low: float, high: float) -> float:
    share = min(max(float(generator.uniform(-EDGE, 1 + EDGE)), 0.0), 1.0)
    return min(low * math.exp(share * math.log(high / low)), high)


class ConditionedConvBEERS(nn.Module):
    """A ConvBEERS for every sensor in range: (N, 1, H, W) in [0, 1] of full scale and (N, 4) to (N, 1, H, W).

    Before training the directions are zero: whatever the sensor, it computes what its base does.
    """

    def __init__(self, variant: Variant) -> None:
        super().__init__()
        self.variant = variant
        self.base = ConvBEERS(variant)
        self.directions = nn.ModuleList(ConvBEERS(variant) for _ in range(DIRECTIONS))
        self.layers = 2 * variant.blocks + 3
        self.coefficients = nn.Sequential(
            nn.Linear(len(RANGES), HIDDEN),
            nn.ReLU(),
            nn.Linear(HIDDEN, HIDDEN),
            nn.ReLU(),
            nn.Linear(HIDDEN, DIRECTIONS * self.layers),
            nn.Tanh(),
        )
        for parameter in self.directions.parameters():
            nn.init.zeros_(parameter)

    def weights(self, vectors: Tensor) -> dict[str, Tensor]:
        """The weights for each sensor vector (N, 4): by name, as ConvBEERS names them, (N, *shape)."""
        mixed = self.coefficients(vectors).view(-1, self.layers, DIRECTIONS)
        found, parts = {}, [dict(direction.named_parameters()) for direction in self.directions]
        for number, (name, base) in enumerate(self.base.named_parameters()):
            flat = torch.stack([part[name].flatten() for part in parts])
            change = mixed[:, number // 2] @ flat  # a convolution's weight and bias follow one another
            found[name] = base + change.view(-1, *base.shape)
        return found

    def forward(self, image: Tensor, vectors: Tensor) -> Tensor:
        """Send each image (N, 1, H, W) through the weights for its own sensor, of vectors (N, 4): (N, 1, H, W)."""
        return each_through(self.base, "", self.weights(vectors), image)


Network = ConvBEERS | ConditionedConvBEERS
"""What can be trained and kept: a network, or one for every sensor in range."""


def each_through(module: nn.Module, prefix: str, weights: Mapping[str, Tensor], images: Tensor) -> Tensor:
    """Image n of (N, 1, H, W) through `module` with weights n of (N, *shape), named with `prefix` there."""
    restored = []
    for number in range(len(images)):
        own = {prefix + name: weight[number] for name, weight in weights.items()}
        restored.append(functional_call(module, own, (images[number : number + 1],)))
    return torch.cat(restored)


def initialise_coefficients(network: ConditionedConvBEERS, generator: torch.Generator) -> None:
    """He-normal, so that sensors get different coefficients from the first step on; the directions do nothing yet."""
    for module in network.coefficients:
        if isinstance(module, nn.Linear):
            with torch.no_grad():
                module.weight.normal_(0.0, (2 / module.in_features) ** 0.5, generator=generator)
                module.bias.zero_()


def fold(network: ConditionedConvBEERS, vector: Tensor) -> ConvBEERS:
    """The plain network for one sensor vector (4,), in evaluation mode, on the CPU."""
    tensors = {name: value.detach().cpu().numpy() for name, value in network.state_dict().items()}
    weights = specialised(tensors, network.variant, SensorVector(tuple(vector.tolist()), ()))
    return plain_network(weights, network.variant)
