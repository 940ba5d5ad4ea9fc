"""The steps of the traditional pipeline on whole images."""

import torch
from torch import Tensor

from beers_deploy.model.traditional.compensate import compensation_kernel, filter_strips
from beers_deploy.model.traditional.nl_bayes import nl_bayes_strips
from beers_deploy.model.traditional.noise import Noise
from beers_deploy.model.traditional.patch_groups import QUALITIES, Quality
from tests.model.simulator.stages import with_contrast


def nl_bayes(image: Tensor, noise: Noise, quality: Quality = QUALITIES["standard"]) -> Tensor:
    """Denoise an image (H, W)."""
    return torch.cat(list(nl_bayes_strips([image], len(image), noise, quality)))


def compensate(image: Tensor, mtf_from: float, mtf_to: float, epsilon: float) -> Tensor:
    """Filter (H, W) by `compensation_kernel`; with equal MTFs only the regularization acts."""
    kernel = compensation_kernel(with_contrast(mtf_from), with_contrast(mtf_to), epsilon)
    return torch.cat(list(filter_strips([image], len(image), kernel)))
