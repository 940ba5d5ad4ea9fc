"""The chain: stabilise, NL-Bayes, inverse, MTF compensation. Every number comes from the two sensors."""

from dataclasses import replace

from torch import Tensor

from model.traditional.compensate import EPSILON, compensate, compensation_gain
from model.traditional.nl_bayes import nl_bayes
from model.traditional.settings import QUALITIES, Quality
from model.traditional.stabilise import bias_radiance, destabilise, stabilise
from profiles.errors import OptionError
from profiles.sensor import Sensor

WORKING_SIGMA = 12.0
"""Noise level at which NL-Bayes runs: the stabilised image is scaled to it, where the published settings apply.

Of 6, 12 and 25 the best, by 0.04 dB (measured on a photograph at 7 %)."""


def restore_traditional(
    dn: Tensor, degraded: Sensor, reference: Sensor, quality: str = "standard", epsilon: float = EPSILON
) -> Tensor:
    """Restore what `degraded` acquired to what `reference` would have, without its noise.

    Args:
        dn: (H, W) float32 digital numbers of the degraded sensor.
        degraded: the sensor that acquired them.
        reference: the sensor to imitate; of its noise nothing is imitated.
        quality: "fast", "standard" or "best" (see `settings.QUALITIES`).
        epsilon: regularisation of the MTF compensation.

    Returns:
        (H, W) float32 digital numbers of the reference sensor, clipped to 0..max_dn, not rounded.
    """
    sensor = with_rounding_noise(degraded)
    radiance = denoise_radiance(dn / degraded.gain_dn_per_radiance, sensor, quality_named(quality))
    sharp = compensate(radiance, degraded.mtf_nyquist, reference.mtf_nyquist, epsilon)
    return (sharp * reference.gain_dn_per_radiance).clamp(0, reference.max_dn)


def denoise_radiance(radiance: Tensor, sensor: Sensor, quality: Quality) -> Tensor:
    """NL-Bayes on the stabilised scale: (H, W) in W/m2/sr/um, of noise variance alpha L + beta, to the same."""
    stable = stabilise(radiance, sensor) * WORKING_SIGMA
    clean = nl_bayes(stable, WORKING_SIGMA, quality) / WORKING_SIGMA
    return destabilise(clean, sensor) + bias_radiance(sensor)


def with_rounding_noise(sensor: Sensor) -> Sensor:
    """The sensor with its converter's 1/12 DN^2 counted in beta: what its digital numbers really carry."""
    return replace(sensor, beta=sensor.beta + 1 / (12 * sensor.gain_dn_per_radiance**2))


def quality_named(name: str) -> Quality:
    """Look a quality up, refusing an unknown name."""
    if name not in QUALITIES:
        raise OptionError("quality", expected=f"one of {', '.join(QUALITIES)}", got=repr(name), remedy="pick one")
    return QUALITIES[name]


def describe(degraded: Sensor, reference: Sensor, quality: str = "standard", epsilon: float = EPSILON) -> list[str]:
    """The steps that `restore_traditional` would take, one line each, with their numbers."""
    sensor, chosen = with_rounding_noise(degraded), quality_named(quality)
    gain = float(compensation_gain(64, 64, degraded.mtf_nyquist, reference.mtf_nyquist, epsilon).max())
    mtfs = f"{degraded.mtf_nyquist:.3g} to {reference.mtf_nyquist:.3g}"
    return [
        f"stabilise noise of variance {sensor.alpha:.4g} L + {sensor.beta:.4g}, L in W/m2/sr/um, rounding counted",
        f"NL-Bayes at sigma {WORKING_SIGMA:g}: references {chosen.stride_px} px apart, cap {chosen.group_cap} groups",
        f"back to radiance, {bias_radiance(sensor):.2g} W/m2/sr/um of bias restored",
        f"compensate the MTF at Nyquist from {mtfs}: epsilon {epsilon:g}, largest gain {gain:.2f}",
        f"clip to 0..{reference.max_dn} DN",
    ]
