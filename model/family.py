"""Define the sensors on which a network for every sensor is trained, and the sensor vector that it
is conditioned on.

The network sees images relative to full scale. A sensor's noise is therefore also stated relative
to full scale, at 1/16 and at 1/4 of it: at 25 and at 100 W/m2/sr/um if full scale is 400. This
module uses NumPy only, so that a restoration starts without loading torch.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from beers_deploy.model.curves import draw_table
from beers_deploy.profiles.instrument import Instrument

RANGES: Mapping[str, tuple[float, float]] = {
    "mtf_across": (0.015, 0.15),
    "mtf_along": (0.015, 0.15),
    "sigma_dark": (0.00056, 0.0072),
    "sigma_bright": (0.0011, 0.0072),
}
"""The quantities that condition a network on its sensor, in this order: MTF at Nyquist across
(horizontal) and along the track (vertical), and the standard deviation of the noise over full scale
at 1/16 and at 1/4 of it. The sensor vector is the logarithm of each, scaled such that the range
becomes -1 to 1.
"""

LEAST_ALONG = 0.4
"""The smallest ratio in training of the lower MTF of the two axes to the higher one."""

ROUNDING = 1e-9
"""The tolerance for the ratio of the two axes."""

SNR_BRIGHT = (35.0, 220.0)
"""SNR range of the training sensors at 1/4 of full scale. At 1/16 every physically possible SNR is
drawn.
"""

EDGE = 0.05
"""Draws extend beyond a range by this share and are clamped to it. Otherwise no draws from outside
would train its ends.
"""


@dataclass(frozen=True)
class SensorVector:
    """The description of one sensor on which a network for every sensor is conditioned.

    Attributes:
        values: four values in the order of `RANGES`, each in [-1, 1].
        outside: a sentence for each value that was outside its range and was clamped; and one for
            axes that differ more than those of any training sensor.
    """

    values: tuple[float, ...]
    outside: tuple[str, ...]


def sensor_values(sensor: Instrument) -> dict[str, float]:
    """Compute the four numbers that describe a sensor to a network, by the names of `RANGES`.

    They are its MTF at Nyquist across and along the track, including smear, and its noise in dark
    and in bright ground as a share of full scale, including rounding to integers.
    """
    # Networks have no input for smear. Its loss of contrast along the track is included there.
    smear_contrast = abs(float(np.sinc(0.5 * sensor.smear_px)))
    sigmas = [noise_over_full_scale(sensor, part) for part in (16, 4)]
    across, along = sensor.mtf_axes
    return dict(zip(RANGES, (across, along * smear_contrast, *sigmas), strict=True))


def noise_over_full_scale(sensor: Instrument, part: int = 4) -> float:
    """Compute the standard deviation of the noise over full scale, including rounding noise.

    Args:
        sensor: the instrument.
        part: the signal is full scale divided by this number.
    """
    full_scale = sensor.max_dn / sensor.gain_dn_per_radiance
    rounding = 1 / (12 * sensor.gain_dn_per_radiance**2)
    return math.sqrt(sensor.noise_sigma(full_scale / part) ** 2 + rounding) / full_scale


def sensor_vector(sensor: Instrument) -> SensorVector:
    """Compute the vector on which a network is conditioned: the `sensor_values`, scaled to [-1, 1].

    Values outside the ranges of training are clamped to them and named in the result.
    """
    values = sensor_values(sensor)
    entries = list[float]()
    outside = list[str]()
    for (name, value), (low, high) in zip(values.items(), RANGES.values(), strict=True):
        inside = min(max(value, low), high)
        if inside != value:
            outside.append(
                f"{name} {value:.3g} is outside the range of the training, {low:g} to {high:g}; "
                f"the network uses {inside:g} and may restore worse than the traditional pipeline"
            )
        entries.append(2 * math.log(inside / low) / math.log(high / low) - 1)
    lower, higher = sorted((values["mtf_across"], values["mtf_along"]))
    if lower < (1 - ROUNDING) * LEAST_ALONG * higher:
        outside.append(
            f"the lower MTF is {lower / higher:.2g} of the other axis'; {LEAST_ALONG:g} and "
            "more was trained"
        )
    return SensorVector(tuple(entries), tuple(outside))


@dataclass(frozen=True)
class SensorFamily:
    """The sensors that a network is trained on: every number is log-uniform over its range.

    Attributes:
        like: the sensor whose gain and bits are used; its MTF and noise do not matter.
        snr_bright: SNR range at a quarter of full scale.
        other_curves: share of the sensors whose MTF has another curve than the formula's, see
            `model.curves`.
    """

    like: Instrument
    snr_bright: tuple[float, float] = SNR_BRIGHT
    other_curves: float = 0.0

    def draw(self, generator: np.random.Generator) -> Instrument:
        """Draw one sensor.

        Its MTF along the track is more often near the one across it than far below it.
        """
        mtf = _log_uniform(generator, *RANGES["mtf_across"])
        # The square draws more sensors with axes that are nearly alike, as real ones have.
        along = max(mtf * LEAST_ALONG ** float(generator.uniform() ** 2), RANGES["mtf_along"][0])
        full_scale = self.like.max_dn / self.like.gain_dn_per_radiance
        sigma = full_scale / 4 / _log_uniform(generator, *self.snr_bright)
        # Variance alpha L + beta: all of it in alpha halves sigma at a quarter of the radiance, all
        # in beta keeps it.
        sigma_dark = sigma * _log_uniform(generator, 0.5, 1.0)
        alpha = max(sigma**2 - sigma_dark**2, 0.0) / (full_scale * 3 / 16)
        beta = max(sigma_dark**2 - alpha * full_scale / 16, 0.0)
        instrument = Instrument(
            mtf_nyquist=mtf,
            alpha=alpha,
            beta=beta,
            gain_dn_per_radiance=self.like.gain_dn_per_radiance,
            bits=self.like.bits,
            mtf_nyquist_along=along,
            radiance_1=full_scale / 4,
        )
        if self.other_curves and generator.random() < self.other_curves:
            return replace(instrument, response=draw_table(mtf, along, generator))
        return instrument


def _log_uniform(generator: np.random.Generator, low: float, high: float) -> float:
    share = min(max(float(generator.uniform(-EDGE, 1 + EDGE)), 0.0), 1.0)
    return min(low * math.exp(share * math.log(high / low)), high)
