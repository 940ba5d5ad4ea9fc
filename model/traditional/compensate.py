"""MTF compensation: from the contrast that one sensor keeps to the contrast that another would have kept."""

import torch
from torch import Tensor

from model.simulator.mtf import NYQUIST, mtf
from model.traditional.padding import mirror_pad
from profiles.errors import OptionError

EPSILON = 3e-3
"""Regularisation at Nyquist. Of 1e-3, 3e-3 and 1e-2, the best from 7 to 25 % MTF on a photograph (measured)."""

PAD_PX = 64
"""Mirrored border: what the filter's slow tail would otherwise carry across from the opposite side."""


def compensate(image: Tensor, mtf_from: float, mtf_to: float, epsilon: float = EPSILON) -> Tensor:
    """Filter (H, W) by the gain of `compensation_gain`, on mirrored borders; the unit of the pixels is kept.

    Limits: a constant image is unchanged, up to rounding. With equal MTFs only the regularisation acts.
    """
    height, width = (_fast_length(size + 2 * PAD_PX) for size in image.shape)
    after = height - image.shape[0] - PAD_PX, width - image.shape[1] - PAD_PX
    # Filtered without its mean, which has gain 1: in float32 the FFT of large constant values costs digits.
    mean = image.mean()
    padded = mirror_pad(image - mean, PAD_PX, after)
    gain = compensation_gain(height, width, mtf_from, mtf_to, epsilon).to(image)
    filtered: Tensor = torch.fft.irfft2(torch.fft.rfft2(padded) * gain, s=(height, width))
    return filtered[PAD_PX : PAD_PX + image.shape[0], PAD_PX : PAD_PX + image.shape[1]] + mean


def compensation_gain(height: int, width: int, mtf_from: float, mtf_to: float, epsilon: float = EPSILON) -> Tensor:
    """G = T H / (H^2 + epsilon r^2) on the half spectrum, (height, width // 2 + 1) float64.

    H is the MTF to undo, T the one to reach, r = |f| / f_Nyquist. Weighted by r^2, epsilon leaves G(0) at exactly 1;
    a constant epsilon would scale the image by 1 / (1 + epsilon). Limits: epsilon = 0 gives T / H, with up to 20
    times the noise at the corner of the spectrum for 3 to 25 %; a large epsilon blurs.

    Args:
        height: rows of the image.
        width: columns of the image.
        mtf_from: MTF at Nyquist of the image, in (0, 2 / pi].
        mtf_to: MTF at Nyquist to reach, likewise.
        epsilon: regularisation, 0 or more.
    """
    if not 0 <= epsilon < float("inf"):
        raise OptionError("epsilon", expected="0 or more", got=repr(epsilon), remedy=f"{EPSILON:g} is the default")
    fy = torch.fft.fftfreq(height, dtype=torch.float64)[:, None]
    fx = torch.fft.rfftfreq(width, dtype=torch.float64)[None, :]
    blur, target = mtf(fx, fy, mtf_from), mtf(fx, fy, mtf_to)
    r_squared = (fx.square() + fy.square()) / NYQUIST**2
    gain: Tensor = target * blur / (blur.square() + epsilon * r_squared)
    return gain


def _fast_length(size: int) -> int:
    """The next size of factors 2, 3 and 5, on which an FFT is quick."""
    while _rest(size) > 1:
        size += 1
    return size


def _rest(size: int) -> int:
    """What is left of a size once its factors 2, 3 and 5 are divided out."""
    for factor in (2, 3, 5):
        while size % factor == 0:
            size //= factor
    return size
