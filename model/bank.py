"""Compute the filters of a network's first layer in closed form, from the blur and noise of a
sensor.

The sensor has the transfer function H(f) and the noise sigma. Sigma is the standard deviation over
full scale at a quarter of full scale, rounding included. The reference has T(f), and r = |f| /
f_Nyquist. Four restorations W_k, each more cautious than the one before, and the image itself (W_4)
are subtracted from each other and fitted to 7 x 7:

    W_k = T conj(H) / (|H|^2 + eps_k r^2),   eps_k = 1.32 sigma 4^(k-1),   k = 0..3,   W_4 = 1
    D_k = W_k - W_(k+1), of sum 0
    n_k = ||D_k||                    the noise that D_k makes of white noise of 1
    u_k = D_k x / (20 sigma n_k)     four planes in units of the sensor's own noise, 1 on edges
    y_0 = x + (D_1 + D_2 + D_3) x            the analytic restoration W_1 x
    g   = 20 sigma ||D_1 + D_2 + D_3||       the unit of what a network adds to it

A network that reads x and u and returns `y_0 + g * body` is the same for every sensor. (Wiener
filters in front of a network: Dong, Roth and Schiele, NeurIPS 2020.) This module uses NumPy only,
so that a restoration starts without loading torch.

Networks trained before the 7 x 7 kernels were fitted use filters that are cut to that size. They
keep them until they are retrained.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beers_deploy.model.family import RANGES, noise_over_full_scale
from beers_deploy.model.simulator.mtf import frequency_grid, sensor_mtf
from beers_deploy.model.variants import Kernels
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import NYQUIST, Array
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import REFERENCE

FILTERS = 4
SIDE_PX = 7
"""Side of a kernel. 7 x 7 contains 98.6 to 99.95 % of a filter's energy, and is the largest square
that the window of a DPU accepts.
"""

IDENTITY = np.pad([[1.0]], SIDE_PX // 2)
"""The kernel that leaves an image as it is."""

GRID = 64
"""The number of frequencies along an axis. A finer grid changes no tap by more than 3e-4 of the
largest tap.
"""

EPSILON_PER_SIGMA = 1.32
STEP = 4.0
"""Regularisation at Nyquist of W_1, over sigma, and from each filter to the next."""

UNIT = 20.0
"""The number of standard deviations of noise that correspond to 1 in a plane."""

UNIT_STEPS = 24
"""The number of int8 steps per unit. 16 would represent every value of the training data, but its
coarser steps cost more accuracy than the clipping with 24.
"""

LARGEST = 127 / UNIT_STEPS
"""Planes are clipped to this number of units. Few edges exceed it. Patterns that no sensor
produces, such as checkerboards, must not.
"""

SIGMA = 0.0016
"""Noise over full scale of sensors with a gain of 1. This value had the smallest loss on unseen
photographs.
"""

GAINS = 0.5, 2.0
"""The smallest and the largest gain. With a larger one the image itself would not fit int8."""

WIDE = 4
"""The clipping range of the analytic restoration behind fitted kernels, relative to that of the
planes. The correction of an image may exceed a fifth of full scale, for example at a point of light
or at the edge of a saturated area.
"""


@dataclass(frozen=True)
class Bank:
    """The four filters in front of a network, computed from the MTF and the noise of one sensor.

    Attributes:
        details: the kernels D_k of the filters, (4, 7, 7) float64.
        sigma: standard deviation of the noise at a quarter of full scale, as a share of full scale.
    """

    details: Array
    sigma: float

    @cached_property
    def units(self) -> Array:
        """The share of full scale that is 1 in plane k, 20 sigma n_k, shape (4,)."""
        return np.asarray(UNIT * self.sigma * np.sqrt(np.square(self.details).sum((1, 2))))

    @property
    def gain(self) -> float:
        """The factor by which quantisation steps, in units, are finer than at the noise SIGMA.

        A step of a plane is 1 / (24 gain) of a unit, and a step of the image is 32 / gain digital
        numbers of 12 bits. The gain is sigma / SIGMA within GAINS, rounded to eighths, so that the
        single weight of the image is an integer: no duplicated channel corrects its rounding.
        """
        return float(np.clip(np.rint(8 * self.sigma / SIGMA) / 8, *GAINS))

    def reach(self, kernels: Kernels) -> tuple[float, float]:
        """Return the limits in units to which the planes and the analytic restoration are clipped.

        They are the range of int8. Networks with cut kernels were trained as if every sensor had a
        gain of 1.
        """
        if kernels == "cut":
            return LARGEST, LARGEST
        return LARGEST / self.gain, WIDE * LARGEST / self.gain

    @property
    def planes(self) -> Array:
        """The kernels (4, 7, 7) that compute the planes u_k from shares of full scale."""
        return self.details / self.units[:, None, None]

    @property
    def analytic(self) -> Array:
        """D_1 + D_2 + D_3, shape (7, 7): the kernel that the analytic restoration adds to the
        image.
        """
        return np.asarray(self.details[1:].sum(0))

    @cached_property
    def filters(self) -> Array:
        """The kernels (5, 7, 7) of the planes u_k and of the analytic part (W_1 - 1) x / g."""
        return np.concatenate([self.planes, self.analytic[None] / self.unit])

    @property
    def kernels(self) -> Array:
        """All kernels that a network applies to the image: the identity and `filters`, shape (6, 7,
        7).
        """
        return np.concatenate([IDENTITY[None], self.filters])

    @property
    def unit(self) -> float:
        """The share g of full scale that corresponds to 1 in the network's correction."""
        return UNIT * self.sigma * float(np.linalg.norm(self.analytic))


def network_bank(sensor: Instrument, kernels: Kernels = "fitted") -> Bank:
    """Build the filter bank of a sensor.

    Noise outside the training range is clamped to the nearest end of the range.

    Args:
        sensor: the instrument that acquired the images.
        kernels: "fitted", or "cut" for networks trained before kernels were fitted.
    """
    sigma = float(np.clip(noise_over_full_scale(sensor), *RANGES["sigma_bright"]))
    return _bank(sensor, sigma, kernels)


@lru_cache(maxsize=4096)
def bank_of_vector(vector: tuple[float, ...], kernels: Kernels = "fitted") -> Bank:
    """Build the filter bank of the sensor described by the sensor vector, shape (4,)."""
    ends = zip(vector, RANGES.values(), strict=True)
    across, along, _, sigma = (
        low * (high / low) ** ((entry + 1) / 2) for entry, (low, high) in ends
    )
    axes = replace(_reference(), mtf_nyquist=across, mtf_nyquist_along=along, effects={})
    return _bank(axes, sigma, kernels)


@lru_cache
def _reference() -> Instrument:
    return Sensor.load(REFERENCE).nominal()


def _bank(sensor: Instrument, sigma: float, kernels: Kernels) -> Bank:
    fx, fy = frequency_grid(GRID)
    blur, target = (sensor_mtf(fx, fy, side) for side in (sensor, _reference()))
    r_squared = (fx**2 + fy**2) / NYQUIST**2
    epsilons = [EPSILON_PER_SIGMA * sigma * STEP ** (k - 1) for k in range(FILTERS)]
    gains = [restoring_gain(blur, target, r_squared, epsilon) for epsilon in epsilons]
    if kernels == "cut":
        # Networks trained before kernels were fitted read filters that are cut to 7 x 7.
        falling = np.stack([*gains, np.ones_like(blur)])
        filters = np.fft.ifft2(falling[:-1] - falling[1:]).real
        details = [cut_filter(kernel, SIDE_PX // 2, total=0) for kernel in filters]
        return Bank(np.stack(details), sigma)
    wiener_kernels = [
        fitted_kernel(gain, np.abs(blur) ** 2 + epsilon * r_squared, r_squared)
        for gain, epsilon in zip(gains, epsilons, strict=True)
    ]
    falling = np.stack([*wiener_kernels, IDENTITY])
    return Bank(falling[:-1] - falling[1:], sigma)


def fitted_kernel(gain: NDArray[np.inexact], power: Array, r_squared: Array) -> Array:
    """Compute the kernel (7, 7) of sum 1 with the least restoration error.

    It approximates a filter of any size that has the frequency response `gain`. For scenes whose
    power falls as 1 / r^2, W_k minimises the error under noise. A kernel K has an additional error,
    the sum of (|H|^2 + eps_k r^2) / r^2 |K - W_k|^2. The solution of 49 linear equations minimises
    it. W_k cut to 7 x 7 instead loses up to a tenth of the contrast at low frequencies, by a
    different amount for each MTF curve.

    Args:
        gain: the frequency response W_k at the frequencies of a grid, (GRID, GRID).
        power: |H|^2 + eps_k r^2 at these frequencies, (GRID, GRID).
        r_squared: the squared frequency r^2 at them, (GRID, GRID).
    """
    weights = np.zeros_like(power)
    # At frequency 0 the weight is infinite. The equation of the sum below replaces it.
    weights[r_squared > 0] = power[r_squared > 0] / r_squared[r_squared > 0]
    correlation = np.fft.ifft2(weights).real
    restoration = np.fft.ifft2(weights * gain).real
    offsets = np.arange(SIDE_PX) - SIDE_PX // 2
    rows, columns = (grid.ravel() for grid in np.meshgrid(offsets, offsets, indexing="ij"))
    # The sum of 1 is one more equation, with a multiplier as one more unknown.
    equations = np.ones((len(rows) + 1, len(rows) + 1))
    equations[:-1, :-1] = correlation[rows[:, None] - rows, columns[:, None] - columns]
    equations[-1, -1] = 0
    solution = np.linalg.solve(equations, np.append(restoration[rows, columns], 1.0))
    return solution[:-1].reshape(SIDE_PX, SIDE_PX)


def in_places(kernels: Array, scale: int) -> Array:
    """Rewrite kernels (K, 7, 7) as a convolution on an image after pixel unshuffle by `scale`.

    S = `scale`, and any odd side is possible. Row i of a place reads row i + d of the same plane,
    with d from -3 to 3. That row is row (i + d) mod S of the place that is floor((i + d) / S)
    below. The same holds for columns.

    Returns:
        Weights (K S^2, S^2, k, k), where k is 7 at scale 1 and 5 at scale 2. The channels have the
        order of a pixel unshuffle of the planes and of the image.
    """
    side_px = kernels.shape[-1]
    reach = -(-(side_px // 2) // scale)
    middle = side_px // 2
    weights = np.zeros((len(kernels), scale, scale, scale, scale, 2 * reach + 1, 2 * reach + 1))
    for row, column, down, right in product(
        range(scale), range(scale), range(side_px), range(side_px)
    ):
        place_y, y = divmod(row + down - middle, scale)
        place_x, x = divmod(column + right - middle, scale)
        weights[:, row, column, y, x, place_y + reach, place_x + reach] = kernels[:, down, right]
    return weights.reshape(len(kernels) * scale**2, scale**2, 2 * reach + 1, 2 * reach + 1)


def restoring_gain(
    blur: NDArray[np.inexact], target: ArrayLike, r_squared: ArrayLike, epsilon: float
) -> NDArray[np.inexact]:
    """Compute T conj(H) / (|H|^2 + epsilon r^2) for the blur H and the target T, arrays of one
    shape.

    The weight r^2 keeps the gain at frequency 0 at exactly 1. A constant epsilon would darken the
    image.
    """
    return np.asarray(
        target * np.conj(blur) / (np.abs(blur) ** 2 + epsilon * np.asarray(r_squared))
    )


def cut_filter(whole: Array, radius_px: int, total: float) -> Array:
    """Crop a filter to (2 R + 1, 2 R + 1), and correct its sum.

    A smooth window is added so that the sum becomes `total`. It changes only frequencies near 0,
    while dividing by the sum would change all of them.

    Args:
        whole: (H, W), the filter with its centre in pixel (0, 0) and periodic borders, as the
            inverse FFT returns it.
        radius_px: R.
        total: the sum of the result.

    Returns:
        The filter (2 R + 1, 2 R + 1), with its centre in the middle.
    """
    side_px = 2 * radius_px + 1
    kernel = np.roll(whole, (radius_px, radius_px), (0, 1))[:side_px, :side_px]
    window = np.hanning(side_px + 2)[1:-1]
    hill = np.outer(window, window)
    return np.asarray(kernel + (total - kernel.sum()) * hill / hill.sum())
