"""Write the operations of a core in C: the constants of each layer, and the call
that computes it.
"""

from collections.abc import Callable, Mapping
from textwrap import fill
from typing import Any

import numpy as np

from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.rounding import up_to_multiple
from beers_deploy.quant.core import IntConv, IntCore, op_shifts
from beers_deploy.quant.graph import (
    Activation,
    Add,
    AveragePool,
    Concat,
    MaxPool,
    Mul,
    Op,
    Pointwise,
    Resize,
    Shuffle,
    Window,
)
from beers_deploy.quant.integer.arithmetic import (
    LEAKY_OF_256,
    accumulator_bias,
    activated,
    activation_table,
    bilinear_weights,
    bound_of,
    mean_factor,
    saturated,
)
from beers_deploy.quant.integer.reference import rounded
from beers_deploy.quant.untrusted import times

SUM_BITS = 30
"""Bits of the largest sum: int32 must also hold the half of a step that rounding adds."""
LANES = 16
CHANNELS = 4
"""The same values as in `kernels/convolve.c`."""

Shape = tuple[int, ...]
"""The number of channels, rows and columns."""


class LayerWriter:
    """Collects the C code of a core's operations: constants, and calls of the functions in
    `kernels/`.

    Attributes:
        constants: C definitions of constants, each behind a comment on its layer.
        calls: C statements, in order.
        kernels: the names of the C files in `kernels/` that are needed, each of which defines the
            function of that name.
        constant_bytes: the size of all weights, biases and tables.
        line_length: the number of values that the buffer `line` of `kernels/convolve.c` needs.
        weights_length: the number of values that the buffer `weights` there needs.
        number: the place of the operation that is being written. It ends the names of its
            constants, which are then unique.
    """

    def __init__(self, core: IntCore, shapes: Mapping[str, Shape]) -> None:
        """Start without any operation.

        Args:
            core: the integer core whose operations will be written.
            shapes: channels, rows and columns of each tensor by name, in the order of the C maps.
        """
        self.core = core
        self.shapes = shapes
        self.maps = {name: f"&map_{k}" for k, name in enumerate(shapes)}
        self.constants: list[str] = []
        self.calls: list[str] = []
        self.kernels = {"common", "window"}
        self.constant_bytes = 0
        self.line_length = 0
        self.weights_length = 0
        self.number = 0

    def write(self, number: int, op: IntConv | Op) -> None:
        """Write an operation in C: add its constants, and the call that computes it.

        Args:
            number: the place of the operation in the core, from 1 on.
            op: the operation.

        Raises:
            ModelError: sums that are too large for int32.
        """
        bits = self.core.frac_bits
        tensors = [
            f"{plain(name)} ({times(self.shapes[name])} in units of 2^{-bits[name]})"
            for name in (*op.inputs, op.output)
        ]
        shifts = "".join(f", {name} {value}" for name, value in op_shifts(op, bits).items())
        kind = type(op).__name__
        if isinstance(op, IntConv):
            rows, columns = op.weight.shape[2:]
            kind = f"{'transposed ' * op.transposed}convolution {rows} x {columns}"
        activation = getattr(op, "activation", Activation.none)
        if activation is not Activation.none:
            kind = f"{kind}, {activation.name}"
        self.calls.append(f"/* Layer {number}, {plain(op.name)} */")
        self.constants.append(
            comment(
                f"Layer {number}, {plain(op.name)}: {kind}{shifts}. "
                f"Reads {' and '.join(tensors[:-1])}, writes {tensors[-1]}."
            )
        )
        self.number = number
        _WRITERS[type(op)](self, op)

    def array(self, kind: type[np.int8 | np.int32], role: str, values: np.ndarray) -> str:
        """Add the definition of a constant array of a layer, and return its name.

        Args:
            kind: the type of the numbers.
            role: the use of the array, such as "weight", with which its name begins.
            values: integers of any shape, stored flat in C order.
        """
        name = f"{role}_{self.number}"
        self.constant_bytes += values.size * np.dtype(kind).itemsize
        numbers = fill(
            ", ".join(map(str, values.ravel().tolist())),
            100,
            initial_indent="    ",
            subsequent_indent="    ",
        )
        self.constants.append(
            f"static const {kind.__name__}_t {name}[{values.size}] = {{\n{numbers}\n}};"
        )
        return name

    def struct(self, kind: str, **fields: str | int) -> str:
        """Define a constant struct with the parameters of a layer.

        Args:
            kind: the struct's type, as a kernel declares it.
            fields: the initializer of each field in C.

        Returns:
            The C expression of a pointer to the struct.
        """
        lines = "".join(f"    .{key} = {value},\n" for key, value in fields.items())
        name = f"layer_{self.number}"
        self.constants.append(f"static const struct {kind} {name} = {{\n{lines}}};")
        return f"&{name}"

    def call(self, function: str, first: str | int, op: IntConv | Op) -> None:
        """Add the call of a C function for an operation, and mark the file of the function as
        needed.

        Args:
            function: the name of the function, which is also that of its file in `kernels/`.
            first: the C expression of the function's first argument. The maps of the inputs and of
                the output follow.
            op: the operation.
        """
        self.kernels.add(function)
        maps = [self.maps[name] for name in (*op.inputs, op.output)]
        self.calls.append(f"{function}({', '.join([str(first), *maps])});")

    def rounding(
        self,
        op: IntConv | Op,
        shift: int,
        bits: float,
        activation: Activation = Activation.none,
        frac_bits: int = 0,
    ) -> str:
        """Return the C initializer of the rounding that turns the sums of an operation into its
        result.

        Args:
            op: the operation, whose name an error states.
            shift: the right shift in bits from the scale of the sums to that of the result. A
                negative one shifts left.
            bits: the number of bits, without the sign, that no sum exceeds.
            activation: the activation that is applied to the sums.
            frac_bits: the number of fractional bits of the sums, in which limits of the activation
                are expressed; only ReLU6 needs it.

        Returns:
            The initializer of a `struct rounding` in C.

        Raises:
            ModelError: sums that are too large for int32.
        """
        leak = LEAKY_OF_256 if activation is Activation.leaky_relu else 0
        # Multiplying by the leak and shifting left enlarge a sum. Rounding adds 2^(shift - 1),
        # which must fit as well, however small the sums are.
        needed = max(bits + float(np.log2(max(leak, 1))) - min(shift, 0), shift)
        if needed > SUM_BITS:
            raise ModelError(
                f"The sums of {op.name} need {needed:.1f} bits, but the int32 of a C file holds "
                f"{SUM_BITS}. Use a network with smaller windows or fewer channels."
            )
        # ReLU and ReLU6 only clip. Rounding keeps the order of values, so clipping the result to
        # the rounded limits is the same as clipping the sum.
        sums, finer = activated(np.array([-1, 1]) << 40, activation, frac_bits)
        low, high = saturated(rounded(sums, shift + finer, half_even=False)[0])
        return f"{{.shift = {shift}, .low = {low}, .high = {high}, .leak = {leak}}}"


def plain(name: str) -> str:
    """Replace what could end a C comment in a name from a file, and return the text."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "._- ,:") else "_" for c in name)[:200]


def comment(*paragraphs: str) -> str:
    """Format paragraphs as one C comment.

    Args:
        paragraphs: texts that do not contain the end of a C comment. Each begins on a new line and
            is wrapped at 97 columns.
    """
    lines = [fill(each, 97, initial_indent=" * ", subsequent_indent=" * ") for each in paragraphs]
    return "/*" + "\n".join(lines)[2:] + " */"


def _axes(window: Window, kernel: tuple[int, ...]) -> dict[str, str]:
    """Return the fields `rows` and `columns` of a windowed layer.

    Args:
        window: strides, dilations and pads. C needs the pads at the top and on the left only,
            because the size of the result decides where the window stops.
        kernel: the number of taps in rows and columns.
    """
    sides = zip(kernel, window.strides, window.dilations, window.pads[:2], strict=True)
    rows, columns = (
        f"{{.taps = {taps}, .stride = {stride}, .dilation = {dilation}, .before = {before}}}"
        for taps, stride, dilation, before in sides
    )
    return {"rows": rows, "columns": columns}


def _conv(w: LayerWriter, op: IntConv) -> None:
    """Write a convolution, and make the buffers `line` and `weights` long enough for it."""
    window = op.window
    weight = op.weight
    spread = 1
    if op.transposed:
        # A transposed convolution is a convolution of an input with zeros in between, by rotated
        # weights. Its padding crops, so it is subtracted from the full padding.
        spread = window.strides[0]
        weight = weight[:, :, ::-1, ::-1]
        rows, columns = (side - 1 for side in weight.shape[2:])
        window = Window(pads=(rows - window.pads[0], columns - window.pads[1], 0, 0))
    shifts = op_shifts(op, w.core.frac_bits)
    # Sums start at the bias, so it must have their unit.
    bias = accumulator_bias(op, shifts["shift_bias"])
    layer = w.struct(
        "convolution",
        **_axes(window, weight.shape[2:]),
        groups=op.groups,
        spread=spread,
        # The kernel reads column by column, then rows, then channels, which lie side by side in a
        # map.
        weight=w.array(np.int8, "weight", weight.transpose(0, 3, 2, 1)),
        bias=w.array(np.int32, "bias", bias),
        rounding=w.rounding(
            op,
            shifts["shift_cut"],
            bound_of(op, bias),
            op.activation,
            op.accumulator_bits(w.core.frac_bits),
        ),
    )
    w.call("convolve", layer, op)
    outputs, inputs, rows, columns = weight.shape
    depth = rows * inputs
    # A run also has the columns between dilated taps, whose weights are zero. It is rounded up to
    # whole LANES, and the last pixel's run ends the line.
    run = up_to_multiple(((columns - 1) * window.dilations[1] + 1) * depth, LANES)
    line = (w.shapes[op.output][2] - 1) * window.strides[1] * depth + run
    w.line_length = max(w.line_length, line)
    # The kernel computes CHANNELS output channels at a time, so the weights of a group are padded.
    channels = up_to_multiple(outputs // op.groups, CHANNELS)
    w.weights_length = max(w.weights_length, channels * run)


def _add(w: LayerWriter, op: Add) -> None:
    """Write an addition: both inputs are shifted left to the finest scale and summed there."""
    bits = [w.core.frac_bits[name] for name in op.inputs]
    finest = max(bits)
    # At the finest scale no input loses a bit, so the result is rounded once.
    first, second = (1 << (finest - each) for each in bits)
    shift = finest - w.core.frac_bits[op.output]
    # An int8 value is at most 128 in size.
    largest = float(np.log2(128 * (first + second)))
    rounding = w.rounding(op, shift, largest, op.activation, finest)
    layer = w.struct("addition", first=first, second=second, rounding=rounding)
    w.call("add", layer, op)


def _mul(w: LayerWriter, op: Mul) -> None:
    """Write a product of two tensors, whose fractional bits add up."""
    shift = op_shifts(op, w.core.frac_bits)["shift_cut"]
    # The largest product is that of -128 and -128.
    rounding = w.rounding(op, shift, 14.0)
    name = f"layer_{w.number}"
    w.constants.append(f"static const struct rounding {name} = {rounding};")
    w.call("multiply", f"&{name}", op)


def _concat(w: LayerWriter, op: Concat) -> None:
    """Write a call for each input, which copies it behind the channels of the inputs before it."""
    w.kernels.add("concatenate")
    first = 0
    for name in op.inputs:
        w.calls.append(f"concatenate({first}, {w.maps[name]}, {w.maps[op.output]});")
        first += w.shapes[name][0]


def _max_pool(w: LayerWriter, op: MaxPool) -> None:
    """Write a maximum over windows, which needs no rounding."""
    layer = w.struct("max_pool", **_axes(op.window, op.kernel))
    w.call("pool_maxima", layer, op)


def _average_pool(w: LayerWriter, op: AveragePool) -> None:
    """Write a mean over windows as the window's sum times an integer factor and a right shift."""
    assert op.kernel is not None  # noqa: S101 - resolved before anything is quantised
    factor, shift = mean_factor(op.kernel)
    # The bound is that of a window full of -128.
    largest = float(np.log2(128 * factor * op.kernel[0] * op.kernel[1]))
    layer = w.struct(
        "average_pool",
        **_axes(op.window, op.kernel),
        factor=factor,
        rounding=w.rounding(op, shift, largest),
    )
    w.call("pool_means", layer, op)


def _resize(w: LayerWriter, op: Resize) -> None:
    """Write an enlargement, which repeats pixels or interpolates them by integer weights."""
    if not op.bilinear:
        w.call("repeat", op.factor, op)
        return
    weight, shift = bilinear_weights(op.factor)
    layer = w.struct(
        "interpolation",
        factor=op.factor,
        weight=w.array(np.int8, "weight", weight),
        # The weights of a place sum to 2^shift.
        rounding=w.rounding(op, shift, 7.0 + shift),
    )
    w.call("interpolate", layer, op)


def _shuffle(w: LayerWriter, op: Shuffle) -> None:
    """Write a pixel shuffle or its inverse, which moves values only."""
    layer = w.struct("shuffle", block=op.block, by_channel=int(op.columns_first))
    w.kernels.add("shuffle")
    w.call("to_pixels" if op.up else "to_channels", layer, op)


def _pointwise(w: LayerWriter, op: Pointwise) -> None:
    """Write an activation as a table of all 256 int8 values."""
    table = w.array(np.int8, "table", activation_table(op, w.core.frac_bits))
    w.call("look_up", table, op)


_WRITERS: dict[type, Callable[..., Any]] = {
    IntConv: _conv,
    Add: _add,
    Mul: _mul,
    Concat: _concat,
    MaxPool: _max_pool,
    AveragePool: _average_pool,
    Resize: _resize,
    Shuffle: _shuffle,
    Pointwise: _pointwise,
}
