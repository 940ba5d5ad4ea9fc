"""Model the noise that NL-Bayes removes: white, or coloured by a previous filter."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beers_deploy.profiles.instrument import Instrument

LAG_PX = 6
"""The largest lag between two pixels of a patch, whose side is 7 at most."""


@dataclass(frozen=True)
class Noise:
    """Stationary Gaussian noise of an image.

    Attributes:
        sigma: the standard deviation of a pixel, in the unit of the image.
        correlation: the correlation of two pixels by the lag (dy + L, dx + L) between them, (2 L +
            1, 2 L + 1) with L at least a patch's side minus one; None for white noise.
    """

    sigma: float
    correlation: Tensor | None = None

    def covariance(self, side_px: int) -> Tensor:
        """Return the covariance of the noise of the pixels of a patch, (k * k, k * k) float64.

        It is in the unit of the image squared.

        Args:
            side_px: k, the side of the patch.
        """
        if self.correlation is None:
            return torch.eye(side_px**2, dtype=torch.float64) * self.sigma**2
        middle = self.correlation.shape[0] // 2
        y, x = (
            grid.reshape(-1) for grid in torch.meshgrid(*2 * [torch.arange(side_px)], indexing="ij")
        )
        dy, dx = (axis[:, None] - axis + middle for axis in (y, x))
        return self.correlation.double()[dy, dx] * self.sigma**2


def coloured_by(kernel: Tensor, sigma: float) -> Noise:
    """Return the noise that results from filtering white noise.

    Its correlation is the autocorrelation of the kernel, r(d) = sum over p of k(p) k(p + d), over
    r(0). Its standard deviation is sigma times the root of r(0).

    Args:
        kernel: the filter (K, K), K odd.
        sigma: the standard deviation of the white noise.
    """
    # So large that no lag wraps around.
    size = kernel.shape[-1] + 2 * LAG_PX
    power = torch.fft.rfft2(kernel.double(), s=(size, size)).abs().square()
    full = torch.fft.irfft2(power, s=(size, size)).roll((LAG_PX, LAG_PX), (0, 1))
    autocorrelation = full[: 2 * LAG_PX + 1, : 2 * LAG_PX + 1]
    energy = autocorrelation[LAG_PX, LAG_PX]
    return Noise(sigma * float(energy.sqrt()), autocorrelation / energy)


def with_rounding_noise(sensor: Instrument) -> Instrument:
    """Return the sensor with 1/12 DN^2, the variance that rounding to whole digital numbers adds,
    included in its beta.
    """
    return replace(sensor, beta=sensor.beta + 1 / (12 * sensor.gain_dn_per_radiance**2))


def stabilise(radiance: Tensor, sensor: Instrument) -> Tensor:
    """Convert radiance to a scale on which the noise of a sensor has variance 1 at every
    brightness.

    f(L) = 2 L / (sqrt(alpha L + beta) + sqrt(beta)), which equals 2 (sqrt(alpha L + beta) -
    sqrt(beta)) / alpha. The first form avoids the difference, which vanishes in float32 for small
    alpha. f is monotone, with f' = 1 / sigma(L). Limits: alpha = 0 gives L / sqrt(beta); beta = 0
    gives 2 sqrt(L / alpha). Below L = 0 the noise is that of the dark, and f continues as L /
    sqrt(beta) (as 0 if beta = 0).

    Args:
        radiance: L in W/m2/sr/um, any shape.
        sensor: the instrument whose alpha and beta are used, at least 0 and not both 0.
    """
    sigma_dark = math.sqrt(sensor.beta)
    # Without the difference of two roots, which vanishes in float32 for small alpha.
    denominator = (sensor.alpha * radiance.clamp(min=0) + sensor.beta).sqrt() + sigma_dark
    # With beta = 0 the denominator is 0 at L = 0, where f is 0 too.
    return (2 * radiance / denominator).where(denominator != 0, 0.0)


def destabilise(stable: Tensor, sensor: Instrument) -> Tensor:
    """Convert values on the scale of `stabilise` back to radiance in W/m2/sr/um: L = t sqrt(beta) +
    alpha t^2 / 4.

    Below t = 0 it is t sqrt(beta). The mean of noisy values t lies below f(mean L), because f is
    concave: see `bias_radiance`.

    Args:
        stable: t, any shape.
        sensor: the instrument that was given to `stabilise`.
    """
    return stable * math.sqrt(sensor.beta) + sensor.alpha / 4 * stable.clamp(min=0).square()


def bias_radiance(sensor: Instrument) -> float:
    """Return the radiance to add after averaging noisy values on the stabilised scale: alpha / 4,
    in W/m2/sr/um.

    To second order E[f(L + n)] = f(L) + f''(L) var / 2 = f(L) - alpha / (4 sigma(L)), and L moves
    by sigma(L) times that. It is exact to higher order only if sigma(L) is small compared with L +
    beta / alpha, as in any lit scene.
    """
    return sensor.alpha / 4
