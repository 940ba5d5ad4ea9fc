"""Round weights so that the convolution's result errs least, not each weight by itself.

The nearest whole number is the best for one weight, not for a sum: errors of neighbouring weights
meet nearly the same pixel and add up. The squared error of the result is e^T C e, with e the
rounding errors of a channel's weights and C the covariance of what they are multiplied with (the
criterion of AdaRound, Nagel et al. 2020, and of GPTQ, Frantar et al. 2023). From the nearest
numbers on, weight after weight takes the whole number that lowers it most, until none does. What
the mean is off by then goes into the bias.

Convolutions are rounded one after the other on what they read in INT8, so the bias of each also
makes up for what those before it are off by in the mean.
"""

from dataclasses import dataclass, replace
from itertools import chain, product
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from beers_deploy.quant.core import (
    INT8_MAX,
    INT8_MIN,
    SHIFTS,
    IntConv,
    IntCore,
    Shifts,
    dequantised,
    nearest_bias,
    quantise_bias,
    rounded_to,
)
from beers_deploy.quant.graph import CORRECTION, PLANES, Conv, Graph, Op
from beers_deploy.quant.graph.writer import operation_to_onnx
from beers_deploy.quant.samples import Remade
from beers_deploy.quant.session import crops, halo_of, open_session, planes_of

FLOOR = 1e-2
"""Added to every variance, as a share of their mean.

Without it the weights of a channel that hardly changes run to int8's ends to make up a little of
what others err by, and the bias that makes up for its mean is coarse then.
"""
EVERY_PX = 4
"""Windows are taken so far apart in both directions: neighbours say nearly the same."""
SEEN_PX = 16 * 128**2
"""Pixels of the images that are looked at, all of whose tensors are kept from operation to
operation.
"""


@dataclass
class Moments:
    """Sums over windows x, (G, n) each, that the groups of a convolution read in INT8, and over
    what they lost.
    """

    products: np.ndarray  # (G, n, n) float64, sum of x x^T
    total: np.ndarray  # (G, n), sum of x
    lost: np.ndarray  # (G, n), sum of what x is in float less x
    count: int = 0

    @classmethod
    def of_none(cls, groups: int, size: int) -> "Moments":
        """Of no windows yet."""
        return cls(
            np.zeros((groups, size, size)), np.zeros((groups, size)), np.zeros((groups, size))
        )

    def add(self, windows: np.ndarray, exact: np.ndarray) -> None:
        """Count further windows (K, G, n) float32, and what they are in float."""
        self.products += windows.transpose(1, 2, 0) @ windows.transpose(1, 0, 2)
        self.total += windows.sum(axis=0, dtype=np.float64)
        self.lost += np.subtract(exact, windows, dtype=np.float64).sum(axis=0)
        self.count += len(windows)

    @property
    def mean(self) -> np.ndarray:
        """(G, n) mean window."""
        return np.asarray(self.total / self.count)

    @property
    def covariance(self) -> np.ndarray:
        """(G, n, n) covariance, a share of its mean variance added to the diagonal so that no
        direction is free.
        """
        # The mean is taken off: the bias makes up for what weights do to it.
        covariance = self.products / self.count - self.mean[:, :, None] * self.mean[:, None]
        floor = FLOOR * np.trace(covariance, axis1=1, axis2=2).mean() / covariance.shape[-1]
        return np.asarray(covariance + floor * np.eye(covariance.shape[-1]))


def _windows(values: np.ndarray, op: Conv) -> np.ndarray:
    """(K, G, n) of the windows within (1, I, H, W), some pixels apart."""
    rows, columns = op.window.strides
    tall, broad = op.window.dilations
    kernel = (op.weight.shape[2] - 1) * tall + 1, (op.weight.shape[3] - 1) * broad + 1
    # The nearest multiples of the strides, for other windows are never computed.
    every = -(-EVERY_PX // rows) * rows, -(-EVERY_PX // columns) * columns
    if min(n - k for n, k in zip(values.shape[2:], kernel, strict=True)) < 0:
        return np.empty((0, op.groups, op.weight[0].size), np.float32)
    # In step with the windows that are computed, which begin in the padding.
    first = -op.window.pads[0] % rows, -op.window.pads[1] % columns
    windows = sliding_window_view(values[0], kernel, axis=(1, 2))
    windows = windows[:, first[0] :: every[0], first[1] :: every[1], ::tall, ::broad]
    ordered = np.ascontiguousarray(windows.transpose(1, 2, 0, 3, 4))
    return ordered.reshape(-1, op.groups, op.weight[0].size)


class Crop(NamedTuple):
    """What one crop's tensors (1, C, H, W) are in float and in INT8, as far as they are computed
    and still read.
    """

    exact: dict[str, np.ndarray]
    whole: dict[str, np.ndarray]


SWEEPS = 20
"""At most; a sweep that changes nothing ends it, after some five."""


def fit_weights(
    graph: Graph, core: IntCore, images: Remade[np.ndarray], shifts: Shifts = SHIFTS
) -> IntCore:
    """The core with weights and biases rounded for what each convolution reads; scales stay.

    Args:
        graph: the float operations that the core was built from.
        core: with weights rounded to nearest.
        images: (1, C, H, W) in [0, 1], of which some are looked at.
        shifts: the windows of the target.
    """
    ops = list[IntConv | Op]()
    ends = core.ends
    samples = _samples(graph, core, images)
    last_reader: dict[str, str] = {}
    for op in graph:
        last_reader.update(dict.fromkeys(op.inputs, op.name))
    for op, nearest in zip(graph, core.ops, strict=True):
        fitted = nearest
        if isinstance(op, Conv) and isinstance(nearest, IntConv):
            bias = nearest_bias(op, nearest.weight, nearest.weight_frac_bits, graph)
            raised = op.stored_bias - bias
            fitted, shifted = _fit(
                op, nearest, core.frac_bits[op.input], _moments(op, samples), shifts, raised
            )
            if op.output == CORRECTION and ends.offsets:
                # The host adds what rounding the biases left, which is another amount now.
                ends = ends.moved(nearest.float_bias + raised - shifted - fitted.float_bias)
        ops.append(fitted)
        # The next convolution is fitted on what this one gives in INT8, errors included.
        _compute(op, fitted, core.frac_bits[op.output], samples)
        # Only tensors that are still read are kept, or memory would grow with the depth.
        spent = {name for name in op.inputs if last_reader[name] == op.name}
        for crop, name in product(samples, spent):
            del crop.exact[name], crop.whole[name]
    return replace(core, ops=tuple(ops), ends=ends)


def _samples(graph: Graph, core: IntCore, images: Remade[np.ndarray]) -> list[Crop]:
    """Crops from all over the images, of SEEN_PX together, and their planes."""
    halo_px = None if halo_of(graph) is None else 0
    first = crops(images[0], halo_px)
    count = max(SEEN_PX // first[0][0, 0].size, 1)
    numbers = np.unique(np.linspace(0, len(images) - 1, count).astype(int))
    tiles = list(chain.from_iterable(crops(images[k], halo_px) for k in numbers))
    planes = [planes_of(tile, core.ends) for tile in tiles[:: -(-len(tiles) // count)]]
    return [Crop({PLANES: plane}, {PLANES: plane}) for plane in planes]


def _moments(op: Conv, samples: list[Crop]) -> Moments:
    moments = Moments.of_none(op.groups, op.weight[0].size)
    for crop in [] if op.transposed else samples:
        moments.add(_windows(crop.whole[op.input], op), _windows(crop.exact[op.input], op))
    return moments


def _compute(op: Op, fitted: IntConv | Op, frac_bits: int, samples: list[Crop]) -> None:
    """One more tensor of each crop, in float and rounded."""
    in_int8 = op
    if isinstance(op, Conv) and isinstance(fitted, IntConv):
        in_int8 = dequantised(op, fitted)
    sessions = [open_session(operation_to_onnx(version)) for version in (op, in_int8)]
    for crop in samples:
        for session, tensors in zip(sessions, crop, strict=True):
            inputs = {name: tensors[name] for name in dict.fromkeys(op.inputs)}
            (tensors[op.output],) = session.run(None, inputs)
        crop.whole[op.output] = rounded_to(crop.whole[op.output], frac_bits)


def _fit(
    op: Conv,
    nearest: IntConv,
    input_frac_bits: int,
    moments: Moments,
    shifts: Shifts,
    raised: np.ndarray,
) -> tuple[IntConv, np.ndarray]:
    """The fitted convolution, and by how much its weights raise the mean results, (O,): what its
    bias takes off.

    Fewer windows than weights say nothing of how errors add up.
    """
    # With fewer windows than weights the covariance has no full rank.
    if moments.count <= op.weight[0].size:
        return nearest, raised
    weight, shifted = fit(op.weight, 2.0**-nearest.weight_frac_bits, moments)
    product_frac_bits = nearest.weight_frac_bits + input_frac_bits
    bias, bias_frac_bits = quantise_bias(op.stored_bias - shifted, product_frac_bits, shifts)
    return replace(nearest, weight=weight, bias=bias, bias_frac_bits=bias_frac_bits), shifted


def fit(weight: np.ndarray, unit: float, moments: Moments) -> tuple[np.ndarray, np.ndarray]:
    """Whole weights (O, I, kh, kw) int8, and by how much they raise the mean result of each channel
    (O,).

    Args:
        weight: (O, I, kh, kw), what they stand for.
        unit: what 1 is worth.
        moments: of what the convolution reads.
    """
    groups, size = moments.mean.shape
    exact = weight.reshape(groups, -1, size).astype(np.float64)
    fitted = np.stack(
        [descend(*group) for group in zip(exact / unit, moments.covariance, strict=True)]
    )
    # The bias is to give the float mean of float inputs, so it also takes off earlier errors.
    exact_mean = (moments.total + moments.lost) / moments.count
    raised = (fitted * unit) @ moments.mean[:, :, None] - exact @ exact_mean[:, :, None]
    return fitted.astype(np.int8).reshape(weight.shape), np.asarray(raised).ravel()


def descend(wanted: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Whole numbers (O, n) in [-128, 127] near the wanted ones, of less e^T C e than the nearest.

    Coordinate descent: along one weight the least error lies at q_i - (C e)_i / C_ii, rounded. A
    weight that meets nothing but one value stays: the bias makes up for it.
    """
    weights: np.ndarray = np.clip(np.rint(wanted), INT8_MIN, INT8_MAX)
    # C e, half the gradient of e^T C e, is kept up to date: a step costs one row of C.
    gradient = (weights - wanted) @ covariance
    variance = np.diag(covariance)
    for _ in range(SWEEPS):
        changes = False
        # A weight without variance would divide by zero.
        for i in np.argsort(-variance)[: np.count_nonzero(variance)]:
            target = weights[:, i] - gradient[:, i] / variance[i]
            # The error is a parabola along one weight, so the nearest integer to its least is best.
            step = np.clip(np.rint(target), INT8_MIN, INT8_MAX) - weights[:, i]
            if step.any():
                weights[:, i] += step
                gradient += step[:, None] * covariance[i]
                changes = True
        if not changes:
            break
    return weights
