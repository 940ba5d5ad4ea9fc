"""Proven bounds: by how much, at most, an effect can change any pixel of a scene, in DN before digitising.

Everything rests on a scene's smallest and largest radiance, its steepest step along the track, and the sizes of the
convolution kernels. Each bound says why it holds; random draws are clipped (noise at 6, patterns at 4), so that
theirs hold for every draw.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from model.simulator.fixed_pattern import PATTERN_LIMIT
from model.simulator.mtf import Axes, smear_response, transfer_function
from model.simulator.noise import NOISE_LIMIT
from profiles.effects import AntiAlias, Defects, Dsnu, Effect, FullWell, Offset, Prnu, Smear, Striping, Veil
from profiles.sensor import Sensor, mtf_limit


@dataclass(frozen=True)
class SceneStats:
    """What a scene can show, radiances in W/m2/sr/um on the scene's own grid."""

    low: float
    high: float
    step_along: float  # largest difference between neighbours in a column, the periodic border included
    height: int
    width: int
    oversampling: int

    @property
    def span(self) -> float:
        """Largest less smallest radiance."""
        return self.high - self.low


def scene_stats(radiance: Tensor, oversampling: int) -> SceneStats:
    """Statistics of a scene (H, W), one pass over it."""
    low, high = (float(v) for v in torch.aminmax(radiance))
    step = max(float((radiance[1:] - radiance[:-1]).abs().max()), float((radiance[0] - radiance[-1]).abs().max()))
    height, width = radiance.shape
    return SceneStats(low, high, step, height, width, oversampling)


def ringing_of(sensor: Sensor, stats: SceneStats) -> float:
    """Sum of the absolute values of the blur's kernel on the scene's grid: 1 without ringing.

    A blurrier sensor is a sharper one followed by a positive kernel of sum 1, which cannot enlarge the sum: so the
    MTF is rounded up to the next whole percent, and sensors share what was computed once. Of two axes rounded each by
    itself that would not hold: they are taken as they are.
    """
    antialias = sensor.effects.get("antialias")
    sigma_px = antialias.sigma_px if isinstance(antialias, AntiAlias) else 0.0
    size = stats.height, stats.width, stats.oversampling
    across, along = sensor.mtf_axes
    if across != along:
        return _kernel_sum(*size, (across, along), sigma_px)
    rounded = min(math.ceil(across * 100) / 100, mtf_limit(sigma_px))
    return _kernel_sum(*size, max(rounded, across), sigma_px)


@lru_cache(maxsize=256)
def _kernel_sum(height: int, width: int, oversampling: int, mtf_nyquist: Axes, sigma_px: float) -> float:
    transfer = transfer_function(height, width, oversampling, mtf_nyquist, sigma_px)
    return float(torch.fft.irfft2(transfer.double(), s=(height, width)).abs().sum())


def blurred_range(stats: SceneStats, ringing: float) -> tuple[float, float]:
    """Radiance after a blur whose kernel sums to 1, in absolute values to `ringing`: the span grows by the excess.

    |k * (L - m)| <= ringing * span / 2 around the middle m.
    """
    middle, reach = (stats.low + stats.high) / 2, ringing * stats.span / 2
    return middle - reach, middle + reach


@lru_cache(maxsize=256)
def smear_moments(height: int, oversampling: int, length_px: float) -> tuple[float, float]:
    """Of the smear's kernel less a unit pulse: half its absolute sum, and its absolute first moment in pixels."""
    fy = torch.fft.fftfreq(height, 1 / oversampling, dtype=torch.float64)
    kernel = torch.fft.ifft(smear_response(fy, length_px)).real
    kernel[0] -= 1
    distance = torch.arange(height, dtype=torch.float64)
    distance = torch.minimum(distance, height - distance)
    return float(kernel.abs().sum()) / 2, float((kernel.abs() * distance).sum())


def blur_bound_dn(stats: SceneStats, ringing: float, gain: float) -> float:
    """The blurred pixel and the plain mean of its scene pixels lie in one range: they differ by its width at most."""
    return gain * (1 + ringing) / 2 * stats.span


def smear_ringing(smear: Smear, stats: SceneStats) -> float:
    """Sum of the absolute values of the smear's kernel, at most: a unit pulse and all that differs from it."""
    return 1 + 2 * smear_moments(stats.height, stats.oversampling, smear.length_px)[0]


def smear_bound_dn(smear: Smear, stats: SceneStats, ringing: float, gain: float) -> float:
    """The smear's kernel less a pulse sums to 0: it sees at most half its size times the span, or steps times moment.

    The blur behind it enlarges that by its ringing.
    """
    size, moment = smear_moments(stats.height, stats.oversampling, smear.length_px)
    return gain * ringing * min(size * stats.span, moment * stats.step_along)


def effect_bound_dn(effect: Effect, sensor: Sensor, low: float, high: float) -> float:
    """Largest change of any pixel by an effect of the target grid, for a signal between low and high radiance."""
    gain, brightest = sensor.gain_dn_per_radiance, max(abs(low), abs(high))
    match effect:
        case Veil():  # affine in L: the ends decide
            return gain * max(abs((effect.transmittance - 1) * v + effect.path_radiance) for v in (low, high))
        case FullWell():  # below the well nothing; above it, what is cut off or spilt
            return gain * max(high - effect.radiance, 0.0)
        case Prnu():
            return gain * PATTERN_LIMIT * effect.rms * brightest
        case Dsnu():
            return PATTERN_LIMIT * effect.rms_dn
        case Striping():
            return effect.odd_even_dn / 2
        case Offset():
            return effect.offset_dn
        case Defects():
            return _defects_bound_dn(effect, sensor, low, high)
        case _:
            return 0.0


def _defects_bound_dn(defects: Defects, sensor: Sensor, low: float, high: float) -> float:
    """A pixel becomes 0 or full scale, whatever it was before: beyond the converter's range too."""
    if defects.dead_per_million + defects.hot_per_million == 0:
        return 0.0
    ends = [sensor.gain_dn_per_radiance * v for v in (low, high)]
    return max(max(abs(dn), abs(sensor.max_dn - dn)) for dn in ends)


def noise_bound_dn(sensor: Sensor, high: float) -> float:
    """Six standard deviations at the brightest pixel."""
    return sensor.gain_dn_per_radiance * NOISE_LIMIT * sensor.noise_sigma(max(high, 0.0))


def behind(change_dn: float, sensor: Sensor, names: tuple[str, ...]) -> float:
    """What a change of the signal may become through the effects `names` that come after it and are applied.

    Spilling adds its share, PRNU its largest gain, and noise changes with the signal under it:
    |sqrt(a) - sqrt(b)| <= min(sqrt|a - b|, |a - b| / (2 sqrt(beta))).
    """
    gain, change = sensor.gain_dn_per_radiance, change_dn
    for name in names:
        effect = sensor.effects.get(name)
        if isinstance(effect, FullWell):
            change *= 1 + effect.blooming_share
        if isinstance(effect, Prnu):
            change *= 1 + PATTERN_LIMIT * effect.rms
        if name == "noise" and change > 0:
            variance = sensor.alpha * change / gain
            slope = variance / (2 * math.sqrt(sensor.beta)) if sensor.beta > 0 else math.inf
            change += gain * NOISE_LIMIT * min(math.sqrt(variance), slope)
    return change
