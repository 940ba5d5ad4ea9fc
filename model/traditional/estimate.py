"""The Bayesian step of NL-Bayes: a group of similar patches, each estimated under the group's Gaussian model."""

import torch
from torch import Tensor

from model.traditional.noise import Noise
from model.traditional.settings import PassSettings

JITTER = 1e-3
"""Added to the diagonal of a noisy covariance, in units of sigma^2. Up to 1e-2 costs less than 0.01 dB (measured)."""


def estimate_groups(
    noisy: Tensor, guide: Tensor, taken: Tensor | None, noise: Noise, settings: PassSettings
) -> Tensor:
    """Posterior mean of every patch: P - beta Sigma S^-1 (P - mean of P), Sigma the covariance of the noise.

    1. Pass 1: S is the covariance of the noisy patches, signal and noise together.
    2. Pass 2: S is the covariance of the guide's patches plus beta Sigma.
    3. A flat group of pass 1 (variance of all its pixels below gamma sigma^2): every pixel becomes their mean.
    4. No Cholesky factor of S: the noisy patches stay.

    Both S give P_mean + C S^-1 (P - P_mean) with C the signal's covariance, so only S needs an inverse (IPOL 2013,
    estimates of the first and the second step; there Sigma = sigma^2 I).

    Args:
        noisy: (B, N, k * k) groups of patches.
        guide: the same patches of the guide image; in pass 1 `noisy` itself.
        taken: (B, N) of 0 and 1: which patches the group counts, None for all; the others' estimates mean nothing.
        noise: that of `noisy`.
        settings: those of the pass.
    """
    mean, centred, covariance = _moments(noisy, taken)
    if guide is not noisy:
        covariance = _moments(guide, taken)[2]
    flat = _is_flat(mean, covariance, settings.flat_gamma * noise.sigma**2)
    shrinkage = torch.zeros_like(covariance)
    shrinkage[~flat] = _shrinkage(covariance[~flat], noise, settings)
    estimates = torch.baddbmm(noisy, centred, shrinkage, alpha=-1)
    estimates[flat] = mean[flat].mean(2, keepdim=True)
    return estimates


def _moments(patches: Tensor, taken: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Mean patch (B, 1, k * k), the patches without it, and their covariance, of the taken patches.

    Divided by their number and not by one less, as published.
    """
    if taken is None:
        mean = patches.mean(1, keepdim=True)
        centred = patches - mean
        return mean, centred, centred.mT @ centred / patches.shape[1]
    share = taken / taken.sum(1, keepdim=True)
    mean = share[:, None] @ patches
    centred = patches - mean
    return mean, centred, centred.mT @ (centred * share[..., None])


def _is_flat(mean: Tensor, covariance: Tensor, bound: float) -> Tensor:
    """(B,) whether the variance of all the pixels of a group stays below `bound`.

    It is the variance within the k * k positions, the trace, plus that between them: two small sums, where the sum
    of the squared pixels would drown sigma^2 in float32.
    """
    within = covariance.diagonal(dim1=1, dim2=2).mean(1)
    return within + mean[:, 0].var(1, correction=0) < bound


def _shrinkage(covariance: Tensor, noise: Noise, settings: PassSettings) -> Tensor:
    """The matrix beta S^-1 Sigma, for patches as rows, or 0 where S has no Cholesky factor."""
    sigma_matrix = noise.covariance(settings.side_px).to(covariance) * settings.excess
    diagonal = covariance.diagonal(dim1=1, dim2=2)
    # A drawn or saturated area has rank 0 or 1: the covariance is then no better known than its own rounding.
    diagonal.add_(torch.finfo(covariance.dtype).eps * diagonal.sum(1, keepdim=True))
    if settings.clean_guide:
        covariance = covariance + sigma_matrix
    else:
        diagonal.add_(JITTER * noise.sigma**2)
    factor, failed = torch.linalg.cholesky_ex(covariance)
    lost = failed != 0
    factor[lost] = torch.eye(factor.shape[1], dtype=factor.dtype, device=factor.device)
    shrinkage = torch.cholesky_inverse(factor) @ sigma_matrix
    shrinkage[lost] = 0
    return shrinkage
