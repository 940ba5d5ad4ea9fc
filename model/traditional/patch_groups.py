"""Estimate groups of similar patches in non-local Bayes denoising.

The settings of both passes are the published ones, for grey levels of 0 to 255 (IPOL 2013, section
on the parameters).
"""

from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from beers_deploy.model.traditional.noise import Noise

T = TypeVar("T", int, float)


ALIKE_RMS = 4.0
"""Pass 2 includes every patch within this RMS distance, in grey levels (tau = 16 k^2)."""


FLAT_GAMMA = 1.05
"""A group of pass 1 whose variance stays below gamma sigma^2 holds nothing but noise (homogeneous
area criterion).
"""


@dataclass(frozen=True)
class Quality:
    """A compromise between time and quality of NL-Bayes.

    The published method has no limit on groups, and visits every second pixel unless an earlier
    group contained it.

    Attributes:
        stride_px: the distance in pixels of neighbouring reference patches; a smaller one takes
            longer.
        group_cap: the largest size of a group in pass 2, in multiples of the usual size.
    """

    stride_px: int
    group_cap: int


QUALITIES = {"fast": Quality(4, 2), "standard": Quality(3, 4), "best": Quality(2, 8)}


@dataclass(frozen=True)
class PassSettings:
    """The parameters of one of the two passes of NL-Bayes, by the letters of its authors.

    Attributes:
        side_px: k, the side of a patch.
        similar: N, the usual number of patches of a group.
        most_similar: the largest number of patches of a group, which is reached where more than N
            patches differ by less than ALIKE_RMS.
        excess: beta, the factor on the noise variance.
        clean_guide: True in pass 2, in which the guide's covariance is that of the signal alone,
            without noise.
    """

    side_px: int
    similar: int
    most_similar: int
    excess: float
    clean_guide: bool

    @property
    def window_px(self) -> int:
        """The number of candidates along each axis of the search window: about N / 2, odd so that
        there is a middle.
        """
        return self.similar // 2 | 1

    @property
    def margin_px(self) -> int:
        """The number of pixels beyond the border that the search around a reference patch centred
        on a border pixel needs.
        """
        return self.window_px // 2 + self.side_px // 2


def first_pass(sigma: float) -> PassSettings:
    """Return the published parameters of pass 1, in which the noisy image is its own guide, for
    noise of standard deviation `sigma`.
    """
    side_px = 5 if sigma < 30 else 7
    similar = _below(sigma, {10: 35, 30: 45, 80: 90}, 100)
    excess = _below(sigma, {15: 1.1, 70: 1.0}, 0.9)
    return PassSettings(side_px, similar, similar, excess, clean_guide=False)


def second_pass(sigma: float, quality: Quality) -> PassSettings:
    """Return the published parameters of pass 2, in which the result of pass 1 is the guide.

    Args:
        sigma: the standard deviation of the noise.
        quality: its `group_cap` limits the size of a group, which the published method does not.
    """
    similar = _below(sigma, {20: 15, 40: 25, 80: 30}, 45)
    excess = _below(sigma, {15: 1.1, 35: 1.0}, 0.9)
    return PassSettings(5, similar, quality.group_cap * similar, excess, clean_guide=True)


def _below(sigma: float, table: dict[int, T], otherwise: T) -> T:
    """Return the value of the first bound that is above sigma, or `otherwise`."""
    return next((value for bound, value in table.items() if sigma < bound), otherwise)


JITTER = 1e-3
"""Added to the diagonal of a noisy covariance, in units of sigma^2.

Up to 1e-2 costs less than 0.01 dB (measured).
"""


def estimate_groups(
    noisy: Tensor, guide: Tensor, mask: Tensor | None, noise: Noise, settings: PassSettings
) -> Tensor:
    """Compute the posterior mean of every patch: P - beta Sigma S^-1 (P - mean of P), with Sigma
    the covariance of the noise.

    1. Pass 1: S is the covariance of the noisy patches, signal and noise together.
    2. Pass 2: S is the covariance of the guide's patches plus beta Sigma.
    3. In a flat group of pass 1 (variance of all its pixels below gamma sigma^2) every pixel
       becomes their mean.
    4. If S has no Cholesky factor, the noisy patches are returned.

    Both S give P_mean + C S^-1 (P - P_mean) with C the signal's covariance, so only S needs an
    inverse (IPOL 2013, estimates of the first and the second step; there Sigma = sigma^2 I).

    Args:
        noisy: (B, N, k * k) groups of patches.
        guide: the same patches of the guide image, in which similarity was measured; in pass 1
            `noisy` itself.
        mask: (B, N), 1 for the patches that belong to their group and 0 for others, whose estimates
            are meaningless; None if all belong to it.
        noise: the noise of `noisy`.
        settings: the parameters of the pass.

    Returns:
        The estimates of all patches, (B, N, k * k).
    """
    mean, centred, covariance = _moments(noisy, mask)
    if guide is not noisy:
        covariance = _moments(guide, mask)[2]
    # The variance of all pixels of a group is that within the k * k positions (the trace) plus that
    # between them. Both sums are small, whereas in the sum of the squared pixels sigma^2 would be
    # lost in float32.
    variance = covariance.diagonal(dim1=1, dim2=2).mean(1) + mean[:, 0].var(1, correction=0)
    flat = variance < (0.0 if settings.clean_guide else FLAT_GAMMA * noise.sigma**2)
    # The matrix beta S^-1 Sigma, for patches as rows, or 0 where S has no Cholesky factor.
    shrinkage = torch.zeros_like(covariance)
    covariance = covariance[~flat]
    sigma_matrix = noise.covariance(settings.side_px).to(covariance) * settings.excess
    diagonal = covariance.diagonal(dim1=1, dim2=2)
    # A drawn or saturated area has rank 0 or 1. Its covariance is then known only up to rounding.
    diagonal.add_(torch.finfo(covariance.dtype).eps * diagonal.sum(1, keepdim=True))
    if settings.clean_guide:
        covariance = covariance + sigma_matrix
    else:
        diagonal.add_(JITTER * noise.sigma**2)
    factor, failed = torch.linalg.cholesky_ex(covariance)
    no_factor = failed != 0
    # Any factor is valid there, because its result is not used. The batch has to stay one call.
    factor[no_factor] = torch.eye(factor.shape[1], dtype=factor.dtype, device=factor.device)
    solved = torch.cholesky_inverse(factor) @ sigma_matrix
    solved[no_factor] = 0
    shrinkage[~flat] = solved
    estimates = torch.baddbmm(noisy, centred, shrinkage, alpha=-1)
    # The plain mean uses that the signal is one number. The Gaussian model would have to find that
    # out.
    estimates[flat] = mean[flat].mean(2, keepdim=True)
    return estimates


def _moments(patches: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean patch (B, 1, k * k), the patches without it, and their covariance.

    Only patches in the mask count. The covariance is divided by their number and not by one less,
    as published.
    """
    if mask is None:
        mean = patches.mean(1, keepdim=True)
        centred = patches - mean
        return mean, centred, centred.mT @ centred / patches.shape[1]
    share = mask / mask.sum(1, keepdim=True)
    mean = share[:, None] @ patches
    centred = patches - mean
    return mean, centred, centred.mT @ (centred * share[..., None])
