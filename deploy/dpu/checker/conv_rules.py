"""The DPU's rules for plain, depthwise and transposed convolutions, one function for each rule."""

import math
from operator import floordiv

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.checker.finding import Finding, beyond_range, groups_of, outside, shown
from beers_deploy.dpu.graph import Operation

# ruff: noqa: ARG001 - every rule takes the operation and the DPU


def conv_kernel(op: Operation, dpu: Dpu) -> Finding | None:
    """Kernel height and width are {conv[kernel]} ({conv[kernel].source})."""
    remedy = (
        "use a kernel of at most {most}, or stack small ones: two 3 x 3 see as far as one 5 x 5"
    )
    return beyond_range("kernel", op.kernel, dpu.limit("conv", "kernel"), remedy)


def conv_stride(op: Operation, dpu: Dpu) -> Finding | None:
    """Strides are {conv[stride]} ({conv[stride].source})."""
    remedy = "use a stride of at most {most}, or two convolutions whose strides multiply to it"
    return beyond_range("stride", op.window.strides, dpu.limit("conv", "stride"), remedy)


def conv_channels(op: Operation, dpu: Dpu) -> Finding | None:
    """Input and output channels are at most {limits[channels]} ({documents[operators]}, conv2d)."""
    return _channels(op, dpu)


def conv_padding(op: Operation, dpu: Dpu) -> Finding | None:
    """Padding on each side is 0 to (kernel - 1) * dilation ({documents[operators]}, conv2d)."""
    room = tuple((k - 1) * d for k, d in zip(op.kernel, op.window.dilations, strict=True))
    remedy = (
        "pad at most (kernel - 1) * dilation here and the rest with a Pad node of constant mode"
    )
    return _padding(op, room, f"{room * 2}, (kernel - 1) * dilation", remedy)


def _padding(op: Operation, room: tuple[int, ...], most: str, remedy: str) -> Finding | None:
    """Return a finding if a pad exceeds `room`, down and across; `most` names it in the reason."""
    # ONNX lists the pads of top and left first, then those of bottom and right.
    if all(0 <= pad <= limit for pad, limit in zip(op.window.pads, room * 2, strict=True)):
        return None
    return Finding(f"pads {op.window.pads} exceed {most}", remedy)


def conv_weight_bank(op: Operation, dpu: Dpu) -> Finding | None:
    """Weights fit the parameter buffer's depth of {memory[weight_bank_depth]}
    ({memory[weight_bank_depth].source}).

    The depth is kernel height * width * ceil(input channels / {array[input_channel_parallel]}) *
    ceil(output channels at a time / {memory[weight_banks]}) + {conv[weight_bias_depth]} for the
    bias.
    """
    inputs = groups_of(op.channels[0], dpu.input_parallel)
    outputs = groups_of(dpu.output_parallel, dpu.whole("memory", "weight_banks"))
    # The bias lies in the same buffer.
    depth = op.kernel_area * inputs * outputs + dpu.whole("conv", "weight_bias_depth")
    most = dpu.whole("memory", "weight_bank_depth")
    if depth <= most:
        return None
    remedy = (
        "use a smaller kernel or fewer input channels (a 1 x 1 convolution before it can "
        "reduce them)"
    )
    return Finding(
        f"weights are too large for the parameter buffer: depth {depth} of {most}", remedy
    )


def conv_window(op: Operation, dpu: Dpu) -> Finding | None:
    """Kernel area * ceil(ic / {conv[window_channels]}) is at most {conv[window_max]}
    ({conv[window_max].source}).
    """
    size = op.kernel_area * groups_of(op.channels[0], max(dpu.whole("conv", "window_channels"), 1))
    most = dpu.whole("conv", "window_max")
    if size <= most:
        return None
    return Finding(
        f"window of {size} exceeds {most}",
        f"keep kernel height * width within {most}, such as 8 x 8",
    )


def conv_area(op: Operation, dpu: Dpu) -> Finding | None:
    """The kernel's height * width is at most {conv[area_max]} ({conv[area_max].source})."""
    most = dpu.value("conv", "area_max")
    if op.kernel_area <= most:
        return None
    side = math.isqrt(max(int(most), 1))
    reason = f"kernel ({shown(op.kernel)}) has {op.kernel_area} positions: at most {int(most)}"
    return Finding(reason, f"use a kernel of at most {side} x {side}, or stack small ones")


def conv_dilation(op: Operation, dpu: Dpu) -> Finding | None:
    """Dilation * input channels is at most {limits[channels]} ({documents[operators]}, conv2d)."""
    dilation = max(op.window.dilations)
    channels = op.channels[0]
    most = dpu.channels_max
    # Without dilation this is the rule of channels, which `conv_channels` reports.
    if dilation == 1 or dilation * channels <= most:
        return None
    remedy = f"use a dilation of at most {most // channels}, or fewer input channels"
    return Finding(f"dilation {dilation} * {channels} input channels exceeds {most}", remedy)


def conv_groups(op: Operation, dpu: Dpu) -> Finding | None:
    """A convolution has one group, or as many as input channels: depthwise ({documents[operators]},
    conv2d).
    """
    if op.kind != "grouped conv":
        return None
    groups = op.attributes.get("group")
    remedy = (
        "use group = 1 with zeros where groups do not meet, or one convolution a group and a concat"
    )
    return Finding(f"{groups} groups for {op.channels[0]} input channels", remedy)


def depthwise_kernel(op: Operation, dpu: Dpu) -> Finding | None:
    """Kernel sides are {depthwise[kernel]} ({depthwise[kernel].source}).

    Their product is at most {depthwise[window_max]} ({depthwise[window_max].source}).
    """
    limit = dpu.limit("depthwise", "kernel")
    most = dpu.whole("depthwise", "window_max")
    if not outside(op.kernel, limit) and op.kernel_area <= most:
        return None
    reason = f"kernel ({shown(op.kernel)}) is not in the DPU's range {limit}, area at most {most}"
    return Finding(reason, "use a smaller kernel, or a k x 1 and a 1 x k depthwise convolution")


def depthwise_stride(op: Operation, dpu: Dpu) -> Finding | None:
    """Strides are {depthwise[stride]} ({depthwise[stride].source})."""
    remedy = "use a stride of at most {most}"
    return beyond_range("stride", op.window.strides, dpu.limit("depthwise", "stride"), remedy)


def depthwise_padding(op: Operation, dpu: Dpu) -> Finding | None:
    """Padding is {depthwise[pad_begin]} top and left, {depthwise[pad_end]} bottom and right.

    Those are the ALU's limits ({depthwise[pad_end].source}).
    """
    return alu_padding(op, dpu, "depthwise")


def depthwise_channels(op: Operation, dpu: Dpu) -> Finding | None:
    """Input and output channels are at most {limits[channels]} ({documents[operators]})."""
    return _channels(op, dpu)


def transposed_kernel(op: Operation, dpu: Dpu) -> Finding | None:
    """Kernel / stride, rounded down and up, is {transposed[kernel_per_stride]}
    ({documents[operators]}).
    """
    limit = dpu.limit("transposed", "kernel_per_stride")
    strides = op.window.strides
    ratios = (*map(floordiv, op.kernel, strides), *map(groups_of, op.kernel, strides))
    if not outside(ratios, limit):
        return None
    sides = f"kernel ({shown(op.kernel)}) / stride ({shown(strides)})"
    remedy = "use a kernel at least as large as the stride, such as 4 x 4 with stride 2"
    return Finding(f"{sides} is not in the DPU's range {limit}", remedy)


def transposed_output_padding(op: Operation, dpu: Dpu) -> Finding | None:
    """output_padding is {transposed[output_padding]} ({transposed[output_padding].source})."""
    padding = tuple(op.attributes.get("output_padding", (0, 0)))
    if max(padding) == dpu.whole("transposed", "output_padding"):
        return None
    reason = f"the DPU does not support output_padding {padding}"
    return Finding(
        reason, "use an even kernel, such as 4 x 4 with stride 2 and padding 1: it needs none"
    )


def transposed_padding(op: Operation, dpu: Dpu) -> Finding | None:
    """Padding on each side is 0 to the kernel's side ({documents[operators]},
    transposed-conv2d).
    """
    most = f"the kernel ({shown(op.kernel)})"
    return _padding(op, op.kernel, most, "pad less, and crop on the host")


def transposed_channels(op: Operation, dpu: Dpu) -> Finding | None:
    """Input and output channels are at most {limits[channels]} ({documents[operators]})."""
    return _channels(op, dpu)


def alu_padding(op: Operation, dpu: Dpu, table: str) -> Finding | None:
    """Check that the ALU engine can do the padding of a depthwise convolution or a pool.

    Args:
        op: the operation.
        dpu: the configuration of the DPU.
        table: the table of the board's constants that has pad_begin and pad_end.

    Returns:
        The finding if a pad is outside the range, else None.
    """
    # The ALU has a limit for top and left, which are the first two of ONNX, and one for the others.
    begin = dpu.limit(table, "pad_begin")
    end = dpu.limit(table, "pad_end")
    if not outside(op.window.pads[:2], begin) and not outside(op.window.pads[2:], end):
        return None
    reason = (
        f"pads {op.window.pads} are not in the DPU's range: top, left {begin}; bottom, right {end}"
    )
    return Finding(
        reason,
        f"pad at most {begin.high:g} at top and left, the rest with a Pad node of constant mode",
    )


def _channels(op: Operation, dpu: Dpu) -> Finding | None:
    most = dpu.channels_max
    if max(op.channels) <= most:
        return None
    reason = f"{op.channels[0]} input and {op.channels[1]} output channels: at most {most}"
    return Finding(reason, f"use at most {most} channels, in several convolutions if need be")
