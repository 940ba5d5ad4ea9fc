"""PSNR and SSIM, in float64, with the data range always stated."""

import math

import numpy as np
import torch
from torch import Tensor

from profiles.errors import ImageError

SSIM_SIGMA_PX, SSIM_RADIUS_PX = 1.5, 5
MIN_SIDE_PX = 2 * SSIM_RADIUS_PX + 1


def psnr_db(image: np.ndarray, reference: np.ndarray, data_range: float) -> float:
    """10 log10(range^2 / mean squared error); infinite for identical images, NaN where pixels are not finite.

    Args:
        image: any shape.
        reference: the same shape.
        data_range: the span of legal values, 4095 for 12-bit DN; never guessed from the type.
    """
    difference = np.asarray(image, np.float64) - np.asarray(reference, np.float64)
    error = float(np.mean(difference**2))
    if not math.isfinite(error):
        return math.nan
    return math.inf if error == 0 else 10 * math.log10(data_range**2 / error)


def ssim(image: np.ndarray, reference: np.ndarray, data_range: float) -> float:
    """Mean structural similarity (Wang et al. 2004): Gaussian window 11 x 11, sigma 1.5, biased covariance.

    Args:
        image: (H, W), at least 11 pixels a side.
        reference: (H, W).
        data_range: the span of legal values.

    The images' common mean is taken off first: in E[x^2] - E[x]^2 it would cost digits.
    """
    if min(image.shape) < MIN_SIDE_PX:
        expected, got = f"at least {MIN_SIDE_PX} pixels a side", " x ".join(map(str, image.shape[::-1]))
        raise ImageError("SSIM", expected=expected, got=got, remedy="give larger images")
    offset = float(np.mean(reference, dtype=np.float64))
    x, y = (torch.from_numpy(np.asarray(a, np.float64) - offset) for a in (image, reference))
    moments = _window_mean(torch.stack([x, y, x * x, y * y, x * y]))
    mean_x, mean_y, xx, yy, xy = moments
    var_x, var_y = (xx - mean_x**2).clamp(min=0), (yy - mean_y**2).clamp(min=0)
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    light_x, light_y = mean_x + offset, mean_y + offset
    luminance = (2 * light_x * light_y + c1) / (light_x**2 + light_y**2 + c1)
    structure = (2 * (xy - mean_x * mean_y) + c2) / (var_x + var_y + c2)
    return float((luminance * structure).mean())


def _window_mean(images: Tensor) -> Tensor:
    """Gaussian mean of (K, H, W) where the window fits: (K, H - 10, W - 10)."""
    x = torch.arange(-SSIM_RADIUS_PX, SSIM_RADIUS_PX + 1, dtype=torch.float64)
    kernel = torch.exp(-0.5 * (x / SSIM_SIGMA_PX) ** 2)
    kernel = (kernel / kernel.sum())[None, None, :, None]
    rows = torch.nn.functional.conv2d(images[:, None], kernel)
    return torch.nn.functional.conv2d(rows, kernel.transpose(2, 3))[:, 0]
