"""The modulation transfer function: how much contrast an instrument keeps at each spatial frequency."""

import math
from functools import lru_cache

import torch
from torch import Tensor

from profiles.errors import OptionError
from profiles.sensor import MTF_NYQUIST_MAX

NYQUIST = 0.5
"""Cycles per target pixel."""


def gamma_from_mtf(mtf_nyquist: float) -> float:
    """Solve MTF(0.5, 0) = mtf_nyquist for gamma: gamma = -2 ln(mtf_nyquist * pi / 2) (paper, section 3.3).

    Limits: 2/pi gives 0 (the square detector alone); towards 0 it grows without bound.

    Raises:
        OptionError: outside (0, 2/pi], where the "blur" would amplify or erase everything.
    """
    if not 0 < mtf_nyquist <= MTF_NYQUIST_MAX:
        raise OptionError(
            "MTF at Nyquist",
            expected=f"a ratio above 0 and up to {MTF_NYQUIST_MAX:.4f}",
            got=repr(mtf_nyquist),
            remedy="0.07 means 7 %",
        )
    # max: at 2/pi itself the rounding of the product may fall on either side of 1
    return max(-2 * math.log(mtf_nyquist * math.pi / 2), 0.0)


def mtf(fx: Tensor, fy: Tensor, mtf_nyquist: float) -> Tensor:
    """MTF(fx, fy) = exp(-gamma * sqrt(fx^2 + fy^2)) * sinc(fx) * sinc(fy) (paper, section 3.3).

    Args:
        fx: horizontal frequencies in cycles per TARGET pixel, float64, broadcast against fy.
        fy: vertical frequencies, likewise. Beyond 1 the sinc is negative, and stays so.
        mtf_nyquist: contrast kept at fx = 0.5, fy = 0.
    """
    radius = torch.hypot(fx, fy)
    return torch.exp(-gamma_from_mtf(mtf_nyquist) * radius) * torch.sinc(fx) * torch.sinc(fy)


@lru_cache(maxsize=64)
def transfer_function(
    height: int, width: int, oversampling: int, mtf_nyquist: float, device: torch.device | None = None
) -> Tensor:
    """The MTF on the half spectrum of a scene: (H, W // 2 + 1) float32, ready to multiply an rfft2.

    `height` and `width` are in scene pixels, `oversampling` of which make one target pixel.
    """
    fy = torch.fft.fftfreq(height, 1 / oversampling, dtype=torch.float64, device=device)[:, None]
    fx = torch.fft.rfftfreq(width, 1 / oversampling, dtype=torch.float64, device=device)[None, :]
    return mtf(fx, fy, mtf_nyquist).float()
