"""Compute PSNR and SSIM of an image against its reference, in float64 and with an explicit data
range.
"""

import math

import numpy as np

from beers_deploy.profiles.errors import ImageError, optional
from beers_deploy.profiles.instrument import MAX_DN

SSIM_SIGMA_PX = 1.5
SSIM_RADIUS_PX = 5
MIN_SIDE_PX = 2 * SSIM_RADIUS_PX + 1


def psnr_db(image: np.ndarray, reference: np.ndarray, data_range: float) -> float:
    """Compute the peak signal-to-noise ratio in dB: 10 log10(range^2 / mean squared error).

    It is infinite for identical images, and NaN if pixels are not finite. scikit-image agrees to
    rounding, but divides by zero for identical images.

    Args:
        image: pixels of any shape.
        reference: the pixels to compare with, of the same shape.
        data_range: the span of valid values, 4095 for 12-bit DN; never guessed from the type.
    """
    difference = np.asarray(image, np.float64) - np.asarray(reference, np.float64)
    error = float(np.mean(difference**2))
    if not math.isfinite(error):
        return math.nan
    # scikit-image divides by zero where the images are identical.
    return math.inf if error == 0 else 10 * math.log10(data_range**2 / error)


def ssim(image: np.ndarray, reference: np.ndarray, data_range: float) -> float:
    """Compute the mean structural similarity (Wang et al. 2004) by scikit-image: 1 for identical
    images, without a unit.

    It uses the paper's Gaussian window of 11 x 11 pixels, sigma 1.5, and the biased covariance. The
    mean is over the pixels around which the whole window fits. It is NaN if one of the images is
    not finite.

    Args:
        image: (H, W), at least 11 pixels a side.
        reference: the image to compare with, (H, W).
        data_range: the span of valid values, 4095 for 12-bit DN.

    Raises:
        ImageError: the image is smaller than the window.
    """
    # Imported here, because PSNR alone needs none of its half second.
    metrics = optional("skimage.metrics", "ssim")

    if min(image.shape) < MIN_SIDE_PX:
        raise ImageError(
            f"SSIM needs images of at least {MIN_SIDE_PX} pixels a side, but these have "
            f"{' x '.join(map(str, image.shape[::-1]))} pixels. Give larger images."
        )
    # In float64: scikit-image would compute float32 images in float32, off by some 1e-8.
    pair = (np.asarray(each, np.float64) for each in (image, reference))
    window = {"gaussian_weights": True, "sigma": SSIM_SIGMA_PX, "use_sample_covariance": False}
    with np.errstate(invalid="ignore"):
        return float(metrics.structural_similarity(*pair, data_range=data_range, **window))


def fidelity_db(
    dn: np.ndarray, reference: np.ndarray, degraded: np.ndarray, max_dn: int = MAX_DN
) -> float:
    """Compute the PSNR in dB of a restored image, over the pixels that neither its input nor the
    reference clips.

    The true values of clipped pixels are unknown. If all pixels are clipped, all are used.

    Args:
        dn: digital numbers of the restored image, any shape.
        reference: digital numbers of the image to compare with, of the same shape.
        degraded: digital numbers of the input of the restoration, of the same shape.
        max_dn: full scale, from which on a pixel counts as clipped; by default that of 12 bits.
    """
    valid = (reference < max_dn) & (degraded < max_dn)
    valid |= not valid.any()
    return psnr_db(dn[valid], reference[valid], max_dn)
