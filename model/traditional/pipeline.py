"""The two traditional chains. Every number comes from the two sensors.

- denoise first: stabilise, NL-Bayes, inverse, MTF compensation. NL-Bayes meets the white noise that it supposes;
  what it leaves is amplified afterwards.
- deconvolve first: MTF compensation, stabilise, NL-Bayes, inverse. The noise that NL-Bayes meets is amplified and
  coloured by the filter, and it is told how.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from beers_deploy.model.simulator.detector import to_dn, to_radiance
from beers_deploy.model.traditional.compensate import EPSILON_PER_PERCENT, compensation_kernel, filter_strips
from beers_deploy.model.traditional.nl_bayes import QUALITIES, Quality, finite_or_missing, nl_bayes_strips
from beers_deploy.model.traditional.noise import Noise, bias_radiance, coloured_by, destabilise, stabilise
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor import Instrument

WORKING_SIGMA = 12.0
"""Noise level at which NL-Bayes runs: the stabilised image is scaled to it, where the published settings apply.

Of 6, 12 and 25 the best, by 0.04 dB (measured on a photograph at 7 %)."""

Order = Literal["denoise-first", "deconvolve-first"]


@dataclass(frozen=True)
class Chain:
    """How to restore what `degraded` acquired to what `reference` would have, without its noise.

    `quality` is one of `nl_bayes.QUALITIES`. Without an `epsilon`, the regularisation of the MTF compensation, the
    noise of `degraded` at the brighter stated radiance decides.
    """

    degraded: Instrument
    reference: Instrument
    quality: str = "standard"
    order: Order = "denoise-first"
    epsilon: float | None = None

    def kernel(self) -> Tensor:
        """The filter of the MTF compensation, (2 R + 1, 2 R + 1) float64."""
        epsilon, bright = self.epsilon, self.degraded.radiance_1
        if epsilon is None:
            epsilon = EPSILON_PER_PERCENT * self.degraded.noise_sigma(bright) * (100 / bright)
        return compensation_kernel(self.degraded.blur, self.reference.blur, epsilon)


def restore_traditional(dn: Tensor, chain: Chain) -> Tensor:
    """Digital numbers (H, W) float32 of the degraded sensor to those of the reference, clipped and not rounded.

    NaN marks missing pixels, and stays.
    """
    return torch.cat(list(restore_strips([dn], dn.shape[0], chain)))


def restore_strips(strips: Iterable[Tensor], height: int, chain: Chain) -> Iterator[Tensor]:
    """Restore as `restore_traditional`, bit for bit, an image that comes and goes in strips of rows, (any, W) each.

    Holds some 700 rows of it, and the tallest strip.
    """
    radiance = (to_radiance(strip, chain.degraded) for strip in finite_or_missing(strips))
    sensor, kernel, quality = with_rounding_noise(chain.degraded), chain.kernel(), quality_named(chain.quality)
    if chain.order == "denoise-first":
        clean = denoise_radiance(radiance, height, sensor, Noise(WORKING_SIGMA), quality)
        restored = filter_strips(clean, height, kernel)
    else:
        coloured = coloured_by(kernel, 1.0)
        amplified = replace(sensor, alpha=sensor.alpha * coloured.sigma**2, beta=sensor.beta * coloured.sigma**2)
        sharp = filter_strips(radiance, height, kernel)
        restored = denoise_radiance(sharp, height, amplified, replace(coloured, sigma=WORKING_SIGMA), quality)
    for strip in restored:
        yield to_dn(strip, chain.reference)


def denoise_radiance(
    radiance: Iterable[Tensor], height: int, sensor: Instrument, noise: Noise, quality: Quality
) -> Iterator[Tensor]:
    """NL-Bayes on the stabilised scale: strips (any, W) in W/m2/sr/um, of variance alpha L + beta, to the same."""
    scale = noise.sigma
    stable = (stabilise(strip, sensor) * scale for strip in radiance)
    for clean in nl_bayes_strips(stable, height, noise, quality):
        yield destabilise(clean / scale, sensor) + bias_radiance(sensor)


def with_rounding_noise(sensor: Instrument) -> Instrument:
    """The sensor with its converter's 1/12 DN^2 counted in beta: what its digital numbers really carry."""
    return replace(sensor, beta=sensor.beta + 1 / (12 * sensor.gain_dn_per_radiance**2))


def quality_named(name: str) -> Quality:
    """Look a quality up, refusing an unknown name."""
    if name not in QUALITIES:
        raise OptionError("quality", expected=f"one of {', '.join(QUALITIES)}", got=repr(name), remedy="pick one")
    return QUALITIES[name]
