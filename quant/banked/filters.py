"""The bank of a sensor in whole numbers: the first convolution of an INT8 network, written from the
sensor alone.

The image enters in four planes: steps of 16 digital numbers about the middle, twice, what they
leave, and half of that for finer weights. The first two share a filter's weights, which may be
twice as large so: half the rounding. Weights are rounded so that they sum to exactly 0, for flat
ground must leave nothing, and so that their errors lie where natural images hold little.

What the filters give is int8 in steps of 1/24 of a unit of a sensor whose noise is
`model.bank.SIGMA`. A sensor's own steps are the same share of full scale, within limits
(`Bank.gain`): the strongest edges are a share of full scale, not of noise, so that noisy sensors
can have finer steps in their units. Each result comes several times, rounded at other places of a
step: together the copies hold what one cannot. The image itself comes in steps of 32 / gain, about
the middle.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beers_deploy.model.bank import FILTERS, SIDE_PX, UNIT_STEPS, WIDE, Bank, in_places
from beers_deploy.model.variants import Kernels
from beers_deploy.profiles.instrument import MAX_DN

STEP_DN = 16
MIDDLE_DN = 2048
PART = 2
"""Of the planes: the coarse ones' step and their zero, and by what the last
divides the remainder.
"""

PLANES_PER_CHANNEL = 4
PLANE_ENDS = (-128, -128, -8, -4), (127, 127, 15, 8)
"""The smallest and the largest number of each: at full scale the coarse ones are at their end, and
more remains.
"""

IMAGE_STEP_DN = 32

BITS = 7
"""Fractional bits that a result is said to have: int8 then stands for -1 to 1, 5.3 units or half of
full scale.
"""

ANALYTIC_COPIES = 4
"""Of the analytic restoration, in a network's result; behind fitted kernels the last one is coarse
by `WIDE`.
"""

LARGEST = 2 * 124
"""Of two coarse weights before they are rounded: what sums and copies make up
for still fits int8.
"""

COPIES = (1, 2, 7)
"""Of the image, of each plane, and of the analytic restoration: 16 channels for each pixel of a
place. Behind fitted kernels the last one of the analytic restoration is coarse by `WIDE`, for what
the others clip.
"""

GRID_BITS = 16
"""Fractional bits of what weights are fitted with: weights below 2^8, a covariance of at most 1, 49
products.
"""

REACH_PX = 30.0
"""Neighbouring pixels of natural images are alike: their correlation falls to 1 / e within so many
pixels.
"""


@dataclass(frozen=True)
class WholeBank:
    """The first convolution, (O, 4 S^2, k, k) int8 with so many fractional bits, and what each
    channel adds.

    Attributes:
        weight: of the planes of an image, one kind behind the other.
        frac_bits: a sum of products is shifted by so many bits to become int8.
        offsets: (O,) what each channel adds before it is rounded, in steps.
    """

    weight: NDArray[np.int8]
    frac_bits: int
    offsets: NDArray[np.float64]


def split_planes(image: np.ndarray) -> np.ndarray:
    """(N, C, H, W) float32 in [0, 1] to the planes (N, 4 C, H, W) int8."""
    dn = np.clip(np.rint(image * np.float32(MAX_DN)), 0, MAX_DN) - MIDDLE_DN
    # Full scale is 2047 above the middle, 128 steps: int8 ends one before, and more remains.
    coarse = np.minimum(np.rint(dn / STEP_DN), 127)
    remainder = dn - STEP_DN * coarse
    planes = np.concatenate([coarse, coarse, remainder, np.rint(remainder / PART)], axis=1)
    return planes.astype(np.int8)


def channels(kernels: Kernels = "fitted") -> list[tuple[int, float]]:
    """Of each output, before pixels become channels: which of the bank's kernels it is, and its
    offset in steps.
    """
    coarse = int(kernels == "fitted")
    copies = [COPIES[0], *[COPIES[1]] * FILTERS, COPIES[2] - coarse, coarse]
    outputs = list[tuple[int, float]]()
    for kernel, count in enumerate(copies):
        outputs += [(kernel, offset) for offset in spread_over_a_step(count)]
    return outputs


def spread_over_a_step(count: int) -> list[float]:
    """What so many copies add before they are rounded, in steps; the mean is 0."""
    return [(k + 0.5) / count - 0.5 for k in range(count)]


def whole_bank(bank: Bank, scale: int, gain: float, kernels: Kernels = "fitted") -> WholeBank:
    """The whole numbers of a bank, for a network of that scale, in steps finer by `gain`."""
    steps = np.concatenate([bank.kernels, bank.kernels[-1:] / WIDE])
    # The kernels are for values over full scale; the planes hold digital numbers.
    steps *= gain * UNIT_STEPS / MAX_DN
    # The image comes in steps of its own.
    steps[0] *= MAX_DN / UNIT_STEPS / IMAGE_STEP_DN
    # A tensor has one scale, which the largest of all coarse weights sets.
    frac_bits = int(np.floor(np.log2(LARGEST / np.abs(STEP_DN * steps).max())))
    sources, offsets = zip(*channels(kernels), strict=True)
    integers = _copies(steps * 2.0**frac_bits, sources)
    planes = [
        in_places(integers[:, plane].astype(np.float64), scale)
        for plane in range(PLANES_PER_CHANNEL)
    ]
    return WholeBank(
        np.concatenate(planes, 1).astype(np.int8), frac_bits, np.repeat(offsets, scale**2)
    )


def _copies(exact: NDArray[np.float64], kernels: Sequence[int]) -> NDArray[np.int64]:
    """Weights (O, 4, 7, 7): each further copy of a kernel makes up for what rounding has left of
    those before it.
    """
    residual = np.zeros_like(exact)
    copies = list[NDArray[np.int64]]()
    for kernel in kernels:
        weight = _in_four(exact[kernel] + residual[kernel]) if kernel else _of_image(exact[0])
        copies.append(weight)
        residual[kernel] += exact[kernel] - _response(weight)
    return np.stack(copies)


def _response(weight: NDArray[np.int64]) -> NDArray[np.float64]:
    """What weights (4, 7, 7) of the planes multiply a digital number with: (7, 7)."""
    # The two coarse planes carry nearly all of a number; the others only the remainder.
    return np.asarray((weight[0] + weight[1]) / STEP_DN)


def _of_image(kernel: NDArray[np.float64]) -> NDArray[np.int64]:
    """The image in its own steps, from the coarse planes alone: (4, 7, 7)."""
    none = np.zeros(kernel.shape, np.int64)
    coarse = np.rint(STEP_DN * kernel).astype(np.int64)
    return np.stack([*_shared(coarse), none, none])


def _shared(weight: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Two halves of each."""
    # The coarse plane comes twice, so a weight of twice int8's size fits.
    return weight // 2, weight - weight // 2


def _in_four(kernel: NDArray[np.float64]) -> NDArray[np.int64]:
    """Weights (4, 7, 7) of the four planes for a kernel (7, 7) of sum 0 that multiplies digital
    numbers.
    """
    coarse = shaped(STEP_DN * kernel.ravel())
    # The last plane holds half of the remainder, so this grid is twice as fine.
    fine = shaped(PART * kernel.ravel())
    # Their sum is 0, so the number of odd weights is even.
    odd = np.flatnonzero(fine % PART)
    parts = np.zeros_like(fine)
    # One up, one down: the weights of each plane sum to 0, and flat ground leaves nothing.
    parts[odd[::2]] = 1
    parts[odd[1::2]] = -1
    weight = np.stack([*_shared(coarse), (fine - parts) // PART, parts])
    return weight.reshape(PLANES_PER_CHANNEL, *kernel.shape)


def shaped(wanted: NDArray[np.float64]) -> NDArray[np.int64]:
    """Whole numbers (49,) of sum 0 near the wanted ones, whose errors natural images hardly show.

    From the nearest with the largest remainders given up, one is raised and another lowered while
    that lowers e^T C e, C the covariance of natural images. All sums are exact, so that every
    processor finds the same numbers.
    """
    exact = _on_grid(wanted)
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
            return np.asarray(weight.astype(np.int64))
        weight[up] += 1
        weight[down] -= 1
        slope += COVARIANCE[up] - COVARIANCE[down]


def _covariance() -> NDArray[np.float64]:
    places = np.indices((SIDE_PX, SIDE_PX)).reshape(2, -1).T
    distance = np.linalg.norm(places[:, None] - places[None, :], axis=-1)
    return _on_grid(np.exp(-distance / REACH_PX))


def _on_grid(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rounded to so few bits that no sum of products of 49 is rounded again, in whatever order it
    is taken.
    """
    return np.asarray(np.rint(np.ldexp(values, GRID_BITS)) / 2**GRID_BITS)


COVARIANCE = _covariance()
