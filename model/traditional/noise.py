"""The noise that NL-Bayes removes: white, or coloured by a filter that came before."""

from dataclasses import dataclass
from math import isfinite

import torch
from torch import Tensor

from profiles.errors import OptionError


@dataclass(frozen=True)
class Noise:
    """Stationary Gaussian noise on an image.

    Attributes:
        sigma: standard deviation of a pixel, 0 or more.
        correlation: (2 L + 1, 2 L + 1) correlation of two pixels by their lag (dy + L, dx + L), 1 in the middle;
            None for white noise.
    """

    sigma: float
    correlation: Tensor | None = None

    def __post_init__(self) -> None:
        if not (self.sigma >= 0 and isfinite(self.sigma)):
            raise OptionError("sigma", expected="0 or more", got=repr(self.sigma), remedy="give a standard deviation")

    def covariance(self, side_px: int) -> Tensor:
        """Covariance of the k * k pixels of a patch, (k * k, k * k) float64."""
        if self.correlation is None:
            return torch.eye(side_px**2, dtype=torch.float64) * self.sigma**2
        middle = self.correlation.shape[0] // 2
        if middle < side_px - 1:
            raise OptionError(
                "noise correlation",
                expected=f"lags up to {side_px - 1} pixels",
                got=f"up to {middle}",
                remedy="give it for more lags",
            )
        y, x = (grid.reshape(-1) for grid in torch.meshgrid(*2 * [torch.arange(side_px)], indexing="ij"))
        dy, dx = (axis[:, None] - axis + middle for axis in (y, x))
        return self.correlation.double()[dy, dx] * self.sigma**2


def coloured_by(kernel: Tensor, sigma: float, most_lag_px: int = 6) -> Noise:
    """What filtering by `kernel` (odd side, real) makes of white noise of standard deviation `sigma`.

    The autocorrelation of the kernel: r(d) = sum over p of k(p) k(p + d), sigma times the root of r(0).
    """
    size = kernel.shape[-1] + 2 * most_lag_px  # no lag wraps around
    power = torch.fft.rfft2(kernel.double(), s=(size, size)).abs().square()
    full = torch.fft.irfft2(power, s=(size, size)).roll((most_lag_px, most_lag_px), (0, 1))
    autocorrelation = full[: 2 * most_lag_px + 1, : 2 * most_lag_px + 1]
    energy = autocorrelation[most_lag_px, most_lag_px]
    return Noise(sigma * float(energy.sqrt()), autocorrelation / energy)
