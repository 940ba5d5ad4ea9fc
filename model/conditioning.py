"""Networks that are told their sensor: one set of weights for a whole range of sensors.

    weights(sensor) = base + sum over k of tanh(g(sensor))_k * direction_k

`base` and the K directions are whole sets of ConvBEERS weights; g, a small network, gives each convolution its own K
coefficients. For one sensor the sum is taken once (`fold`), and what is left is a plain ConvBEERS: knowing the sensor
costs nothing at run time. (Mixed kernels: Tunable Convolutions, Maggioni et al., CVPR 2023.)

The network sees images over full scale, so noise is told over full scale too, at 1/16 and at 1/4 of it: that is at 25
and at 100 W/m2/sr/um where full scale is 400.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call

from model.convbeers import ConvBEERS, Variant
from profiles.effects import Smear
from profiles.sensor import Sensor

DIRECTIONS, HIDDEN = 3, 64

RANGES: Mapping[str, tuple[float, float]] = {
    "mtf_across": (0.015, 0.15),
    "mtf_along": (0.015, 0.15),
    "sigma_dark": (0.00056, 0.0072),
    "sigma_bright": (0.0011, 0.0072),
}
"""What a network can be told, in this order: MTF at Nyquist across (horizontal) and along the track (vertical), and
the noise's standard deviation over full scale at 1/16 and at 1/4 of it. The logarithm of each, -1 to 1 from end to
end, is the sensor vector."""

SNR_BRIGHT = (35.0, 220.0)
"""Of the sensors trained on, at 1/4 of full scale; at 1/16 all that physics allows for it."""

LEAST_ALONG = 0.4
"""The lower MTF of the two axes over the higher one: the least that is drawn."""

ROUNDING = 1e-9
"""What a ratio may miss its end by."""

EDGE = 0.05
"""Draws reach this share of a range beyond its ends and are brought back: no draws from outside train the ends."""


@dataclass(frozen=True)
class Told:
    """What a network is told of a sensor.

    Attributes:
        vector: (4,) float32, each in [-1, 1].
        outside: a sentence for each value that lies outside its range, and was moved to the nearest end of it; and
            one for axes that differ more than any sensor did in training.
    """

    vector: Tensor
    outside: tuple[str, ...]


def sensor_values(sensor: Sensor) -> dict[str, float]:
    """The four values of `RANGES`, smear and rounding noise counted."""
    full_scale = sensor.max_dn / sensor.gain_dn_per_radiance
    rounding = 1 / (12 * sensor.gain_dn_per_radiance**2)
    smear = sensor.effects.get("smear")
    # A network knows no smear of its own: what that leaves of the contrast along the track is counted there.
    kept = abs(float(np.sinc(0.5 * smear.length_px))) if isinstance(smear, Smear) else 1.0
    sigmas = [math.sqrt(sensor.noise_sigma(full_scale / part) ** 2 + rounding) / full_scale for part in (16, 4)]
    across, along = sensor.mtf_axes
    return dict(zip(RANGES, (across, along * kept, *sigmas), strict=True))


def tell(sensor: Sensor) -> Told:
    """The sensor vector, clamped to the ranges."""
    values, entries, outside = sensor_values(sensor), list[float](), list[str]()
    for (name, value), (low, high) in zip(values.items(), RANGES.values(), strict=True):
        inside = min(max(value, low), high)
        if inside != value:
            outside.append(f"{name} {value:.3g} is outside {low:g} to {high:g}, told as {inside:g}")
        entries.append(2 * math.log(inside / low) / math.log(high / low) - 1)
    lower, higher = sorted((values["mtf_across"], values["mtf_along"]))
    if lower < (1 - ROUNDING) * LEAST_ALONG * higher:
        outside.append(
            f"the lower MTF is {lower / higher:.2g} of the other axis'; {LEAST_ALONG:g} and more was trained"
        )
    return Told(torch.tensor(entries), tuple(outside))


def transposed(vector: Tensor) -> Tensor:
    """The sensor vector (..., 4) of an image whose rows and columns have changed places: (..., 4)."""
    return vector[..., [1, 0, 2, 3]]


@dataclass(frozen=True)
class SensorFamily:
    """The sensors that a told network is trained on: every number log-uniform over its range.

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


class ToldConvBEERS(nn.Module):
    """A ConvBEERS for every sensor in range: (N, 1, H, W) in [0, 1] of full scale and (N, 4) to (N, 1, H, W).

    Before training the directions are zero: whatever it is told, it computes what its base does.
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


Network = ConvBEERS | ToldConvBEERS
"""What can be trained and kept: a network, or one for every sensor in range."""


def each_through(module: nn.Module, prefix: str, weights: Mapping[str, Tensor], images: Tensor) -> Tensor:
    """Image n of (N, 1, H, W) through `module` with weights n of (N, *shape), named with `prefix` there."""
    restored = []
    for number in range(len(images)):
        own = {prefix + name: weight[number] for name, weight in weights.items()}
        restored.append(functional_call(module, own, (images[number : number + 1],)))
    return torch.cat(restored)


def initialise_coefficients(network: ToldConvBEERS, generator: torch.Generator) -> None:
    """He-normal, so that sensors get different coefficients from the first step on; the directions do nothing yet."""
    for module in network.coefficients:
        if isinstance(module, nn.Linear):
            with torch.no_grad():
                module.weight.normal_(0.0, (2 / module.in_features) ** 0.5, generator=generator)
                module.bias.zero_()


def fold(network: ToldConvBEERS, vector: Tensor) -> ConvBEERS:
    """The plain network for one sensor vector (4,), in evaluation mode, on the CPU."""
    plain = ConvBEERS(network.variant)
    with torch.no_grad():
        weights = network.weights(vector[None].to(next(network.parameters()).device))
    plain.load_state_dict({name: weight[0].contiguous() for name, weight in weights.items()})
    return plain.eval()
