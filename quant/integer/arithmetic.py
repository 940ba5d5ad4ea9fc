"""The integer reference's operators on whole numbers (N, C, H, W): exact products, sums, maxima,
and their bounds.
"""

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from beers_deploy.quant.core import INT8_MAX, INT8_MIN, IntConv
from beers_deploy.quant.graph import Activation, AveragePool, MaxPool, Pointwise, Window
from beers_deploy.quant.graph.operations import SIX

FLOAT32_WHOLE_MAX = 2**24
"""Up to here float32 holds whole numbers exactly, and sums them in any order."""
STRIP_VALUES = 1 << 22
"""Values of the windows that are laid out at a time: 16 MB of float32."""
LEAKY_OF_256 = 26


def convolve(
    image: np.ndarray, weight: np.ndarray, window: Window, groups: int = 1, transposed: bool = False
) -> np.ndarray:
    """The sums of products of a convolution with zero padding, (N, I, H, W) to (N, O, H', W')
    int64.

    A product of matrices a strip of rows, in floats that hold its sums exactly: the windows of a
    whole image would take kh kw times its memory.
    """
    if transposed:
        weight, wide, window = weight[:, :, ::-1, ::-1], *_between_zeros(image, weight, window)
    else:
        wide = _padded(image, window)
    largest = 128 * int(np.abs(weight.astype(np.int64)).sum((1, 2, 3)).max(initial=0))
    exact = np.float32 if largest <= FLOAT32_WHOLE_MAX else np.float64
    windows = _windows(wide.astype(exact), weight.shape[2:], window)
    return _products(windows, weight.astype(exact), groups)


def _padded(image: np.ndarray, window: Window, fill: int = 0) -> np.ndarray:
    top, left, bottom, right = window.pads
    return np.pad(image, ((0, 0), (0, 0), (top, bottom), (left, right)), constant_values=fill)


def _windows(wide: np.ndarray, kernel: Sequence[int], window: Window) -> np.ndarray:
    """The windows (N, C, H, W, kh, kw) of an image that is padded already."""
    (rows, columns), (tall, broad) = window.strides, window.dilations
    extent = (kernel[0] - 1) * tall + 1, (kernel[1] - 1) * broad + 1
    return sliding_window_view(wide, extent, (2, 3))[:, :, ::rows, ::columns, ::tall, ::broad]


def _between_zeros(
    image: np.ndarray, weight: np.ndarray, window: Window
) -> tuple[np.ndarray, Window]:
    """What a transposed convolution is of stride 1 over, its kernel turned: the pixels with zeros
    between them.
    """
    count, channels, height, width = image.shape
    (rows, columns), (top, left, bottom, right) = window.strides, window.pads
    between = np.zeros(
        (count, channels, (height - 1) * rows + 1, (width - 1) * columns + 1), image.dtype
    )
    between[:, :, ::rows, ::columns] = image
    tall, broad = (k - 1 for k in weight.shape[2:])
    plain = Window(pads=(tall - top, broad - left, tall - bottom, broad - right))
    return _padded(between, plain), plain


def _products(windows: np.ndarray, weight: np.ndarray, groups: int) -> np.ndarray:
    """Of windows (N, I, H, W, kh, kw) and weights (O, I / groups, kh, kw)."""
    count, channels, height, width = windows.shape[:4]
    sums = np.empty((count, len(weight), height, width), np.int64)
    each = channels // groups
    outputs = len(weight) // groups
    rows = max(STRIP_VALUES // (each * weight[0, 0].size * width), 1)
    for number, group, top in product(range(count), range(groups), range(0, height, rows)):
        strip = windows[number, group * each : (group + 1) * each, top : top + rows]
        flat = strip.transpose(0, 3, 4, 1, 2).reshape(each * weight[0, 0].size, -1)
        own = slice(group * outputs, (group + 1) * outputs)
        found = weight[own].reshape(outputs, -1) @ flat
        sums[number, own, top : top + rows] = found.reshape(outputs, -1, width)
    return sums


def bound_of(op: IntConv, bias: np.ndarray) -> float:
    """Bits, without the sign, that no sum exceeds: of 128 times the sizes of the weights, and the
    bias.
    """
    sizes = np.abs(op.weight.astype(np.int64)).sum((1, 2, 3))
    return float(np.log2(max(int((128 * sizes + np.abs(bias)).max()), 1)))


def activated(sums: np.ndarray, activation: Activation, frac_bits: int) -> tuple[np.ndarray, int]:
    """The sums behind an activation that is computed on them, and how many fractional bits they
    have gained.
    """
    if activation is Activation.relu:
        return np.maximum(sums, 0), 0
    if activation is Activation.relu6:
        return np.clip(sums, 0, SIX << frac_bits if frac_bits >= 0 else SIX >> -frac_bits), 0
    if activation is Activation.leaky_relu:
        return np.where(sums < 0, sums * LEAKY_OF_256, sums << 8), 8
    return sums, 0


def window_maxima(image: np.ndarray, op: MaxPool) -> np.ndarray:
    """The largest value of each window (N, C, H, W), padding never."""
    wide = _padded(image, op.window, int(np.iinfo(image.dtype).min))
    return np.asarray(_windows(wide, op.kernel, op.window).max((4, 5)))


def means(image: np.ndarray, op: AveragePool) -> tuple[np.ndarray, int, float]:
    """Each window's sum times the DPU's factor, the shift behind it, and the bits that it cannot
    exceed.
    """
    assert op.kernel is not None  # noqa: S101 - resolved before anything is quantised
    factor, shift = mean_factor(op.kernel)
    sums = (
        _windows(_padded(image, op.window), op.kernel, op.window).sum((4, 5), dtype=np.int64)
        * factor
    )
    return sums, shift, float(np.log2(128 * factor * op.kernel[0] * op.kernel[1]))


def enlarged(image: np.ndarray, factor: int) -> tuple[np.ndarray, int, float]:
    """Bilinear enlargement with half-pixel centres, its edges repeated: sums, the shift behind
    them, their bits.
    """
    weight, shift = bilinear_weights(factor)
    wide = np.pad(image, ((0, 0), (0, 0), (1, 1), (1, 1)), mode="edge").astype(np.int64)
    windows = sliding_window_view(wide, (3, 3), (2, 3))
    phases = np.einsum("nchwyx,pyx->nchpw", windows, weight.astype(np.int64))
    count, channels, height, _, width = phases.shape
    sums = phases.reshape(count, channels, height, factor, factor, width).transpose(
        0, 1, 2, 3, 5, 4
    )
    return sums.reshape(count, channels, height * factor, width * factor), shift, 7.0 + shift


MEANS = {
    (3, 3): (7, 6),
    (5, 5): (10, 8),
    (6, 6): (7, 8),
    (3, 6): (7, 7),
    (6, 3): (7, 7),
    (7, 7): (21, 10),
}
MEANS[14, 14] = (21, 12)
"""Kernels whose factors the DPU's quantiser states (Vitis-AI 3.0, nndct_shared)."""


def mean_factor(kernel: tuple[int, int]) -> tuple[int, int]:
    """(m, s), m in int8, so that the DPU makes a window's mean of its sum by m / 2^s."""
    if kernel in MEANS:
        return MEANS[kernel]
    count = kernel[0] * kernel[1]
    shifts = range(int(np.ceil(np.log2(INT8_MAX * count))))
    return min(
        ((round(2**s / count), s) for s in shifts),
        key=lambda found: abs(found[0] / 2 ** found[1] - 1 / count),
    )


def bilinear_weights(factor: int) -> tuple[np.ndarray, int]:
    """Whole weights (factor^2, 3, 3) of each phase of a bilinear enlargement by 2 or 4, and the
    shift behind them.
    """
    places = (np.arange(factor) + 0.5) / factor - 0.5  # half-pixel centres, in input pixels
    taps = (
        np.stack([np.maximum(-places, 0), 1 - np.abs(places), np.maximum(places, 0)], 1)
        * 2
        * factor
    )
    whole = np.einsum("yi,xj->yxij", taps, taps).reshape(factor**2, 3, 3)
    return whole.astype(np.int8), 2 * int(np.log2(2 * factor))


def six_in_units(frac_bits: int) -> int:
    """6 in whole multiples of 2^-n, or int8's end."""
    return min(int(np.floor(6 * 2.0**frac_bits + 0.5)), INT8_MAX)


def activation_table(op: Pointwise, frac_bits: Mapping[str, int]) -> np.ndarray:
    """What an activation makes of every int8 value from -128 on: (256,) int16, rounded half up,
    clipped.
    """
    values = op.activation(np.arange(INT8_MIN, INT8_MAX + 1) * 2.0 ** -frac_bits[op.input])
    units = np.floor(values * 2.0 ** frac_bits[op.output] + 0.5)
    return np.asarray(np.clip(units, INT8_MIN, INT8_MAX), np.int16)
