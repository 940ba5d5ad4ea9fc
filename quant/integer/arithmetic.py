"""Compute the integer reference's operators on integers (N, C, H, W): exact products, sums, maxima,
and their bounds.
"""

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from beers_deploy.quant.core import IntConv
from beers_deploy.quant.frac_bits import INT8_MAX, INT8_MIN
from beers_deploy.quant.graph import SIX, Activation, AveragePool, MaxPool, Pointwise, Window

FLOAT32_WHOLE_MAX = 2**24
"""float32 represents integers exactly up to this value, and sums them exactly in any order."""
STRIP_VALUES = 1 << 22
"""The number of window values that are expanded at a time: 16 MB of float32."""
LEAKY_OF_256 = 26
"""The slope of LeakyReLU below 0, in 256ths."""


def convolve(
    image: np.ndarray, weight: np.ndarray, window: Window, groups: int = 1, transposed: bool = False
) -> np.ndarray:
    """Compute the sums of products of an integer convolution with zero padding, without bias.

    It computes a matrix product per strip of rows, in floats that represent its sums exactly. The
    windows of a whole image would need kh kw times its memory.

    Args:
        image: integers (N, I, H, W).
        weight: integers (O, I / groups, kh, kw).
        window: strides, pads and dilations.
        groups: 1, or the number of channels of a depthwise convolution.
        transposed: True for a transposed convolution, in which strides enlarge and pads crop.

    Returns:
        The sums, (N, O, H', W') int64.
    """
    if transposed:
        # A transposed convolution is a convolution of stride 1 over the pixels with zeros between
        # them, by a rotated kernel.
        rows, columns = window.strides
        count, channels, height, width = image.shape
        spread = (count, channels, (height - 1) * rows + 1, (width - 1) * columns + 1)
        between = np.zeros(spread, image.dtype)
        between[:, :, ::rows, ::columns] = image
        image = between
        # Its padding crops the result, so it is subtracted from the full padding k - 1.
        top, left, bottom, right = window.pads
        tall, broad = (k - 1 for k in weight.shape[2:])
        window = Window(pads=(tall - top, broad - left, tall - bottom, broad - right))
        weight = weight[:, :, ::-1, ::-1]
    wide = _padded(image, window)
    # An int8 value is at most 128 in size, so neither a sum nor a part of it exceeds this bound.
    # Below 2^24 float32 is exact in any order of summation, which the matrix product may choose.
    sizes = np.abs(weight.astype(np.int64)).sum((1, 2, 3))
    largest = 128 * int(sizes.max(initial=0))
    exact = np.float32 if largest <= FLOAT32_WHOLE_MAX else np.float64
    windows = _windows(wide.astype(exact), weight.shape[2:], window)
    return _products(windows, weight.astype(exact), groups)


def _padded(image: np.ndarray, window: Window, fill: int = 0) -> np.ndarray:
    top, left, bottom, right = window.pads
    return np.pad(image, ((0, 0), (0, 0), (top, bottom), (left, right)), constant_values=fill)


def _windows(wide: np.ndarray, kernel: Sequence[int], window: Window) -> np.ndarray:
    """Return the windows (N, C, H, W, kh, kw) of an image that is padded already."""
    rows, columns = window.strides
    tall, broad = window.dilations
    extent = (kernel[0] - 1) * tall + 1, (kernel[1] - 1) * broad + 1
    return sliding_window_view(wide, extent, (2, 3))[:, :, ::rows, ::columns, ::tall, ::broad]


def _products(windows: np.ndarray, weight: np.ndarray, groups: int) -> np.ndarray:
    """Return the products of windows (N, I, H, W, kh, kw) and weights (O, I / groups, kh, kw)."""
    count, channels, height, width = windows.shape[:4]
    sums = np.empty((count, len(weight), height, width), np.int64)
    inputs = channels // groups
    outputs = len(weight) // groups
    rows = max(STRIP_VALUES // (inputs * weight[0, 0].size * width), 1)
    for number, group, top in product(range(count), range(groups), range(0, height, rows)):
        strip = windows[number, group * inputs : (group + 1) * inputs, top : top + rows]
        # `windows` is a view; only this reshape copies values, kh kw times those of the strip.
        flat = strip.transpose(0, 3, 4, 1, 2).reshape(inputs * weight[0, 0].size, -1)
        channel = slice(group * outputs, (group + 1) * outputs)
        products = weight[channel].reshape(outputs, -1) @ flat
        sums[number, channel, top : top + rows] = products.reshape(outputs, -1, width)
    return sums


def accumulator_bias(op: IntConv, shift: int) -> np.ndarray:
    """Return the bias of a convolution at the scale of its sums, (O,) int64.

    A bias finer than the accumulator, which a board's rules allow, loses its lowest bits.

    Args:
        op: the convolution.
        shift: the left shift in bits from the bias's own scale; a negative one shifts right.
    """
    bias = op.bias.astype(np.int64)
    return bias << shift if shift >= 0 else bias >> -shift


def bound_of(op: IntConv, bias: np.ndarray) -> float:
    """Return the number of bits, without the sign, that no sum of a convolution exceeds, for any
    int8 image.

    It is log2 of 128 times the sum of a channel's absolute weights plus the absolute bias.

    Args:
        op: the convolution.
        bias: (O,) its bias at the scale of the sums.
    """
    sizes = np.abs(op.weight.astype(np.int64)).sum((1, 2, 3))
    return float(np.log2(max(int((128 * sizes + np.abs(bias)).max()), 1)))


def activated(sums: np.ndarray, activation: Activation, frac_bits: int) -> tuple[np.ndarray, int]:
    """Apply an activation to the integer sums of an operation.

    Args:
        sums: integers of any shape.
        activation: the activation of the operation.
        frac_bits: the number of fractional bits of the sums.

    Returns:
        The results, integers, and the number of fractional bits that they have in addition to those
        of the sums: 8 for LeakyReLU, whose slope is 26/256, else 0.
    """
    if activation is Activation.relu:
        return np.maximum(sums, 0), 0
    if activation is Activation.relu6:
        return np.clip(sums, 0, SIX << frac_bits if frac_bits >= 0 else SIX >> -frac_bits), 0
    if activation is Activation.leaky_relu:
        # The slope is 26/256: in units finer by 2^-8 both branches stay integers.
        return np.where(sums < 0, sums * LEAKY_OF_256, sums << 8), 8
    return sums, 0


def window_maxima(image: np.ndarray, op: MaxPool) -> np.ndarray:
    """Return the largest value of each window of a max pool; padding never counts.

    Args:
        image: integers (N, C, H, W).
        op: the max pool.

    Returns:
        (N, C, H', W') in the type of the image.
    """
    # No value is below the smallest of the type, so the padding never is a window's maximum.
    wide = _padded(image, op.window, int(np.iinfo(image.dtype).min))
    return np.asarray(_windows(wide, op.kernel, op.window).max((4, 5)))


def means(image: np.ndarray, op: AveragePool) -> tuple[np.ndarray, int, float]:
    """Compute the sum of each window of an average pool times an integer.

    A right shift then makes the mean of it, as on the DPU. Zeros of the padding count.

    Args:
        image: int8 values (N, C, H, W).
        op: the average pool, with the size of its window.

    Returns:
        The sums times the factor of `mean_factor`, (N, C, H', W') int64; the right shift that makes
        means of them; and log2 of the largest magnitude that these sums can have.
    """
    assert op.kernel is not None  # noqa: S101 - resolved before anything is quantised
    factor, shift = mean_factor(op.kernel)
    # Padded zeros count in the mean: the divisor is the whole kernel in every window.
    windows = _windows(_padded(image, op.window), op.kernel, op.window)
    sums = windows.sum((4, 5), dtype=np.int64) * factor
    return sums, shift, float(np.log2(128 * factor * op.kernel[0] * op.kernel[1]))


def enlarged(image: np.ndarray, factor: int) -> tuple[np.ndarray, int, float]:
    """Enlarge a map by integer bilinear weights, with half-pixel centres and edges repeated.

    Args:
        image: int8 values (N, C, H, W).
        factor: the factor of rows and columns, 2 or 4.

    Returns:
        The weighted sums, (N, C, factor H, factor W) int64; the right shift that makes values of
        them; and the number of bits, without the sign, that they cannot exceed.
    """
    weight, shift = bilinear_weights(factor)
    wide = np.pad(image, ((0, 0), (0, 0), (1, 1), (1, 1)), mode="edge").astype(np.int64)
    windows = sliding_window_view(wide, (3, 3), (2, 3))
    phases = np.einsum("nchwyx,pyx->nchpw", windows, weight.astype(np.int64))
    count, channels, height, _, width = phases.shape
    sums = phases.reshape(count, channels, height, factor, factor, width)
    sums = sums.transpose(0, 1, 2, 3, 5, 4)
    # The weights of a phase sum to 2^shift, so an int8 value grows by no more bits than that.
    return sums.reshape(count, channels, height * factor, width * factor), shift, 7.0 + shift


MEANS = {
    (3, 3): (7, 6),
    (5, 5): (10, 8),
    (6, 6): (7, 8),
    (3, 6): (7, 7),
    (6, 3): (7, 7),
    (7, 7): (21, 10),
    (14, 14): (21, 12),
}
"""Kernels whose factors the DPU's quantiser defines (Vitis-AI 3.0, nndct_shared)."""


def mean_factor(kernel: tuple[int, int]) -> tuple[int, int]:
    """Return the integer factor and the shift by which the DPU computes the mean of a window.

    Args:
        kernel: rows and columns of the window.

    Returns:
        (m, s), with m in int8: the mean is the window's sum times m / 2^s, approximately.
    """
    if kernel in MEANS:
        return MEANS[kernel]
    count = kernel[0] * kernel[1]
    # The factor 2^s / count must fit int8, which bounds the shift by log2(127 count).
    shifts = range(int(np.ceil(np.log2(INT8_MAX * count))))
    return min(
        ((round(2**s / count), s) for s in shifts),
        key=lambda factor: abs(factor[0] / 2 ** factor[1] - 1 / count),
    )


def bilinear_weights(factor: int) -> tuple[np.ndarray, int]:
    """Return the integer weights of a bilinear enlargement, and the shift that divides by their
    sum.

    Args:
        factor: the factor of rows and columns, 2 or 4.

    Returns:
        Weights (factor^2, 3, 3) and a shift s. Each pixel becomes factor^2 pixels, and each of
        those has weights for the 3 x 3 neighbours of the pixel, which add up to 2^s.
    """
    places = (np.arange(factor) + 0.5) / factor - 0.5  # half-pixel centres, in input pixels
    shares = np.stack([np.maximum(-places, 0), 1 - np.abs(places), np.maximum(places, 0)], 1)
    # Half-pixel centres lie at odd multiples of 1 / (2 factor), so in that unit taps are integers.
    taps = shares * 2 * factor
    weight = np.einsum("yi,xj->yxij", taps, taps).reshape(factor**2, 3, 3)
    return weight.astype(np.int8), 2 * int(np.log2(2 * factor))


def six_in_units(frac_bits: int) -> int:
    """Return the integer at which a ReLU6 clips: 6 in units of 2^-frac_bits, at most 127."""
    return min(int(np.floor(6 * 2.0**frac_bits + 0.5)), INT8_MAX)


def activation_table(op: Pointwise, frac_bits: Mapping[str, int]) -> np.ndarray:
    """Tabulate an activation: its int8 result for each int8 input from -128 to 127.

    Args:
        op: the activation.
        frac_bits: the number of fractional bits of each tensor by its name, at least of the two
            that the activation reads and writes.

    Returns:
        (256,) int16, clipped to int8.
    """
    values = op.activation(np.arange(INT8_MIN, INT8_MAX + 1) * 2.0 ** -frac_bits[op.input])
    # The DPU rounds activations half up, where np.rint would round half to even.
    units = np.floor(values * 2.0 ** frac_bits[op.output] + 0.5)
    return saturated(units)


def saturated(values: np.ndarray) -> np.ndarray:
    """Clip integers to the range of int8, and return them as int16."""
    return np.asarray(np.clip(values, INT8_MIN, INT8_MAX), np.int16)
