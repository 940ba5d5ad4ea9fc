"""Compute the integer core in torch, so that its numbers can be trained: integers forwards,
gradients backwards.

In the forward pass every tensor holds exactly the integers of `quant.integer.reference`. In the
backward pass rounding counts as the identity, and clipping has its own gradient (the
straight-through estimator, Bengio et al. 2013). A step costs about as much as one of the float
network. Weights include the shift to the result's unit, and biases the offset by which ties round
up. One pass over the sums clips them, another rounds them. Sums are float32, which represents them
exactly up to 2^22, behind LeakyReLU up to 2^19.

A result in windows or two gains is trained as one copy of it, which is not rounded. It differs from
the host's result by up to half a unit. `TrainableCore.core` derives the other copies.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional

from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.frac_bits import INT8_MAX, INT8_MIN
from beers_deploy.quant.graph import (
    CORRECTION,
    LEAKY_SLOPE,
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
from beers_deploy.quant.host_part import HostPart, OutputDecoding
from beers_deploy.quant.integer.arithmetic import (
    activation_table,
    bilinear_weights,
    mean_factor,
    six_in_units,
)

Tensor = torch.Tensor
Bits = Mapping[str, int]

NEAR = 0.49
"""How far beyond int8's ends a value may lie without being clipped, because it rounds to them."""


def to_int8(values: Tensor, low: int = INT8_MIN, high: int = INT8_MAX) -> Tensor:
    """Round values to integers and clip them, such that gradients pass.

    Ties go to even. Backwards the slope is 1, and 0 where values are clipped.

    Args:
        values: float32 in units of the result's scale.
        low: the smallest integer of the result.
        high: the largest integer of the result.

    Returns:
        Integers as float32.
    """
    # hardtanh has slope 0 outside its limits, so a value must pass as long as it rounds to an end.
    clipped = functional.hardtanh(values, low - NEAR, high + NEAR)
    # autograd does not see that `data` is rounded: backwards the rounding is the identity.
    clipped.data.round_()
    return clipped


ACTIVATIONS = {"Sigmoid": torch.sigmoid, "Tanh": torch.tanh}
"""The host's activations (`host_part.part.ACTIVATIONS`), for autograd."""


class TrainableCore(torch.nn.Module):
    """An integer core in torch, whose weights and biases are trained while all scales are fixed.

    The parameters are floats in units of their own scale. They may lie between integers, but the
    forward pass uses the nearest ones.
    """

    def __init__(self, core: IntCore) -> None:
        """Start the parameters at the core's integers."""
        super().__init__()
        self._core = core
        self._convs = [_one_copy(op, core.host_part) for op in core.convolutions]
        self.weights = torch.nn.ParameterList(torch.tensor(op.weight).float() for op in self._convs)
        self.biases = torch.nn.ParameterList(torch.tensor(op.bias).float() for op in self._convs)
        if core.host_part.decoding.offsets:
            # The host adds a window's offset in float, so this bias need not be an integer.
            self.biases[-1].data.copy_(
                torch.from_numpy(_window_bias(self._convs[-1], core.host_part.decoding))
            )

    def core(self) -> IntCore:
        """Return an integer core with the trained weights and biases, rounded to int8."""
        trained = {
            op.name: replace(op, weight=_whole(weight), bias=_whole(bias))
            for op, weight, bias in zip(self._convs, self.weights, self.biases, strict=True)
        }
        ops = [trained.get(op.name, op) for op in self._core.ops]
        host_part = self._core.host_part
        last = self._core.ops[-1]
        if host_part.decoding.copies > 1 and isinstance(last, IntConv):
            one = trained[last.name]
            # int8 need not hold a window's bias with its offset, so it is taken in float.
            bias = self.biases[-1].detach().numpy() if host_part.decoding.offsets else one.bias
            ops[-1], host_part = _all_copies(last, host_part, one.weight, bias)
        return replace(self._core, ops=tuple(ops), host_part=host_part)

    def with_finer_tensors(self, names: Collection[str], by: int) -> "TrainableCore":
        """Return a copy in which some tensors have another scale, while weights and biases stay.

        Args:
            names: the names of the tensors.
            by: the number of fractional bits to add to each; negative ones make the scale coarser.
        """
        copy = deepcopy(self)
        frac_bits = self._core.frac_bits
        finer = {name: frac_bits[name] + by for name in names}
        # Weights and biases have scales of their own, so their integers stay.
        copy._core = replace(self._core, frac_bits={**frac_bits, **finer})
        return copy

    def with_finer_numbers(self, role: str, number: int, by: int) -> "TrainableCore":
        """Return a copy in which the weights or biases of one convolution have another scale.

        The values that they represent stay the same, unless they are clipped.

        Args:
            role: "weight" or "bias".
            number: the place of the convolution among the core's convolutions.
            by: the number of fractional bits to add; negative ones make the scale coarser.
        """
        copy = deepcopy(self)
        op = self._convs[number]
        key = f"{role}_frac_bits"
        copy._convs[number] = replace(op, **{key: getattr(op, key) + by})
        numbers = copy.weights if role == "weight" else copy.biases
        # Clipped numbers start at the end of int8, where the gradient is not 0.
        numbers[number].data.mul_(2.0**by).clamp_(INT8_MIN, INT8_MAX)
        return copy

    def activated(self, planes: Tensor) -> Tensor:
        """Compute what the host adds to the image, (N, C, H, W): the core's result, behind the
        host's activation if there is one.

        Args:
            planes: the int8 planes (N, P, H, W) of images, as float32.
        """
        result: Tensor = self(planes)
        activation = self._core.host_part.activation
        return ACTIVATIONS[activation](result) if activation else result

    def forward(self, planes: Tensor) -> Tensor:
        """Compute the core's result, (N, C, H, W) in real values, for the int8 planes (N, P, H, W)
        of images as float32. Gradients pass through all roundings; see `tensors`.
        """
        return self.tensors(planes)[CORRECTION] * self._core.scale(CORRECTION)

    def tensors(self, planes: Tensor) -> dict[str, Tensor]:
        """Compute every tensor of the core, in integers as float32.

        Args:
            planes: (N, P, H, W) float32 integers.

        Returns:
            Each tensor (N, C, H, W) by its name, in units of its scale. If the core writes several
            copies of the result, the tensor CORRECTION is computed once, and not rounded.
        """
        tensors = {PLANES: planes}
        parameters = iter(zip(self._convs, self.weights, self.biases, strict=True))
        for op in self._core.ops:
            inputs = [tensors[name] for name in op.inputs]
            if isinstance(op, IntConv):
                tensors[op.output] = self._convolved(*next(parameters), inputs[0])
            else:
                tensors[op.output] = _OPERATIONS[type(op)](op, inputs, self._core.frac_bits)
        return tensors

    def _convolved(self, op: IntConv, weight: Tensor, bias: Tensor, image: Tensor) -> Tensor:
        """Return a convolution's result from its parameters and its input."""
        decoding = self._core.host_part.decoding
        frac_bits = self._core.frac_bits[op.output]
        # Scaled parameters give sums in the result's unit, which saves a pass over the sums. The
        # factors are powers of two, so float32 stays exact.
        unit = 2.0 ** (frac_bits - op.accumulator_bits(self._core.frac_bits))
        bias_unit = 2.0 ** (frac_bits - op.bias_frac_bits)
        weight = to_int8(weight) * unit
        if op.output == CORRECTION and decoding.copies > 1:
            bias = bias if decoding.offsets else to_int8(bias)
            return _products(op, image, weight, bias * bias_unit)
        # The lift that makes ties round up costs nothing in the bias.
        bias = to_int8(bias) * bias_unit + _lift(op.activation) * unit
        return _rounded(_products(op, image, weight, bias), op.activation, frac_bits)


def _whole(values: Tensor) -> np.ndarray:
    """Return parameters as the int8 integers that they round to."""
    return to_int8(values.detach()).numpy().astype(np.int8)


def _products(op: IntConv, image: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return the sums of a convolution with zero padding, as floats that autograd can
    differentiate.
    """
    window = op.window
    top, left, bottom, right = window.pads
    # torch pads both sides alike; only the surplus of one side costs a copy of the image.
    within = min(top, bottom), min(left, right)
    around = left - within[1], right - within[1], top - within[0], bottom - within[0]
    if not op.transposed:
        image = functional.pad(image, around) if any(around) else image
        return functional.conv2d(
            image, weight, bias, window.strides, within, window.dilations, op.groups
        )
    # torch stores transposed weights as (I, O / groups, kh, kw).
    outputs, inner, *kernel = weight.shape
    weight = weight.reshape(op.groups, outputs // op.groups, inner, *kernel).transpose(1, 2)
    weight = weight.reshape(op.groups * inner, outputs // op.groups, *kernel)
    wide = functional.conv_transpose2d(
        image, weight, bias, window.strides, within, groups=op.groups
    )
    # Here padding crops the result.
    return wide[:, :, around[2] : wide.shape[2] - around[3], around[0] : wide.shape[3] - around[1]]


def _lift(activation: Activation = Activation.none) -> float:
    """Return the offset that is added to sums, in their unit: ties to even become ties up, and
    nothing else changes.

    It is smaller for LeakyReLU, which divides the unit by 128 and, by its slope, the offset by
    about ten.
    """
    # Sums are integers in their unit, so a shift of less than 1 moves only ties across a threshold.
    return 2.0**-5 if activation is Activation.leaky_relu else 2.0**-2


def _rounded(sums: Tensor, activation: Activation, frac_bits: int) -> Tensor:
    """Apply an activation to lifted sums, and round to int8."""
    if activation is Activation.leaky_relu:
        sums = functional.leaky_relu(sums, LEAKY_SLOPE)
    # ReLU and ReLU6 are limits of the same clip that int8 needs, so they cost no pass.
    low = 0 if activation in (Activation.relu, Activation.relu6) else INT8_MIN
    high = six_in_units(frac_bits) if activation is Activation.relu6 else INT8_MAX
    return to_int8(sums, low, high)


def _add(op: Add, inputs: Sequence[Tensor], bits: Bits) -> Tensor:
    """Add two tensors at the scale of the result."""
    frac_bits = bits[op.output]
    finest = max(bits[name] for name in op.inputs)
    terms = []
    for name, values in zip(op.inputs, inputs, strict=True):
        power = frac_bits - bits[name]
        # In a residual group of one scale the power is 0, and a product by 1 would be another pass.
        terms.append(values * 2.0**power if power else values)
    sums = terms[0] + terms[1]
    # A result as fine as its inputs has no ties to lift.
    if finest > frac_bits or op.activation is Activation.leaky_relu:
        sums = sums + _lift(op.activation) * 2.0 ** (frac_bits - finest)
    return _rounded(sums, op.activation, frac_bits)


def _mul(op: Mul, inputs: Sequence[Tensor], bits: Bits) -> Tensor:
    """Multiply two tensors; their fractional bits add up, and the product is rounded once."""
    unit = 2.0 ** (bits[op.output] - sum(bits[name] for name in op.inputs))
    return to_int8(inputs[0] * inputs[1] * unit + _lift() * unit)


def _max_pool(op: MaxPool, inputs: Sequence[Tensor], _: Bits) -> Tensor:
    """Return the largest value of each window, which is an integer already."""
    # No int8 value is below -128, so the padding never rises above one.
    wide = _padded(inputs[0], op.window, INT8_MIN)
    return functional.max_pool2d(wide, op.kernel, op.window.strides, 0, op.window.dilations)


def _average_pool(op: AveragePool, inputs: Sequence[Tensor], _: Bits) -> Tensor:
    """Return the mean of each window as the DPU computes it, padded zeros included."""
    assert op.kernel is not None  # noqa: S101 - resolved before anything is quantised
    # The DPU multiplies a window's sum by m / 2^s; torch's own divisor would give other results.
    factor, shift = mean_factor(op.kernel)
    wide = _padded(inputs[0], op.window)
    sums = functional.avg_pool2d(wide, op.kernel, op.window.strides, divisor_override=1)
    return to_int8((sums * factor + _lift()) * 2.0**-shift)


def _padded(image: Tensor, window: Window, fill: float = 0.0) -> Tensor:
    """Pad an image (N, C, H, W) by the pads of a window with one value."""
    if not any(window.pads):
        return image
    top, left, bottom, right = window.pads
    return functional.pad(image, (left, right, top, bottom), value=fill)


def _resize(op: Resize, inputs: Sequence[Tensor], _: Bits) -> Tensor:
    """Enlarge by repeating pixels, which is exact, or bilinearly, which is rounded."""
    image = inputs[0]
    if not op.bilinear:
        return functional.interpolate(image, scale_factor=op.factor, mode="nearest")
    wide = functional.interpolate(
        image, scale_factor=op.factor, mode="bilinear", align_corners=False
    )
    shift = bilinear_weights(op.factor)[1]
    return to_int8(wide + _lift() * 2.0**-shift)


def _shuffle(op: Shuffle, inputs: Sequence[Tensor], _: Bits) -> Tensor:
    """Move values as a pixel shuffle or its inverse does."""
    # The operation itself determines where each value moves; the gradient of gathering is the
    # inverse.
    count, *shape = inputs[0].shape
    order = np.asarray(op(np.arange(math.prod(shape)).reshape(1, *shape)))
    places = torch.from_numpy(order.ravel())
    return inputs[0].reshape(count, -1)[:, places].reshape(count, *order.shape[1:])


def _pointwise(op: Pointwise, inputs: Sequence[Tensor], bits: Bits) -> Tensor:
    """Return the values of its table, with the function's slope between neighbours."""
    units = np.arange(INT8_MIN, INT8_MAX + 1)
    smooth = op.activation(units * 2.0 ** -bits[op.input]) * 2.0 ** bits[op.output]
    image = inputs[0]
    places = (image.detach() - INT8_MIN).int()
    tables = activation_table(op, bits), np.gradient(smooth)
    result, slope = (torch.from_numpy(table.astype(np.float32))[places] for table in tables)
    # The difference is 0 forwards, and carries the slope backwards.
    return torch.addcmul(result, image - image.detach(), slope)


_OPERATIONS: Mapping[type, Callable[..., Tensor]] = {
    Add: _add,
    Mul: _mul,
    Concat: lambda _, inputs, __: torch.cat(list(inputs), dim=1),
    MaxPool: _max_pool,
    AveragePool: _average_pool,
    Resize: _resize,
    Shuffle: _shuffle,
    Pointwise: _pointwise,
}


def _one_copy(op: IntConv, host_part: HostPart) -> IntConv:
    """Return the first fine copy of a convolution that writes copies; any other unchanged."""
    if op.output != CORRECTION or host_part.decoding.copies == 1:
        return op
    first = host_part.outputs * host_part.decoding.gains.index(1)
    return replace(
        op,
        weight=op.weight[first : first + host_part.outputs],
        bias=op.bias[first : first + host_part.outputs],
    )


def _all_copies(
    last: IntConv, host_part: HostPart, weight: np.ndarray, bias: np.ndarray
) -> tuple[IntConv, HostPart]:
    """Change all copies of the result as the trained one changed, each in proportion to its gain.

    `last` and `host_part` are those before the training. `weight` (O, I, kh, kw) and `bias` (O,)
    are the integers of the trained copy. The bias of a window, in units of its scale and with the
    offset, changes the host's offsets instead.
    """
    one = _one_copy(last, host_part)
    decoding = host_part.decoding
    shares = 1 / np.array(decoding.gains)
    weights = _moved(last.weight, shares, weight.astype(float) - one.weight)
    if not decoding.offsets:
        biases = _moved(last.bias, shares, bias.astype(float) - one.bias)
        return replace(last, weight=weights, bias=biases), host_part
    # A window's bias stays: the host adds the change in float, which int8 would round.
    change = bias - _window_bias(one, decoding)
    errors = np.tile(change * 2.0**-one.bias_frac_bits, decoding.copies)
    host_part = replace(host_part, decoding=decoding.with_bias_errors(errors))
    coarse_shares = np.where(shares < 1, shares, 0)
    return replace(last, weight=weights, bias=_moved(last.bias, coarse_shares, change)), host_part


def _window_bias(one: IntConv, decoding: OutputDecoding) -> np.ndarray:
    """Return the sum of the biases of DPU and host for a result in windows, (O,) in units of the
    bias.
    """
    offset = np.array(decoding.offsets[0])
    return np.asarray(one.bias + offset * 2.0**one.bias_frac_bits, np.float32)


def _moved(copies: np.ndarray, shares: np.ndarray, move: np.ndarray) -> np.ndarray:
    """Move int8 copies, which lie one behind the other along the first axis, each by its share of
    the move of the copy that was trained.
    """
    moves = np.rint(np.multiply.outer(shares, move)).reshape(copies.shape)
    return np.asarray(np.clip(copies + moves, INT8_MIN, INT8_MAX), np.int8)
