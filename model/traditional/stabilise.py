"""Variance stabilisation: a scale on which noise of variance alpha * L + beta has variance 1 everywhere.

The noise is Gaussian with a variance that grows with the light, so this is the plain square-root transform; the
3/8 alpha^2 of the generalised Anscombe transform belongs to Poisson counts.
"""

import math

from torch import Tensor

from profiles.errors import OptionError
from profiles.sensor import Sensor


def stabilise(radiance: Tensor, sensor: Sensor) -> Tensor:
    """f(L) = 2 L / (sqrt(alpha L + beta) + sqrt(beta)), which is 2 (sqrt(alpha L + beta) - sqrt(beta)) / alpha.

    Written without the difference, that vanishes in float32 for small alpha. f is monotone, with f' = 1 / sigma(L).
    Limits: alpha = 0 gives L / sqrt(beta); beta = 0 gives 2 sqrt(L / alpha); below L = 0 the noise is that of the
    dark, and f goes on as L / sqrt(beta) (as 0 where beta = 0).

    Args:
        radiance: any shape, W/m2/sr/um.
        sensor: the instrument, alpha and beta at least 0 and not both 0.
    """
    _check(sensor)
    dark = math.sqrt(sensor.beta)
    denominator = (sensor.alpha * radiance.clamp(min=0) + sensor.beta).sqrt() + dark
    return (2 * radiance / denominator).where(denominator != 0, 0.0)


def destabilise(stable: Tensor, sensor: Sensor) -> Tensor:
    """L = t sqrt(beta) + alpha t^2 / 4, the exact inverse of `stabilise`; t sqrt(beta) below t = 0.

    The mean of noisy values t lies below f(mean L), f being concave: see `bias_radiance`.
    """
    _check(sensor)
    return stable * math.sqrt(sensor.beta) + sensor.alpha / 4 * stable.clamp(min=0).square()


def bias_radiance(sensor: Sensor) -> float:
    """What averaging on the stabilised scale loses: alpha / 4, in W/m2/sr/um.

    To second order E[f(L + n)] = f(L) + f''(L) var / 2 = f(L) - alpha / (4 sigma(L)), and L moves by sigma(L) times
    that. Exact to higher order only where sigma(L) is small beside L + beta / alpha, as on any lit scene.
    """
    return sensor.alpha / 4


def _check(sensor: Sensor) -> None:
    if min(sensor.alpha, sensor.beta) < 0 or sensor.alpha == sensor.beta == 0:
        raise OptionError(
            "noise of the sensor",
            expected="alpha and beta of at least 0 and not both 0 (variance alpha L + beta)",
            got=f"alpha {sensor.alpha:g}, beta {sensor.beta:g}",
            remedy="correct its SNR pair, or skip the denoising of a sensor without noise",
        )
