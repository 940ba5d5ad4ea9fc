"""Compute the integer bank of a sensor: the first convolution of an INT8 network, from the sensor
alone.

The image enters in the planes of `host_part.BANK_SLICES`: steps of 16 digital numbers (DN) about
the middle, twice, their remainder, and half of that for finer weights. The first two share a
filter's weights, which may therefore be twice as large: half the rounding error. Weights are
rounded so that they sum to exactly 0, because flat ground must give 0, and so that their errors lie
where natural images have little energy.

The results of the filters are int8 in steps of 1/24 of a unit, for a sensor whose noise is
`model.bank.SIGMA`. Another sensor's steps are the same share of full scale, within limits
(`Bank.gain`). The strongest edges are a share of full scale, not of noise, so noisy sensors can
have finer steps in their units. Each result is written in several copies, rounded at different
offsets within a step: jointly they are more precise than one. The image itself has steps of 32 /
gain, about the middle.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beers_deploy.model.bank import FILTERS, SIDE_PX, UNIT_STEPS, WIDE, Bank, in_places
from beers_deploy.model.variants import Kernels
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.profiles.response import Array
from beers_deploy.quant.host_part import BANK_SLICES

STEP_DN = BANK_SLICES.step
PART = BANK_SLICES.part
IMAGE_STEP_DN = 32

BITS = 7
"""The stated fractional bits of a result: int8 then represents -1 to 1, which is 5.3 units or half
of full scale.
"""

LARGEST = 2 * 124
"""The limit of the sum of two coarse weights before rounding. The corrections that make weights sum
to 0, and copies complete each other, then still fit int8.
"""

COPIES = (1, 2, 7)
"""The numbers of copies of the image, of each filter, and of the analytic restoration: 16 channels
for each pixel of a place.
"""

GRID_BITS = 16
"""Fractional bits of the numbers with which weights are fitted. Weights are below 2^8, a covariance
is at most 1, and 49 products are added, so that float64 represents all sums exactly.
"""

REACH_PX = 30.0
"""The correlation of pixels of natural images falls to 1 / e within this distance."""


@dataclass(frozen=True)
class IntegerBank:
    """The filters of one sensor as an integer convolution, the first of an INT8 network.

    Attributes:
        weight: (O, 4 S^2, k, k) int8, which read the four planes of an image with S^2 channels. All
            channels of one plane are consecutive.
        frac_bits: the right shift in bits that makes int8 results of the sums of products.
        offsets: (O,) the offset of each output channel that is added before rounding, in
            quantisation steps.
    """

    weight: NDArray[np.int8]
    frac_bits: int
    offsets: Array


def coarse_copies(kernels: Kernels) -> int:
    """Return the number of copies of the analytic restoration that are coarser by `WIDE`: 1 or 0.

    The analytic restoration is the one that the filters compute without the network. With "fitted"
    kernels its last copy is coarse, for values at which the others are clipped; with "cut" kernels
    none is.
    """
    return int(kernels == "fitted")


def channels(kernels: Kernels = "fitted") -> list[tuple[int, float]]:
    """Return which filter each output channel of the integer bank computes, and how it is rounded.

    Args:
        kernels: the kind of the bank's kernels. "fitted" makes one copy of the analytic restoration
            coarse, "cut" none.

    Returns:
        For each channel of one pixel: the number of its filter, and the offset that is added before
        rounding, in quantisation steps. Copies of a filter have different offsets.
    """
    coarse = coarse_copies(kernels)
    copies = [COPIES[0], *[COPIES[1]] * FILTERS, COPIES[2] - coarse, coarse]
    outputs = []
    for kernel, count in enumerate(copies):
        outputs += [(kernel, offset) for offset in spread_over_a_step(count)]
    return outputs


def spread_over_a_step(count: int) -> list[float]:
    """Return offsets that spread `count` copies of a result evenly over one quantisation step.

    Each copy adds its offset before it is rounded, so that the mean of the copies is finer than a
    step. Offsets are in steps, and their mean is 0.
    """
    return [(k + 0.5) / count - 0.5 for k in range(count)]


def integer_bank(bank: Bank, scale: int, gain: float, kernels: Kernels = "fitted") -> IntegerBank:
    """Round the filters of a sensor to an integer convolution.

    Args:
        bank: the filters of the sensor.
        scale: S, the side in pixels of the square of the image that is one pixel of the network's
            maps.
        gain: the factor by which the quantisation steps of the results are finer than at a
            reference noise (`Bank.gain`).
        kernels: how the filters got 7 x 7 weights: "fitted" to that size, or "cut" in older
            networks.
    """
    steps = np.concatenate([bank.kernels, bank.kernels[-1:] / WIDE])
    # The kernels multiply shares of full scale, but the planes hold digital numbers.
    steps *= gain * UNIT_STEPS / MAX_DN
    # The image comes in steps of its own.
    steps[0] *= MAX_DN / UNIT_STEPS / IMAGE_STEP_DN
    # A tensor has one scale, which the largest of all coarse weights sets.
    frac_bits = int(np.floor(np.log2(LARGEST / np.abs(STEP_DN * steps).max())))
    exact = steps * 2.0**frac_bits
    residual = np.zeros_like(exact)
    weights = []
    outputs = channels(kernels)
    # Each further copy of a kernel makes up for the rounding errors of those before it.
    for kernel, _ in outputs:
        weight = _on_planes((exact[kernel] + residual[kernel]).ravel(), is_image=kernel == 0)
        weight = weight.reshape(-1, *exact[kernel].shape)
        weights.append(weight)
        # The two coarse planes carry nearly all of a number; the others only the remainder.
        residual[kernel] += exact[kernel] - (weight[0] + weight[1]) / STEP_DN
    by_plane = np.stack(weights).astype(np.float64)
    planes = [in_places(by_plane[:, plane], scale) for plane in range(BANK_SLICES.planes)]
    offsets = [offset for _, offset in outputs]
    return IntegerBank(
        np.concatenate(planes, 1).astype(np.int8), frac_bits, np.repeat(offsets, scale**2)
    )


def _on_planes(values: Array, *, is_image: bool) -> NDArray[np.int64]:
    """Round the weights (49,) of a filter to integer weights (4, 49) of the four planes."""
    if is_image:
        # The image comes in its own steps, and from the coarse planes only.
        coarse = np.rint(STEP_DN * values).astype(np.int64)
        fine = np.zeros_like(coarse)
    else:
        coarse = shaped(STEP_DN * values)
        # The last plane holds half of the remainder, so this grid is twice as fine.
        fine = shaped(PART * values)
    # The sum of `fine` is 0, so the number of odd weights is even. One is rounded up, the next one
    # down: the weights of each plane sum to 0, and flat ground gives 0.
    odd = np.flatnonzero(fine % PART)
    parts = np.zeros_like(fine)
    parts[odd[::2]] = 1
    parts[odd[1::2]] = -1
    whole = (fine - parts) // PART
    # The coarse plane comes twice, so a weight of twice int8's size fits.
    half = coarse // 2
    return np.stack([half, coarse - half, whole, parts])


def shaped(values: Array) -> NDArray[np.int64]:
    """Round the weights of a filter to integers of sum 0, with errors that natural images hardly
    show.

    The squared error of a result is e^T C e, with e the rounding errors and C the covariance of
    natural images. From the nearest integers, made to sum to 0, one is raised and another lowered
    as long as that lowers the error. All sums are exact, so that every processor finds the same
    integers.

    Args:
        values: (49,) the real weights of a 7 x 7 filter.
    """
    exact = _on_grid(values)
    weight = np.rint(exact)
    # The weights that were rounded furthest in the direction of the excess give up one each.
    while (excess := int(weight.sum())) != 0:
        error = (weight - exact) * np.sign(excess)
        weight[np.argsort(-error, kind="stable")[: abs(excess)]] -= np.sign(excess)
    slope = COVARIANCE @ (weight - exact)
    curve = np.diag(COVARIANCE)
    pair = curve[:, None] + curve[None, :] - 2 * COVARIANCE
    while True:
        # By how much e^T C e changes when the row's weight is raised and the column's lowered.
        change = 2 * (slope[:, None] - slope[None, :]) + pair
        np.fill_diagonal(change, 0)
        up, down = np.unravel_index(np.argmin(change), change.shape)
        if change[up, down] >= 0:
            return weight.astype(np.int64)
        weight[up] += 1
        weight[down] -= 1
        slope += COVARIANCE[up] - COVARIANCE[down]


def _on_grid(values: Array) -> Array:
    """Round to so few bits that sums of 49 products are exact in float64, in any order."""
    return np.asarray(np.rint(np.ldexp(values, GRID_BITS)) / 2**GRID_BITS)


_PLACES = np.indices((SIDE_PX, SIDE_PX)).reshape(2, -1).T
_DISTANCE_PX = np.linalg.norm(_PLACES[:, None] - _PLACES[None, :], axis=-1)
COVARIANCE = _on_grid(np.exp(-_DISTANCE_PX / REACH_PX))
"""The covariance of the 49 pixels of a square of natural images."""
