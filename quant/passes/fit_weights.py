"""Round weights so that the convolution's result errs least, not each weight by itself.

The nearest whole number is the best for one weight, not for a sum: errors of neighbouring weights meet nearly the
same pixel and add up. The squared error of the result is e^T C e, with e the rounding errors of a channel's weights
and C the covariance of what they are multiplied with (the criterion of AdaRound, Nagel et al. 2020, and of GPTQ,
Frantar et al. 2023). From the nearest numbers on, weight after weight takes the whole number that lowers it most,
until none does. What the mean is off by then goes into the bias.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from quant.core import IntConv, IntCore, quantise_bias
from quant.graph import Conv, Graph
from quant.moments import Moments
from quant.positions import INT8_MAX, INT8_MIN, SHIFTS, Shifts

SWEEPS = 20
"""At most; a sweep that changes nothing ends it, after some five."""


def fit_weights(graph: Graph, core: IntCore, moments: Mapping[str, Moments], shifts: Shifts = SHIFTS) -> IntCore:
    """The core with weights and biases rounded for what each convolution reads; positions stay.

    Args:
        graph: the float operations that the core was built from.
        core: with weights rounded to nearest.
        moments: of each convolution's input, by its name.
        shifts: the windows of the target.
    """
    pairs = zip(graph, core.ops, strict=True)
    ops = [
        _fit(op, whole, core.positions[whole.input], moments[op.name], shifts)
        if isinstance(op, Conv) and isinstance(whole, IntConv)
        else whole
        for op, whole in pairs
    ]
    return replace(core, ops=tuple(ops))


def _fit(op: Conv, whole: IntConv, input_position: int, moments: Moments, shifts: Shifts) -> IntConv:
    weight, shifted = fit(op.weight, whole.weight, np.array([2.0**-whole.weight_position]), moments)
    bias, bias_position = quantise_bias(op.bias - shifted, whole.weight_position + input_position, shifts)
    return replace(whole, weight=weight, bias=bias, bias_position=bias_position)


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
