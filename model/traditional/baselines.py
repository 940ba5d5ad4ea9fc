"""Restore images by methods of scikit-image, as baselines for tables.

Each aims at the reference's MTF and is not tuned further.

The three deconvolutions undo the degraded MTF completely, and the result is blurred to the
reference's. Non-local means replaces NL-Bayes in the pipeline.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from scipy import fft
from skimage import restoration
from torch import Tensor

from beers_deploy.model.simulator.detector import to_dn, to_radiance
from beers_deploy.model.simulator.mtf import sensor_transfer
from beers_deploy.model.traditional.compensate import filter_strips
from beers_deploy.model.traditional.noise import (
    bias_radiance,
    destabilise,
    stabilise,
    with_rounding_noise,
)
from beers_deploy.model.traditional.pipeline import TraditionalPipeline
from beers_deploy.model.traditional.rows import mirrored

PAD_PX = 64
WIENER_BALANCE = 0.01
RICHARDSON_LUCY_STEPS = 20
NLM_PATCH_PX = 5
NLM_DISTANCE_PX = 6
NLM_STRENGTH = 0.6

Baseline = Callable[[Tensor, TraditionalPipeline], Tensor]
"""A function of digital numbers (H, W) of the degraded sensor and the two sensors. It returns those
of the reference.
"""


def wiener(image: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """Deconvolve an image by scikit-image's Wiener filter with a Laplacian regulariser, balance
    0.01.

    Args:
        image: (H, W) float64, with a scale on which full scale is 1.
        blur: the transfer function of the blur to undo on the half spectrum, (H, W // 2 + 1).

    Returns:
        The sharpened image (H, W), on the same scale.
    """
    return np.asarray(restoration.wiener(image, blur.astype(complex), WIENER_BALANCE, clip=False))


def unsupervised_wiener(image: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """Deconvolve an image by scikit-image's Wiener filter that estimates its own regularisation
    (seed 0).

    Args:
        image: (H, W) float64, with a scale on which full scale is 1.
        blur: the transfer function of the blur to undo on the half spectrum, (H, W // 2 + 1).

    Returns:
        The sharpened image (H, W), on the same scale.
    """
    restored, _ = restoration.unsupervised_wiener(image, blur.astype(complex), clip=False, rng=0)
    return np.asarray(restored)


def richardson_lucy(image: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """Deconvolve an image by scikit-image's Richardson-Lucy algorithm with 20 iterations.

    Args:
        image: (H, W) float64, with a scale on which full scale is 1.
        blur: the transfer function of the blur to undo on the half spectrum, (H, W // 2 + 1).

    Returns:
        The sharpened image (H, W), on the same scale.
    """
    side = 2 * PAD_PX + 1
    psf = np.roll(fft.irfft2(blur, s=image.shape), (PAD_PX, PAD_PX), (0, 1))[:side, :side]
    # Richardson-Lucy is defined for kernels that are nowhere negative, and this one may ring below
    # 0.
    psf = np.maximum(psf, 0)
    # It divides by its own blurred estimate, which goes to 0 where the image is 0.
    light = np.maximum(image, 1e-6)
    return np.asarray(
        restoration.richardson_lucy(light, psf / psf.sum(), RICHARDSON_LUCY_STEPS, clip=False)
    )


def nl_means(dn: Tensor, pipeline: TraditionalPipeline) -> Tensor:
    """Restore an image by the traditional pipeline with scikit-image's non-local means in place of
    NL-Bayes.

    It uses 5 x 5 patches within 6 pixels and h = 0.6 sigma.

    Args:
        dn: digital numbers (H, W) of the degraded sensor.
        pipeline: the two sensors; an epsilon is derived from the image if it has none.

    Returns:
        Digital numbers (H, W) of the reference.
    """
    sensor = with_rounding_noise(pipeline.degraded)
    stable = stabilise(to_radiance(dn, pipeline.degraded), sensor)
    clean = restoration.denoise_nl_means(
        stable.numpy(), NLM_PATCH_PX, NLM_DISTANCE_PX, h=NLM_STRENGTH, sigma=1.0, fast_mode=True
    )
    radiance = destabilise(torch.from_numpy(clean).float(), sensor) + bias_radiance(sensor)
    kernel = pipeline.fitted_to([dn]).kernel()
    sharp = torch.cat(list(filter_strips([radiance], len(radiance), kernel)))
    return to_dn(sharp, pipeline.reference)


def _deconvolved(
    deconvolve: Callable[[np.ndarray, np.ndarray], np.ndarray],
    dn: Tensor,
    pipeline: TraditionalPipeline,
) -> Tensor:
    """Undo the degraded MTF on mirrored borders, at a scale of 1 for full scale, and blur to the
    reference's.

    `deconvolve` accepts an image (H, W) and the half spectrum of its blur, (H, W // 2 + 1).
    """
    full_scale = pipeline.degraded.max_dn / pipeline.degraded.gain_dn_per_radiance
    rows, columns = (mirrored(-PAD_PX, size + PAD_PX, size) for size in dn.shape)
    height = len(rows)
    width = len(columns)
    share = (dn.double() - pipeline.degraded.offset_dn) / pipeline.degraded.max_dn
    padded = share[rows][:, columns].numpy()
    blur, target = (
        sensor_transfer(height, width, 1, sensor)
        for sensor in (pipeline.degraded, pipeline.reference)
    )
    sharp = fft.rfft2(deconvolve(padded, blur)) * target
    inside = fft.irfft2(sharp, s=(height, width))[PAD_PX:-PAD_PX, PAD_PX:-PAD_PX]
    return to_dn(torch.from_numpy((inside * full_scale).astype(np.float32)), pipeline.reference)


BASELINES: dict[str, Baseline] = {
    "wiener": partial(_deconvolved, wiener),
    "unsupervised-wiener": partial(_deconvolved, unsupervised_wiener),
    "richardson-lucy": partial(_deconvolved, richardson_lucy),
    "nl-means": nl_means,
}
