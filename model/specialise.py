"""A conditioned network made plain for one sensor: what it is given of the sensor, and the weights that come out.

    weights(sensor) = base + sum over k of tanh(g(sensor))_k * direction_k

`base` and the K directions are whole sets of ConvBEERS weights; g, a small network, gives each convolution its own K
coefficients. For one sensor the sum is taken once, in float64, and what is left is a plain ConvBEERS: knowing the
sensor costs nothing at run time. (Mixed kernels: Tunable Convolutions, Maggioni et al., CVPR 2023.) This is
numpy alone, so that a restoration begins without torch.

The network sees images over full scale, so its noise is stated over full scale too, at 1/16 and at 1/4 of it: that is
at 25 and at 100 W/m2/sr/um where full scale is 400.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from model.variants import Variant
from profiles.effects import Smear
from profiles.sensor import Sensor

DIRECTIONS, HIDDEN = 3, 64

RANGES: Mapping[str, tuple[float, float]] = {
    "mtf_across": (0.015, 0.15),
    "mtf_along": (0.015, 0.15),
    "sigma_dark": (0.00056, 0.0072),
    "sigma_bright": (0.0011, 0.0072),
}
"""What a network can know of its sensor, in this order: MTF at Nyquist across (horizontal) and along the track
(vertical), and the noise's standard deviation over full scale at 1/16 and at 1/4 of it. The logarithm of each, -1 to
1 from end to end, is the sensor vector."""

LEAST_ALONG = 0.4
"""The lower MTF of the two axes over the higher one: the least that is trained on."""

ROUNDING = 1e-9
"""What a ratio may miss its end by."""

BASE, DIRECTION, COEFFICIENTS = "base.", "directions.{}.", "coefficients."
"""What the names of a conditioned network's tensors begin with."""

LINEAR = (0, 2, 4)
"""The numbers of the small network's linear layers, ReLUs between them and a tanh behind."""


@dataclass(frozen=True)
class SensorVector:
    """What a conditioned network knows of a sensor.

    Attributes:
        values: four of them as in `RANGES`, each in [-1, 1].
        outside: a sentence for each value that lies outside its range, and was moved to the nearest end of it; and
            one for axes that differ more than any sensor did in training.
    """

    values: tuple[float, ...]
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


def sensor_vector(sensor: Sensor) -> SensorVector:
    """The sensor vector, clamped to the ranges."""
    values, entries, outside = sensor_values(sensor), list[float](), list[str]()
    for (name, value), (low, high) in zip(values.items(), RANGES.values(), strict=True):
        inside = min(max(value, low), high)
        if inside != value:
            outside.append(
                f"{name} {value:.3g} is outside {low:g} to {high:g}, the network is specialised for {inside:g} "
                "and may restore worse than blind"
            )
        entries.append(2 * math.log(inside / low) / math.log(high / low) - 1)
    lower, higher = sorted((values["mtf_across"], values["mtf_along"]))
    if lower < (1 - ROUNDING) * LEAST_ALONG * higher:
        outside.append(
            f"the lower MTF is {lower / higher:.2g} of the other axis'; {LEAST_ALONG:g} and more was trained"
        )
    return SensorVector(tuple(entries), tuple(outside))


def conditioned_shapes(variant: Variant) -> dict[str, tuple[int, ...]]:
    """The shape of each tensor of a conditioned network by name."""
    prefixes = [BASE, *(DIRECTION.format(k) for k in range(DIRECTIONS))]
    found = {prefix + name: shape for prefix in prefixes for name, shape in variant.shapes.items()}
    widths = (len(RANGES), HIDDEN, HIDDEN, DIRECTIONS * len(variant.convolutions))
    for number, inputs, outputs in zip(LINEAR, widths, widths[1:], strict=False):
        layer = f"{COEFFICIENTS}{number}"
        found |= {f"{layer}.weight": (outputs, inputs), f"{layer}.bias": (outputs,)}
    return found


def specialised(tensors: Mapping[str, np.ndarray], variant: Variant, vector: SensorVector) -> dict[str, np.ndarray]:
    """The plain weights for one sensor: float32, by the names and of the shapes that a ConvBEERS has.

    Args:
        tensors: of a conditioned network, as `conditioned_shapes` names and shapes them.
        variant: of that network.
        vector: of the sensor.
    """
    mixed, found = _coefficients(tensors, vector).reshape(-1, DIRECTIONS), dict[str, np.ndarray]()
    for layer, convolution in enumerate(variant.convolutions):
        for name in (f"{convolution}.weight", f"{convolution}.bias"):
            parts = np.stack([tensors[DIRECTION.format(k) + name] for k in range(DIRECTIONS)]).astype(np.float64)
            found[name] = (tensors[BASE + name] + np.tensordot(mixed[layer], parts, 1)).astype(np.float32)
    return found


def _coefficients(tensors: Mapping[str, np.ndarray], vector: SensorVector) -> np.ndarray:
    """How far each convolution goes in each direction, in (-1, 1): (convolutions * K,), float64."""
    values = np.array(vector.values)
    for number in LINEAR:
        layer = f"{COEFFICIENTS}{number}"
        values = tensors[f"{layer}.weight"].astype(np.float64) @ values + tensors[f"{layer}.bias"]
        values = np.tanh(values) if number == LINEAR[-1] else np.maximum(values, 0)
    return values
