"""Compensate the MTF: convert the contrast of one sensor to that of another.

The filter is finite. Each pixel depends on those within RADIUS_PX only, so strips, missing pixels
and borders have no effect beyond that distance.
"""

from collections.abc import Iterable, Iterator
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from torch import Tensor

from beers_deploy.model.bank import cut_filter, restoring_gain
from beers_deploy.model.simulator.mtf import sensor_mtf
from beers_deploy.model.traditional.rows import Rows, fill_with_local_means, map_tiles, mirrored
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import NYQUIST

RADIUS_PX = 64
"""Half the filter's side.

The gain's kink at DC gives it a slow tail: half a per cent of its weight lies beyond.
"""

BLOCK_PX = 384
"""Side of the blocks that are filtered at once: with the radius around it, an FFT of 512."""


def filter_strips(strips: Iterable[Tensor], height: int, kernel: Tensor) -> Iterator[Tensor]:
    """Filter an image that arrives in strips of rows.

    Unit and mean are preserved, and borders are mirrored. Blocks lie on a grid of their own, so
    that the result does not depend on the input strips, bit for bit. NaN pixels are filled from
    their neighbours first, and are NaN again in the result.

    Args:
        strips: the rows of the image (H, W) from top to bottom, in strips (any, W).
        height: the number of rows H of the image.
        kernel: the filter (K, K), K odd, whose sum is 1.

    Yields:
        The filtered image in strips of BLOCK_PX rows; the last strip may have fewer.
    """
    # The grid of blocks is fixed from row 0: the result may not depend on how the strips were cut.
    rows = Rows(strips)
    radius = kernel.shape[0] // 2
    for top in range(0, height, BLOCK_PX):
        bottom = min(top + BLOCK_PX, height)
        window = rows.window(mirrored(top - radius, bottom + radius, height))
        lefts = range(0, window.shape[1], BLOCK_PX)
        yield torch.cat(list(map_tiles(partial(_block, window, kernel), lefts)), 1)


def _block(rows: Tensor, kernel: Tensor, left: int) -> Tensor:
    """Filter columns left..left + BLOCK_PX - 1; the result has `radius` rows fewer above and below.

    It runs on one thread, because with several threads a transform adds in another order, which
    changes the last bits.
    """
    radius = kernel.shape[0] // 2
    width = rows.shape[1]
    right = min(left + BLOCK_PX, width)
    block = rows[:, mirrored(left - radius, right + radius, width)]
    valid = torch.isfinite(block)
    # Filtered without its mean, which has gain 1: in float32 the FFT of large constant values costs
    # digits.
    mean = block[valid].mean() if bool(valid.any()) else block.new_zeros(())
    size = tuple(next_fast_len(side, real=True) for side in block.shape)
    spectrum = torch.fft.rfft2(fill_with_local_means(block, valid) - mean, s=size)
    gain = torch.fft.rfft2(kernel, s=size).to(spectrum)
    filtered: Tensor = torch.fft.irfft2(spectrum * gain, s=size)
    inside = slice(2 * radius, block.shape[0]), slice(2 * radius, block.shape[1])
    core = slice(radius, -radius), slice(radius, -radius)
    return (filtered[inside] + mean).where(valid[core], torch.nan)


def compensation_kernel(degraded: Instrument, reference: Instrument, epsilon: float) -> Tensor:
    """Compute a filter that converts an image with the blur of one sensor to that of another.

    It is the filter with the gain `compensation_gain`, cut to 2 R + 1 pixels and corrected to the
    sum 1. Of three pairs of blurs the cut changes the gain by up to 0.7 % below 2 cycles per 2 R
    pixels, 0.1 % above, and 3 % near Nyquist (measured).

    Args:
        degraded: the instrument that acquired the image.
        reference: the instrument whose blur is to be reached.
        epsilon: strength of the regularisation, 0 or more; a larger one sharpens less.

    Returns:
        The filter (2 R + 1, 2 R + 1) float64, with the sum 1 and R = RADIUS_PX.
    """
    # Sampled this finely, the slow tail folds back onto the filter little.
    side = 8 * RADIUS_PX
    gain = compensation_gain(side, side, degraded, reference, epsilon)
    return torch.from_numpy(cut_filter(np.fft.irfft2(gain, (side, side)), RADIUS_PX, total=1))


def compensation_gain(
    height: int, width: int, degraded: Instrument, reference: Instrument, epsilon: float
) -> NDArray[np.inexact]:
    """Compute G = T H* / (|H|^2 + epsilon r^2), the gain that converts one blur to another, at each
    frequency.

    H is the MTF to compensate, H* its conjugate, T the MTF to reach, r = |f| / f_Nyquist. Limits:
    epsilon = 0 gives T / H, with up to 20 times the noise at the corner of the spectrum for 3 to 25
    %; a large epsilon blurs.

    Args:
        height: the number of rows of the image.
        width: the number of columns of the image.
        degraded: the instrument with the MTF H, smear and anti-alias filter included.
        reference: the instrument with the MTF T.
        epsilon: strength of the regularisation, 0 or more.

    Returns:
        The gain on the half spectrum, (height, width // 2 + 1) float64; complex128 if H or T is
        that of a point-spread function.
    """
    fy = np.fft.fftfreq(height)[:, None]
    fx = np.fft.rfftfreq(width)[None, :]
    r_squared = (fx**2 + fy**2) / NYQUIST**2
    blur = sensor_mtf(fx, fy, degraded)
    return restoring_gain(blur, sensor_mtf(fx, fy, reference), r_squared, epsilon)
