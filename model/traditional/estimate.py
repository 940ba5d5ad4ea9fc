"""The Bayesian step of NL-Bayes: a group of similar patches, each estimated under the group's Gaussian model."""

import torch
from torch import Tensor

from model.traditional.settings import PassSettings

JITTER = 1e-3
"""Added to the diagonal of a noisy covariance, in units of sigma^2. Up to 1e-2 costs less than 0.01 dB (measured)."""


def estimate_groups(noisy: Tensor, guide: Tensor, taken: Tensor, sigma: float, settings: PassSettings) -> Tensor:
    """Posterior mean of every patch: P - beta sigma^2 S^-1 (P - mean of P).

    1. Pass 1: S is the covariance of the noisy patches, signal and noise together.
    2. Pass 2: S is the covariance of the guide's patches plus beta sigma^2 I.
    3. A flat group of pass 1 (variance of all its pixels below gamma sigma^2): every pixel becomes their mean.
    4. No Cholesky factor of S: the noisy patches stay.

    Both S give P_mean + C S^-1 (P - P_mean) with C the signal's covariance, so only S needs an inverse (IPOL 2013,
    estimates of the first and the second step).

    Args:
        noisy: (B, N, k * k) groups of patches.
        guide: the same patches of the guide image; in pass 1 `noisy` itself.
        taken: (B, N) of 0 and 1: which patches the group counts; the others come back as they were.
        sigma: standard deviation of the noise.
        settings: those of the pass.
    """
    mean, centred = _centre(noisy, taken)
    spread = centred if guide is noisy else _centre(guide, taken)[1]
    # divided by the number of patches and not by one less, as published
    covariance = spread.mT @ spread / taken.sum(1)[:, None, None]
    flat = _is_flat(mean, covariance, settings.flat_gamma * sigma**2)
    shrinkage = torch.zeros_like(covariance)
    shrinkage[~flat] = _shrinkage(covariance[~flat], sigma, settings)
    estimates = torch.baddbmm(noisy, centred, shrinkage, alpha=-1)
    estimates[flat] = mean[flat].mean(2, keepdim=True)
    return estimates


def _centre(patches: Tensor, taken: Tensor) -> tuple[Tensor, Tensor]:
    """Mean patch (B, 1, k * k) of each group, and every taken patch without it (0 for the others)."""
    share = taken / taken.sum(1, keepdim=True)
    mean = share[:, None] @ patches
    return mean, (patches - mean).mul_(taken[..., None])


def _is_flat(mean: Tensor, covariance: Tensor, bound: float) -> Tensor:
    """(B,) whether the variance of all the pixels of a group stays below `bound`.

    It is the variance within the k * k positions, the trace, plus that between them: two small sums, where the sum
    of the squared pixels would drown sigma^2 in float32.
    """
    within = covariance.diagonal(dim1=1, dim2=2).mean(1)
    return within + mean[:, 0].var(1, correction=0) < bound


def _shrinkage(covariance: Tensor, sigma: float, settings: PassSettings) -> Tensor:
    """The matrix beta sigma^2 S^-1, or 0 where S has no Cholesky factor."""
    noise = settings.excess * sigma**2
    diagonal = covariance.diagonal(dim1=1, dim2=2)
    # A drawn or saturated area has rank 0 or 1: the covariance is then no better known than its own rounding.
    rounding = torch.finfo(covariance.dtype).eps * diagonal.sum(1, keepdim=True)
    diagonal.add_(rounding + (noise if settings.clean_guide else JITTER * sigma**2))
    factor, failed = torch.linalg.cholesky_ex(covariance)
    lost = failed != 0
    factor[lost] = torch.eye(factor.shape[1], dtype=factor.dtype, device=factor.device)
    shrinkage = noise * torch.cholesky_inverse(factor)
    shrinkage[lost] = 0
    return shrinkage
