"""Compute the paper's loss: 1.0 L1 + 0.5 LPIPS + 0.1 FFT-L1 (paper, training section), each term
reported.

Two more terms are available. An L2 term serves the highest PSNR, which is a mean of squares,
whereas L1 tolerates errors at the strongest edges. A PSNR term is its mean over the patches: small
errors of a sharp and quiet sensor count as much as large ones of a blurred and noisy sensor (as in
NAFNet, Chen et al., ECCV 2022).

The consistency step of a restoration removes errors at low spatial frequencies, because the raw
image shows these correctly. `coarse` below 1 makes an error there count less, so that a network
concentrates on the rest. G of `model.consistency` is applied to the error, and all but that share
of the result is subtracted.

LPIPS needs weights that are not shipped; without them the loss is L1 + FFT-L1, and the recipe
records that.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from pydantic import with_config
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from beers_deploy.model.consistency.blocks import BLOCK_PX
from beers_deploy.model.metrics.perceptual import Lpips
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.profiles.validation import CONFIG, Amount


@with_config(CONFIG)
@dataclass(frozen=True)
class LossWeights:
    """The weight of each term of the training loss; a term of weight 0 is not computed.

    `coarse` is the share, in all terms, of the part of an error that the consistency step removes.
    """

    l1: Amount = 1.0
    lpips: Amount = 0.5
    fft: Amount = 0.1
    psnr: Amount = 0.0
    coarse: Amount = 1.0


PAPER = LossWeights()


class RestorationLoss:
    """The weighted sum of the terms, computed in float32 even within autocast. It includes LPIPS if
    `perceptual` is given.
    """

    def __init__(self, weights: LossWeights = PAPER, perceptual: Lpips | None = None) -> None:
        self.weights = weights
        self.perceptual = perceptual if weights.lpips else None

    def __call__(self, restored: Tensor, reference: Tensor) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Compute the loss, and its terms before weighting, of images (N, 1, H, W) in [0, 1] of
        full scale.

        The images are not clipped.
        """
        weights = self.weights
        # In bfloat16 the differences of nearly equal images would lose most of their digits.
        with torch.autocast(restored.device.type, enabled=False):
            restored = restored.float()
            reference = reference.float()
            if weights.coarse != 1:
                restored = restored - (1 - weights.coarse) * coarse(restored - reference)
            terms = {"l1": (restored - reference).abs().mean()}
            total = weights.l1 * terms["l1"]
            for name, term in {"fft": fft_l1, "psnr": log_mse}.items():
                if weight := getattr(weights, name):
                    terms[name] = term(restored, reference)
                    total = total + weight * terms[name]
            if self.perceptual is not None:
                terms["lpips"] = self.perceptual(restored, reference).mean()
                total = total + weights.lpips * terms["lpips"]
        return total, {name: term.detach() for name, term in terms.items()}


def coarse(error: Tensor) -> Tensor:
    """Compute the part of an error (N, 1, H, W) that the consistency step would remove.

    The error is averaged over whole blocks, and the means are interpolated bilinearly between the
    centres of the blocks.
    """
    means = avg_pool2d(error, BLOCK_PX)
    interpolated: Tensor = interpolate(
        means, size=error.shape[-2:], mode="bilinear", align_corners=False
    )
    return interpolated


def log_mse(restored: Tensor, reference: Tensor) -> Tensor:
    """Compute the mean over the batch of ln(1 + mean squared error in DN^2 of 12 bits).

    10 / ln 10 of it is lost PSNR in dB. Images are (N, 1, H, W) float32. The 1 keeps the argument
    above 0, and tolerates the rounding of a patch.
    """
    squares = ((restored - reference) * MAX_DN).square().mean((1, 2, 3))
    distance: Tensor = torch.log1p(squares).mean()
    return distance


def fft_l1(restored: Tensor, reference: Tensor) -> Tensor:
    """Compute the mean absolute difference of the orthonormal spectra: about 1.1 times the L1 for
    any patch size.

    Images are (N, 1, H, W) float32. Without that normalisation it would be 142 times the L1 at 128
    pixels, and twice that at 256. The absolute value is computed by abs(), whose gradient at 0 is
    0; that of sqrt(re^2 + im^2) is NaN.
    """
    # The transform is orthonormal, so that the term does not grow with the patch. abs() has a
    # gradient at 0.
    size: Tensor = torch.fft.rfft2(restored - reference, norm="ortho").abs().mean()
    return size
