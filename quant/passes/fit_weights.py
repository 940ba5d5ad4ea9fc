"""Round weights so that the convolution's result errs least, not each weight by itself.

The nearest whole number is the best for one weight, not for a sum: errors of neighbouring weights meet nearly the
same pixel and add up. The squared error of the result is e^T C e, with e the rounding errors of a channel's weights
and C the covariance of what they are multiplied with (the criterion of AdaRound, Nagel et al. 2020, and of GPTQ,
Frantar et al. 2023). From the nearest numbers on, weight after weight takes the whole number that lowers it most,
until none does. What the mean is off by then goes into the bias.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from beers_deploy.quant.core import INT8_MAX, INT8_MIN, SHIFTS, IntConv, IntCore, Shifts, quantise_bias
from beers_deploy.quant.ends import ONE_CHANNEL, Ends
from beers_deploy.quant.graph import CORRECTION, PLANES, Conv, Graph, Op, graph_to_onnx, tensors
from beers_deploy.quant.session import crops, halo_of, open_session, planes_of, tensor_values

FLOOR = 1e-2
"""Added to every variance, as a share of their mean. Without it the weights of a channel that hardly changes run to
int8's ends to make up a little of what others err by, and the bias that makes up for its mean is coarse then."""
EVERY_PX = 4
"""Windows are taken so far apart in both directions: neighbours say nearly the same."""


@dataclass
class Moments:
    """Sums over windows x, (I kh kw,) each, that a convolution multiplies its weights with."""

    products: np.ndarray  # (n, n) float64, sum of x x^T
    total: np.ndarray  # (n,) float64, sum of x
    count: int = 0

    @classmethod
    def of_none(cls, size: int) -> "Moments":
        """Of no windows yet."""
        return cls(np.zeros((size, size)), np.zeros(size))

    def add(self, windows: np.ndarray) -> None:
        """Count further windows (K, n) float32."""
        self.products += windows.T @ windows
        self.total += windows.sum(axis=0, dtype=np.float64)
        self.count += len(windows)

    @property
    def mean(self) -> np.ndarray:
        """(n,) mean window."""
        return np.asarray(self.total / self.count)

    @property
    def covariance(self) -> np.ndarray:
        """(n, n) covariance, a share of its mean variance added to the diagonal so that no direction is free."""
        covariance = self.products / self.count - np.outer(self.mean, self.mean)
        floor = FLOOR * np.trace(covariance) / len(covariance)
        return np.asarray(covariance + floor * np.eye(len(covariance)))


def input_moments(graph: Graph, images: Iterable[np.ndarray], ends: Ends = ONE_CHANNEL) -> dict[str, Moments]:
    """The moments of every convolution of a plane-reading graph, by its name, over images (1, C, H, W) in [0, 1].

    The values are those of the float network.
    """
    convs = [op for op in graph if isinstance(op, Conv) and fits(op)]
    found = {op.name: Moments.of_none(op.weight[0].size) for op in convs}
    names, halo_px = tensors(graph), halo_of(graph)
    session = open_session(graph_to_onnx(graph, names, ends.planes * ends.channels))
    for image in images:
        tiles = tensor_values(session, names, image, halo_px, ends)
        for crop, values in zip(crops(image, halo_px), tiles, strict=True):
            read = {PLANES: planes_of(crop, ends), **dict(zip(names, values, strict=True))}
            for op in convs:
                found[op.name].add(_windows(read[op.input], op))
    return found


def fits(op: Conv) -> bool:
    """Whether a convolution's windows are gathered: of one group, and not transposed."""
    return op.groups == 1 and not op.transposed


def _windows(values: np.ndarray, op: Conv) -> np.ndarray:
    """(K, I kh kw) of the windows within (1, I, H, W), some pixels apart."""
    (rows, columns), (tall, broad) = op.window.strides, op.window.dilations
    kernel = (op.weight.shape[2] - 1) * tall + 1, (op.weight.shape[3] - 1) * broad + 1
    every = -(-EVERY_PX // rows) * rows, -(-EVERY_PX // columns) * columns
    if min(n - k for n, k in zip(values.shape[2:], kernel, strict=True)) < 0:
        return np.empty((0, op.weight[0].size), np.float32)
    # In step with the windows that are computed, which begin in the padding.
    first = -op.window.pads[0] % rows, -op.window.pads[1] % columns
    windows = sliding_window_view(values[0], kernel, axis=(1, 2))
    windows = windows[:, first[0] :: every[0], first[1] :: every[1], ::tall, ::broad]
    return np.ascontiguousarray(windows.transpose(1, 2, 0, 3, 4)).reshape(-1, op.weight[0].size)


SWEEPS = 20
"""At most; a sweep that changes nothing ends it, after some five."""


def fit_weights(graph: Graph, core: IntCore, moments: Mapping[str, Moments], shifts: Shifts = SHIFTS) -> IntCore:
    """The core with weights and biases rounded for what each convolution reads; scales stay.

    Args:
        graph: the float operations that the core was built from.
        core: with weights rounded to nearest.
        moments: of each convolution's input, by its name.
        shifts: the windows of the target.
    """
    pairs = zip(graph, core.ops, strict=True)
    ops, ends = list[IntConv | Op](), core.ends
    for op, whole in pairs:
        if isinstance(op, Conv) and isinstance(whole, IntConv) and _enough(moments.get(op.name)):
            fitted, shifted = _fit(op, whole, core.frac_bits[whole.input], moments[op.name], shifts)
            if op.output == CORRECTION and ends.offsets:  # the biases left over are others now
                ends = ends.moved(whole.float_bias - shifted - fitted.float_bias)
            ops.append(fitted)
        else:
            ops.append(whole)
    return replace(core, ops=tuple(ops), ends=ends)


def _enough(moments: Moments | None) -> bool:
    """Whether there are more windows than weights: fewer say nothing of how errors add up."""
    return moments is not None and moments.count > len(moments.total)


def _fit(
    op: Conv, whole: IntConv, input_frac_bits: int, moments: Moments, shifts: Shifts
) -> tuple[IntConv, np.ndarray]:
    """The fitted convolution, and by how much its weights raise the mean results, (O,): what its bias takes off."""
    weight, shifted = fit(op.weight, whole.weight, np.array([2.0**-whole.weight_frac_bits]), moments)
    bias, bias_frac_bits = quantise_bias(op.bias - shifted, whole.weight_frac_bits + input_frac_bits, shifts)
    return replace(whole, weight=weight, bias=bias, bias_frac_bits=bias_frac_bits), shifted


def fit(
    weight: np.ndarray, nearest: np.ndarray, scales: np.ndarray, moments: Moments
) -> tuple[np.ndarray, np.ndarray]:
    """Whole weights (O, I, kh, kw) int8, and by how much they raise the mean result of each channel (O,).

    Args:
        weight: (O, I, kh, kw), what they stand for.
        nearest: each rounded by itself.
        scales: (1,) or (O,), the value of 1.
        moments: of what the convolution reads.
    """
    wanted = weight.reshape(len(weight), -1) / scales[:, None].astype(np.float64)
    fitted = descend(wanted, nearest.reshape(wanted.shape), moments.covariance)
    return fitted.astype(np.int8).reshape(weight.shape), (fitted - wanted) @ moments.mean * scales


def descend(wanted: np.ndarray, nearest: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Whole numbers (O, n) in [-128, 127] near the wanted ones, of less e^T C e than the nearest.

    Coordinate descent: along one weight the least error lies at q_i - (C e)_i / C_ii, rounded. A weight that meets
    nothing but one value stays: the bias makes up for it.
    """
    whole = nearest.astype(np.float64)
    gradient = (whole - wanted) @ covariance
    variance = np.diag(covariance)
    for _ in range(SWEEPS):
        moved = False
        for i in np.argsort(-variance)[: np.count_nonzero(variance)]:
            target = whole[:, i] - gradient[:, i] / variance[i]
            step = np.clip(np.rint(target), INT8_MIN, INT8_MAX) - whole[:, i]
            if step.any():
                whole[:, i] += step
                gradient += step[:, None] * covariance[i]
                moved = True
        if not moved:
            break
    return whole
