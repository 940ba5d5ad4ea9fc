"""The integer core in torch, so that its numbers can be trained: whole numbers forwards, slopes
backwards.

Forwards every tensor holds the very whole numbers of `quant.integer.reference`. Backwards rounding
counts as the identity, and clipping as what it is (the straight-through estimator, Bengio et al.
2013). A step costs about what one of the float network does: weights carry the shift to the
result's unit, biases what makes ties round up, and one pass over the sums clips them, another
rounds them. Sums are of float32, which holds them exactly up to 2^22, behind LeakyReLU 2^19.

A result in windows or two gains is trained as one copy of it, which is not rounded: it differs from
what the host computes by up to half a unit. `TrainableCore.core` makes the other copies.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import torch
from torch.nn import functional

from beers_deploy.quant.core import INT8_MAX, INT8_MIN, IntConv, IntCore
from beers_deploy.quant.ends import GAIN, Ends
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    Activation,
    Add,
    AveragePool,
    Concat,
    MaxPool,
    Mul,
    Pointwise,
    Resize,
    Shuffle,
    Window,
)
from beers_deploy.quant.graph.operations import LEAKY_SLOPE
from beers_deploy.quant.integer.arithmetic import (
    activation_table,
    bilinear_weights,
    mean_factor,
    six_in_units,
)

Tensor = torch.Tensor
Bits = Mapping[str, int]


NEAR = 0.49
"""How far from int8's ends a value may lie and is not clipped: what is rounded to them."""


def to_int8(values: Tensor, low: int = INT8_MIN, high: int = INT8_MAX) -> Tensor:
    """Rounded, ties to even, and clipped; the slope is 1, and 0 where it is clipped."""
    clipped = functional.hardtanh(values, low - NEAR, high + NEAR)
    clipped.data.round_()  # unseen by autograd
    return clipped


class TrainableCore(torch.nn.Module):
    """An integer core whose weights and biases are parameters, in units of their own scale; all
    scales stay.

    They may lie between whole numbers while they are trained; forwards the nearest whole numbers
    count.
    """

    def __init__(self, core: IntCore, still: Collection[str] = ()) -> None:
        """Parameters that begin at the core's whole numbers; convolutions that write what is
        `still` stay so.
        """
        super().__init__()
        self._core = core
        self._convs = [_one_copy(op, core.ends) for op in core.convolutions]
        self.weights = torch.nn.ParameterList(torch.tensor(op.weight).float() for op in self._convs)
        self.biases = torch.nn.ParameterList(torch.tensor(op.bias).float() for op in self._convs)
        for op, *numbers in zip(self._convs, self.weights, self.biases, strict=True):
            for parameter in numbers:
                parameter.requires_grad_(op.output not in still)
        if core.ends.offsets:
            self.biases[-1].data.copy_(torch.from_numpy(_window_bias(self._convs[-1], core.ends)))

    def core(self) -> IntCore:
        """The core with its weights and biases as they stand, in whole numbers."""
        found = zip(self._convs, map(_whole, self.weights), map(_whole, self.biases), strict=True)
        trained = {op.name: replace(op, weight=weight, bias=bias) for op, weight, bias in found}
        ops = [trained.get(op.name, op) for op in self._core.ops]
        ends = self._core.ends
        last = self._core.ops[-1]
        if ends.copies > 1 and isinstance(last, IntConv):
            one = trained[last.name]
            bias = self.biases[-1].detach().numpy() if ends.offsets else one.bias
            ops[-1], ends = _all_copies(last, ends, one.weight, bias)
        return replace(self._core, ops=tuple(ops), ends=ends)

    def forward(self, planes: Tensor) -> Tensor:
        """The one correction (N, C, H, W) in float, of int8 planes (N, P, H, W) as float32."""
        return self.tensors(planes)[CORRECTION] * self._core.scale(CORRECTION)

    def tensors(self, planes: Tensor) -> dict[str, Tensor]:
        """Every tensor (N, C, H, W) by its name in whole numbers; of a correction in copies one,
        unrounded.
        """
        found = {PLANES: planes}
        numbers = iter(zip(self._convs, self.weights, self.biases, strict=True))
        for op in self._core.ops:
            read = [found[name] for name in op.inputs]
            if isinstance(op, IntConv):
                found[op.output] = self._convolved(*next(numbers), read[0])
            else:
                found[op.output] = _OPERATIONS[type(op)](op, read, self._core.frac_bits)
        return found

    def _convolved(self, op: IntConv, weight: Tensor, bias: Tensor, image: Tensor) -> Tensor:
        """A convolution's result, of its parameters and what it reads."""
        ends = self._core.ends
        frac_bits = self._core.frac_bits[op.output]
        unit = 2.0 ** (frac_bits - op.weight_frac_bits - self._core.frac_bits[op.input])
        bias_unit = 2.0 ** (frac_bits - op.bias_frac_bits)
        if op.output == CORRECTION and ends.copies > 1:
            return _products(
                op,
                image,
                to_int8(weight) * unit,
                (bias if ends.offsets else to_int8(bias)) * bias_unit,
            )
        lifted = _products(
            op,
            image,
            to_int8(weight) * unit,
            to_int8(bias) * bias_unit + _lift(op.activation) * unit,
        )
        return _rounded(lifted, op.activation, frac_bits)


def _whole(values: Tensor) -> np.ndarray:
    return np.asarray(to_int8(values.detach()).numpy().astype(np.int8))


def _products(op: IntConv, image: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """The sums of a convolution, padding inside it as far as it is the same on both sides."""
    window, (top, left, bottom, right) = op.window, op.window.pads
    within = min(top, bottom), min(left, right)
    around = left - within[1], right - within[1], top - within[0], bottom - within[0]
    if not op.transposed:
        image = functional.pad(image, around) if any(around) else image
        return functional.conv2d(
            image, weight, bias, window.strides, within, window.dilations, op.groups
        )
    outputs, inner, *kernel = weight.shape
    weight = weight.reshape(op.groups, outputs // op.groups, inner, *kernel).transpose(1, 2)
    weight = weight.reshape(op.groups * inner, outputs // op.groups, *kernel)
    wide = functional.conv_transpose2d(
        image, weight, bias, window.strides, within, groups=op.groups
    )
    return wide[:, :, around[2] : wide.shape[2] - around[3], around[0] : wide.shape[3] - around[1]]


def _lift(activation: Activation = Activation.none) -> float:
    """What sums are raised by, in their unit, so that ties to even become ties up and nothing else
    moves.

    LeakyReLU divides the unit by 128 and what is added by ten.
    """
    return 2.0**-5 if activation is Activation.leaky_relu else 2.0**-2


def _rounded(lifted: Tensor, activation: Activation, frac_bits: int) -> Tensor:
    """Lifted sums behind their activation, in int8."""
    if activation is Activation.leaky_relu:
        lifted = functional.leaky_relu(lifted, LEAKY_SLOPE)
    low = 0 if activation in (Activation.relu, Activation.relu6) else INT8_MIN
    return to_int8(
        lifted, low, six_in_units(frac_bits) if activation is Activation.relu6 else INT8_MAX
    )


def _add(op: Add, read: Sequence[Tensor], bits: Bits) -> Tensor:
    """Nothing is rounded, nor lifted, where the result is as fine as what is added."""
    frac_bits = bits[op.output]
    finest = max(bits[name] for name in op.inputs)
    one, other = (
        _times(values, frac_bits - bits[name]) for name, values in zip(op.inputs, read, strict=True)
    )
    sums = one + other
    if finest > frac_bits or op.activation is Activation.leaky_relu:
        sums = sums + _lift(op.activation) * 2.0 ** (frac_bits - finest)
    return _rounded(sums, op.activation, frac_bits)


def _times(values: Tensor, power: int) -> Tensor:
    return values * 2.0**power if power else values


def _mul(op: Mul, read: Sequence[Tensor], bits: Bits) -> Tensor:
    unit = 2.0 ** (bits[op.output] - sum(bits[name] for name in op.inputs))
    return to_int8(read[0] * read[1] * unit + _lift() * unit)


def _max_pool(op: MaxPool, read: Sequence[Tensor], _: Bits) -> Tensor:
    wide = _padded(read[0], op.window, INT8_MIN)
    return functional.max_pool2d(wide, op.kernel, op.window.strides, 0, op.window.dilations)


def _average_pool(op: AveragePool, read: Sequence[Tensor], _: Bits) -> Tensor:
    assert op.kernel is not None  # noqa: S101 - resolved before anything is quantised
    factor, shift = mean_factor(op.kernel)
    sums = functional.avg_pool2d(
        _padded(read[0], op.window), op.kernel, op.window.strides, divisor_override=1
    )
    return to_int8((sums * factor + _lift()) * 2.0**-shift)


def _padded(image: Tensor, window: Window, fill: float = 0.0) -> Tensor:
    top, left, bottom, right = window.pads
    return (
        functional.pad(image, (left, right, top, bottom), value=fill) if any(window.pads) else image
    )


def _resize(op: Resize, read: Sequence[Tensor], _: Bits) -> Tensor:
    if not op.bilinear:
        return functional.interpolate(read[0], scale_factor=op.factor, mode="nearest")
    wide = functional.interpolate(
        read[0], scale_factor=op.factor, mode="bilinear", align_corners=False
    )
    return to_int8(wide + _lift() * 2.0 ** -bilinear_weights(op.factor)[1])


def _shuffle(op: Shuffle, read: Sequence[Tensor], _: Bits) -> Tensor:
    image = read[0]
    squares = op.block**2
    if op.up:
        return functional.pixel_shuffle(
            image if op.columns_first else _turned(image, squares), op.block
        )
    moved = functional.pixel_unshuffle(image, op.block)
    return moved if op.columns_first else _turned(moved, moved.shape[1] // squares)


def _turned(image: Tensor, outer: int) -> Tensor:
    """Channels of so many groups, their places in the groups counted first."""
    count, channels, height, width = image.shape
    groups = image.reshape(count, outer, channels // outer, height, width)
    return groups.transpose(1, 2).reshape(count, channels, height, width)


def _pointwise(op: Pointwise, read: Sequence[Tensor], bits: Bits) -> Tensor:
    """Its table's values, with the function's slope between neighbours."""
    units = np.arange(INT8_MIN, INT8_MAX + 1)
    smooth = op.activation(units * 2.0 ** -bits[op.input]) * 2.0 ** bits[op.output]
    places = (read[0].detach() - INT8_MIN).int()
    tables = activation_table(op, bits), np.gradient(smooth)
    result, slope = (torch.from_numpy(table.astype(np.float32))[places] for table in tables)
    return torch.addcmul(result, read[0] - read[0].detach(), slope)


_OPERATIONS: Mapping[type, Callable[..., Tensor]] = MappingProxyType(
    {
        Add: _add,
        Mul: _mul,
        Concat: lambda _, read, __: torch.cat(list(read), dim=1),
        MaxPool: _max_pool,
        AveragePool: _average_pool,
        Resize: _resize,
        Shuffle: _shuffle,
        Pointwise: _pointwise,
    }
)


def _one_copy(op: IntConv, ends: Ends) -> IntConv:
    """Of a convolution that writes copies of the result the first fine one; any other as it is."""
    if op.output != CORRECTION or ends.copies == 1:
        return op
    first = ends.outputs if ends.offsets else 0
    return replace(
        op,
        weight=op.weight[first : first + ends.outputs],
        bias=op.bias[first : first + ends.outputs],
    )


def _all_copies(
    last: IntConv, ends: Ends, weight: np.ndarray, bias: np.ndarray
) -> tuple[IntConv, Ends]:
    """All copies moved as one was trained, the coarse one by an eighth; a window's bias moves the
    host's offsets.

    Args:
        last: the convolution that writes the copies, as it was.
        ends: of the core, as they were.
        weight: of the copy that was trained, (O, I, kh, kw) in whole numbers.
        bias: of that copy, (O,), in whole numbers; of a window in units of its scale with the
            offset.
    """
    one = _one_copy(last, ends)
    coarse = np.arange(ends.copies) == (0 if ends.offsets else 1)
    shares = np.where(coarse, 1 / GAIN, 1)
    weights = _moved(last.weight, shares, weight.astype(float) - one.weight)
    if not ends.offsets:
        return replace(
            last, weight=weights, bias=_moved(last.bias, shares, bias.astype(float) - one.bias)
        ), ends
    moved = bias - _window_bias(one, ends)
    offsets = np.array(ends.offsets) + moved * 2.0**-one.bias_frac_bits
    ends = replace(ends, offsets=tuple(tuple(map(float, window)) for window in offsets))
    return replace(last, weight=weights, bias=_moved(last.bias, coarse / GAIN, moved)), ends


def _window_bias(one: IntConv, ends: Ends) -> np.ndarray:
    """What the DPU and the host add to a result in windows, (O,) in units of the bias."""
    return np.asarray(one.bias + np.array(ends.offsets[0]) * 2.0**one.bias_frac_bits, np.float32)


def _moved(copies: np.ndarray, shares: np.ndarray, move: np.ndarray) -> np.ndarray:
    """Copies one behind the other, each moved by its share, in whole numbers."""
    moves = np.rint(np.multiply.outer(shares, move)).reshape(copies.shape)
    return np.asarray(np.clip(copies + moves, INT8_MIN, INT8_MAX), np.int8)
