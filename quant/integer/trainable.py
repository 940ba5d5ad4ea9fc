"""The integer core in torch, so that its numbers can be trained: whole numbers forwards, slopes backwards.

Forwards every tensor holds the very whole numbers of `quant.integer.reference`. Backwards rounding counts as the
identity, and clipping as what it is (the straight-through estimator, Bengio et al. 2013). Sums are of float32,
which holds them exactly up to 2^24.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import torch
from torch.nn import functional

from beers_deploy.quant.core import INT8_MAX, INT8_MIN, IntConv, IntCore
from beers_deploy.quant.ends import FINE_MAX, GAIN, Ends
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    Activation,
    Add,
    AveragePool,
    Concat,
    Conv,
    MaxPool,
    Mul,
    Pointwise,
    Resize,
    Shuffle,
    Window,
)
from beers_deploy.quant.graph.operations import LEAKY_SLOPE, SIX, SIXTH
from beers_deploy.quant.integer.arithmetic import activation_table, mean_factor

Tensor = torch.Tensor


def rounded(values: Tensor) -> Tensor:
    """Half up, as the DPU rounds; its slope is 1."""
    return values + (torch.floor(values + 0.5) - values).detach()


def to_int8(values: Tensor) -> Tensor:
    """Rounded and clipped to int8's range; what is clipped has no slope."""
    return rounded(values).clamp(INT8_MIN, INT8_MAX)


class TrainableCore(torch.nn.Module):
    """An integer core whose weights and biases are parameters, in units of their own scale; all scales stay.

    They may lie between whole numbers while they are trained; forwards the nearest whole numbers count.
    """

    def __init__(self, core: IntCore, origins: Sequence[Conv], still: Collection[str] = ()) -> None:
        """Parameters where the float numbers lie, as near as they round to the core's whole ones.

        Args:
            core: in whole numbers.
            origins: the float convolution that each of the core's was rounded from, in their order.
            still: the tensors whose convolutions stay as they are.
        """
        super().__init__()
        self._core = core
        both = list(zip(core.convolutions, origins, strict=True))
        self.weights = torch.nn.ParameterList(_begin(a.weight, b.weight, a.weight_frac_bits) for a, b in both)
        self.biases = torch.nn.ParameterList(_begin(a.bias, b.stored_bias, a.bias_frac_bits) for a, b in both)
        for op, *numbers in zip(core.convolutions, self.weights, self.biases, strict=True):
            for parameter in numbers:
                parameter.requires_grad_(op.output not in still)

    def core(self) -> IntCore:
        """The core with its weights and biases as they stand, in whole numbers."""
        found = zip(self._core.convolutions, map(_whole, self.weights), map(_whole, self.biases), strict=True)
        trained = {op.name: replace(op, weight=weight, bias=bias) for op, weight, bias in found}
        return replace(self._core, ops=tuple(trained.get(op.name, op) for op in self._core.ops))

    def forward(self, planes: Tensor) -> Tensor:
        """The one correction (N, C, H, W) in float, of int8 planes (N, P, H, W) as float32."""
        scale = self._core.scale(CORRECTION)
        return merged(self._core.ends, self.tensors(planes)[CORRECTION] * scale, scale)

    def tensors(self, planes: Tensor) -> dict[str, Tensor]:
        """Every tensor (N, C, H, W) by its name, in whole numbers."""
        found, numbers = {PLANES: planes}, iter(zip(self.weights, self.biases, strict=True))
        for op in self._core.ops:
            read = [found[name] for name in op.inputs]
            if isinstance(op, IntConv):
                weight, bias = next(numbers)
                sums, finer = _conv(op, read[0], to_int8(weight), to_int8(bias), self._core.frac_bits[op.input])
            else:
                sums, finer = _OPERATIONS[type(op)](op, read, self._core.frac_bits)
            found[op.output] = to_int8(sums * 2.0 ** (self._core.frac_bits[op.output] - finer))
        return found


NEAR = 0.49
"""How far from a whole number a value may begin that stands for it."""


def _begin(whole: np.ndarray, origin: np.ndarray, frac_bits: int) -> Tensor:
    """The float numbers in units of the scale, drawn to where they round to the whole ones."""
    return torch.tensor(np.clip(origin * 2.0**frac_bits, whole - NEAR, whole + NEAR), dtype=torch.float32)


def _whole(values: Tensor) -> np.ndarray:
    return np.asarray(to_int8(values.detach()).numpy().astype(np.int8))


def merged(ends: Ends, correction: Tensor, scale: float) -> Tensor:
    """As `Ends.merge`: one correction (N, C, H, W) from its gains or windows."""
    if ends.copies == 1:
        return correction
    limit = (FINE_MAX + 0.5) * scale
    if not ends.offsets:
        fine, coarse, *analytic = correction.chunk(ends.copies, dim=1)
        value = torch.where(fine.abs() <= limit, fine, coarse * GAIN)
        return value + torch.stack(analytic).sum(0) * ends.analytic_gain(scale) if analytic else value
    coarse, *windows = correction.chunk(ends.copies, dim=1)
    value = coarse * GAIN
    for window, offset in zip(windows, ends.offsets, strict=True):
        value = torch.where(window.abs() <= limit, window + torch.tensor(offset)[:, None, None], value)
    return value


Sums = tuple[Tensor, int]
"""What an operation computes (N, C, H, W) before it is rounded, and how many fractional bits it has."""
Bits = Mapping[str, int]


def _conv(op: IntConv, image: Tensor, weight: Tensor, bias: Tensor, frac_bits: int) -> Sums:
    product = op.weight_frac_bits + frac_bits
    bias = bias * 2.0 ** (product - op.bias_frac_bits)
    return _activated(_products(op, image, weight) + bias[:, None, None], op.activation, product), product


def _products(op: IntConv, image: Tensor, weight: Tensor) -> Tensor:
    window = op.window
    if not op.transposed:
        return functional.conv2d(_padded(image, window), weight, None, window.strides, 0, window.dilations, op.groups)
    outputs, inner, rows, columns = weight.shape
    weight = weight.reshape(op.groups, outputs // op.groups, inner, rows, columns).transpose(1, 2)
    weight = weight.reshape(op.groups * inner, outputs // op.groups, rows, columns)
    wide = functional.conv_transpose2d(image, weight, None, window.strides, groups=op.groups)
    top, left, bottom, right = window.pads
    return wide[:, :, top : wide.shape[2] - bottom, left : wide.shape[3] - right]


def _padded(image: Tensor, window: Window, fill: float = 0.0) -> Tensor:
    top, left, bottom, right = window.pads
    return functional.pad(image, (left, right, top, bottom), value=fill)


def _activated(sums: Tensor, activation: Activation, frac_bits: int) -> Tensor:
    """The sums behind what is computed on the accumulator."""
    if activation is Activation.relu6:
        return sums.clamp(0, SIX * 2.0**frac_bits)
    return _SLOPES[activation](sums)


_SLOPES: Mapping[Activation, Callable[[Tensor], Tensor]] = MappingProxyType(
    {
        Activation.none: lambda values: values,
        Activation.relu: functional.relu,
        Activation.relu6: functional.relu6,
        Activation.leaky_relu: lambda values: functional.leaky_relu(values, LEAKY_SLOPE),
        Activation.hard_sigmoid: lambda values: functional.relu6(values + 3) * SIXTH,
        Activation.hard_swish: lambda values: values * functional.relu6(values + 3) * SIXTH,
        Activation.saturated_relu: lambda values: values,
    }
)


def _add(op: Add, read: Sequence[Tensor], bits: Bits) -> Sums:
    finest = max(bits[name] for name in op.inputs)
    sums = sum(values * 2.0 ** (finest - bits[name]) for name, values in zip(op.inputs, read, strict=True))
    return _activated(torch.as_tensor(sums), op.activation, finest), finest


def _mul(op: Mul, read: Sequence[Tensor], bits: Bits) -> Sums:
    return read[0] * read[1], sum(bits[name] for name in op.inputs)


def _concat(op: Concat, read: Sequence[Tensor], bits: Bits) -> Sums:
    return torch.cat(list(read), dim=1), bits[op.output]


def _max_pool(op: MaxPool, read: Sequence[Tensor], bits: Bits) -> Sums:
    window = op.window
    wide = _padded(read[0], window, float(INT8_MIN))
    return functional.max_pool2d(wide, op.kernel, window.strides, 0, window.dilations), bits[op.output]


def _average_pool(op: AveragePool, read: Sequence[Tensor], bits: Bits) -> Sums:
    assert op.kernel is not None  # noqa: S101 - resolved before anything is quantised
    factor, shift = mean_factor(op.kernel)
    sums = functional.avg_pool2d(_padded(read[0], op.window), op.kernel, op.window.strides, divisor_override=1)
    return sums * factor, bits[op.output] + shift


def _resize(op: Resize, read: Sequence[Tensor], bits: Bits) -> Sums:
    if op.bilinear:
        wide = functional.interpolate(read[0], scale_factor=op.factor, mode="bilinear", align_corners=False)
    else:
        wide = functional.interpolate(read[0], scale_factor=op.factor, mode="nearest")
    return wide, bits[op.output]


def _shuffle(op: Shuffle, read: Sequence[Tensor], bits: Bits) -> Sums:
    """By the places that the values come from, which numpy moves as it would move the values."""
    places = op(np.arange(read[0][0].numel()).reshape(1, *read[0].shape[1:]))
    moved = read[0].flatten(1)[:, torch.from_numpy(places.ravel())]
    return moved.reshape(len(moved), *places.shape[1:]), bits[op.output]


def _pointwise(op: Pointwise, read: Sequence[Tensor], bits: Bits) -> Sums:
    """Its table's values, with the function's slope."""
    table = torch.from_numpy(activation_table(op, bits).astype(np.float32))
    smooth = _SLOPES[op.activation](read[0] * 2.0 ** -bits[op.input]) * 2.0 ** bits[op.output]
    return smooth + (table[(read[0].detach() - INT8_MIN).long()] - smooth).detach(), bits[op.output]


_OPERATIONS: Mapping[type, Callable[..., Sums]] = MappingProxyType(
    {
        Add: _add,
        Mul: _mul,
        Concat: _concat,
        MaxPool: _max_pool,
        AveragePool: _average_pool,
        Resize: _resize,
        Shuffle: _shuffle,
        Pointwise: _pointwise,
    }
)
