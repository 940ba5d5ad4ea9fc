"""Write the host's file: the integer core on stock onnxruntime by integer kernels, from image to
restored image.

Every operation rounds once, ties to even, and adds exactly. Operations without an integer operator
in onnxruntime are expressed by others. Transposed convolution and bilinear enlargement become
convolutions and a pixel shuffle. Average pooling becomes a depthwise convolution, a separate
activation a table of 256 values, and LeakyReLU is computed on the convolution's sums.

The file describes its operations in its metadata, without weights and scales, which are in its
nodes. A file that is read back is written again, so that any differing node or constant is detected
as a fault.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from onnx import ModelProto, TensorProto, helper

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.core import IntConv, IntCore, op_shifts
from beers_deploy.quant.domains import MICROSOFT
from beers_deploy.quant.encodings.checksum import CHECKSUM, checksum, is_damaged
from beers_deploy.quant.encodings.description import KEY, describe, described_core, phases
from beers_deploy.quant.frac_bits import INT8_MAX, INT8_MIN
from beers_deploy.quant.graph import (
    CORRECTION,
    IMAGE,
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
    channels_of,
)
from beers_deploy.quant.graph.base import THE_IMAGE
from beers_deploy.quant.graph.writer import window_attributes, write_float, write_shuffle
from beers_deploy.quant.host_part import ZERO, HostWriter
from beers_deploy.quant.integer.arithmetic import (
    accumulator_bias,
    activation_table,
    bilinear_weights,
    mean_factor,
    six_in_units,
)
from beers_deploy.quant.onnx.image_input import fixed_tile_px, image_info
from beers_deploy.quant.onnx.messages import constants
from beers_deploy.quant.onnx_file import make_model, metadata
from beers_deploy.quant.untrusted import contradictions

LEGAL = "int8 legal"
"""The precision in the metadata of a file that `quantize` wrote."""


def host_model(core: IntCore, about: dict[str, str], tile_px: int | None = None) -> ModelProto:
    """Write the whole INT8 network as ONNX for stock onnxruntime: from the image to the restored
    image.

    Its input and output are those of the float network, (N, C, H, W) float32.

    Args:
        core: the integer core, with the host's part.
        about: metadata of the file, by key.
        tile_px: rows and columns of the one image that the file is fixed to; None for any size.
    """
    host_part = core.host_part
    writer = HostWriter()
    host_part.write_front(writer)
    for op in core.ops:
        _WRITERS[type(op)](writer, core, op)
    feeds = [CORRECTION, writer.unit(core.frac_bits[CORRECTION]), writer.zero_point()]
    host_part.write_back(writer, feeds, core.scale(CORRECTION))
    image, result = (
        image_info(name, host_part.image_channels, tile_px) for name in (IMAGE, "restored")
    )
    if not host_part.adds_image or host_part.last or host_part.base != THE_IMAGE:
        shuffles = (*host_part.back, *host_part.last)
        channels = host_part.outputs // math.prod(shuffle.block**2 for shuffle in shuffles)
        result = helper.make_tensor_value_info(
            "restored", TensorProto.FLOAT, ["N", channels, "rows", "columns"]
        )
    graph = writer.graph("convbeers-int8", [image], [result])
    model = make_model(graph, {**about, KEY: describe(core)}, microsoft=True)
    helper.set_model_props(model, {**metadata(model), CHECKSUM: checksum(model)})
    return model


def part_model(core: IntCore, start: int, stop: int) -> ModelProto:
    """Write a part of a core as an ONNX model for onnxruntime, without the host's part.

    Its inputs are the tensors that the part reads from in front of it, and its outputs those of its
    tensors that are read behind it. All are uint8 around 128.

    Args:
        core: the integer core.
        start: the place of the part's first operation.
        stop: the place behind the part's last operation.
    """
    writer = HostWriter()
    part = core.ops[start:stop]
    for op in part:
        _WRITERS[type(op)](writer, core, op)
    written = {op.output for op in part}
    names_read = dict.fromkeys(chain.from_iterable(op.inputs for op in part))
    read = [name for name in names_read if name not in written]
    returned = [name for name in live_tensors(core, stop) if name in written]
    inputs, outputs = (
        [
            helper.make_tensor_value_info(name, TensorProto.UINT8, ["N", None, None, None])
            for name in names
        ]
        for names in (read, returned)
    )
    return make_model(writer.graph("part", inputs, outputs), {}, microsoft=True)


def live_tensors(core: IntCore, at: int) -> list[str]:
    """Return the names of the tensors that are still needed at a place in a core.

    They were written in front of operation `at`, and it or a later operation reads them. Behind the
    last operation this is the result.

    Args:
        core: the integer core.
        at: the place of an operation, or the number of operations.
    """
    written = [PLANES, *(op.output for op in core.ops[:at])]
    reads = {CORRECTION, *chain.from_iterable(op.inputs for op in core.ops[at:])}
    return [name for name in written if name in reads]


def _conv(w: HostWriter, core: IntCore, op: IntConv) -> None:
    if op.transposed:
        _transposed(w, core, op)
    elif op.activation is Activation.leaky_relu:
        _leaky(w, core, op)
    else:
        _qlinear(w, core.frac_bits, op, _bias(core, op))


def _bias(core: IntCore, op: IntConv) -> np.ndarray:
    """Return the bias at the accumulator's scale, (O,) int32."""
    shift = op_shifts(op, core.frac_bits)["shift_bias"]
    return accumulator_bias(op, shift).astype(np.int32)


def _qlinear(w: HostWriter, frac_bits: Mapping[str, int], op: IntConv, bias: np.ndarray) -> None:
    feeds = [
        op.input,
        w.unit(frac_bits[op.input]),
        w.zero_point(),
        w.constant(f"{op.name}.weight", op.weight),
        w.unit(op.weight_frac_bits),
        _weight_zero(w, op.name),
        w.unit(frac_bits[op.output]),
        w.zero_point(),
        w.constant(f"{op.name}.bias", bias),
    ]
    w.node("QLinearConv", _unclamped(op), feeds, name=op.name, **_attributes(op))
    _clamp(w, frac_bits, op)


def _weight_zero(w: HostWriter, name: str) -> str:
    """Add a zero point for one weight tensor.

    Each weight needs its own: where onnxruntime rewrites weights (see quant.session), it fails on a
    shared one.
    """
    return w.constant(f"{name}.weight_zero_point", np.array(0, np.int8))


def _attributes(op: IntConv) -> dict[str, Any]:
    return {**window_attributes(op.window, op.groups), "kernel_shape": list(op.weight.shape[2:])}


def _unclamped(op: IntConv | Add) -> str:
    """Return the name of a result before its activation."""
    return op.output if op.activation is Activation.none else f"{op.output}.linear"


def _clamp(w: HostWriter, frac_bits: Mapping[str, int], op: IntConv | Add) -> None:
    """Write ReLU or ReLU6 on a rounded result, which they only clip."""
    if op.activation is Activation.none:
        return
    relu = op.output if op.activation is Activation.relu else f"{op.output}.above_0"
    w.node("Max", relu, [_unclamped(op), w.zero_point()], name=f"{op.name}.relu")
    if op.activation is Activation.relu6:
        units = ZERO + six_in_units(frac_bits[op.output])
        six = w.constant(f"{op.name}.six", np.array(units, np.uint8))
        w.node("Min", op.output, [relu, six], name=f"{op.name}.relu6")


def _leaky(w: HostWriter, core: IntCore, op: IntConv) -> None:
    """Write LeakyReLU as max(256 x, 26 x) of the int32 sums, exact in float64 and rounded once."""
    name = op.output
    feeds = [
        op.input,
        w.constant(f"{op.name}.weight", op.weight),
        w.zero_point(),
        _weight_zero(w, op.name),
    ]
    w.node("ConvInteger", f"{name}.products", feeds, name=op.name, **_attributes(op))
    bias = w.constant(f"{op.name}.bias", _bias(core, op)[:, None, None])
    w.node("Add", f"{name}.sums", [f"{name}.products", bias])
    # Float64 holds products of int32 sums and 26 exactly, so that Round is the only rounding.
    w.node("Cast", f"{name}.wide", [f"{name}.sums"], to=TensorProto.DOUBLE)
    unit = 2.0 ** -op_shifts(op, core.frac_bits)["shift_cut"]
    for kind, factor in {"whole": unit, "leaking": LEAKY_SLOPE * unit}.items():
        by = w.constant(f"{op.name}.{kind}", np.array(factor, np.float64))
        w.node("Mul", f"{name}.{kind}", [f"{name}.wide", by])
    w.node(
        "Max", f"{name}.linear", [f"{name}.whole", f"{name}.leaking"], name=f"{op.name}.leaky_relu"
    )
    w.node("Round", f"{name}.round", [f"{name}.linear"])
    limits = [w.constant(f"int8_{end}", np.array(end, np.float64)) for end in (INT8_MIN, INT8_MAX)]
    w.node("Clip", f"{name}.clip", [f"{name}.round", *limits])
    zero = w.constant("offset_64", np.array(ZERO, np.float64))
    w.node("Add", f"{name}.offset", [f"{name}.clip", zero])
    w.node("Cast", name, [f"{name}.offset"], to=TensorProto.UINT8)


def _transposed(w: HostWriter, core: IntCore, op: IntConv) -> None:
    """Write a transposed convolution: a convolution with one output per phase, a pixel shuffle, and
    a crop of the pads.
    """
    stride = op.window.strides[0]
    top, left, bottom, right = op.window.pads
    weight, reach = phases(op.weight, stride)
    phased = replace(
        op, output=f"{op.output}.phases", weight=weight, window=Window(pads=(reach,) * 4)
    )
    frac_bits = {**core.frac_bits, phased.output: core.frac_bits[op.output]}
    _qlinear(w, frac_bits, phased, np.tile(_bias(core, op), stride**2))
    shuffle = Shuffle(
        f"{op.name}.shuffle", phased.output, f"{op.output}.whole", stride, True, False
    )
    write_shuffle(w, shuffle, shuffle.input, shuffle.output)
    # The phases continue behind the last pixel: the rows and columns that the kernel does not reach
    # are cut as well.
    rows, columns = (stride * (reach + 1) - k for k in op.weight.shape[2:])
    ends = [-(bottom + rows), -(right + columns)]
    # A stop of 0 would mean the first pixel, not the last.
    stops = [end if end else np.iinfo(np.int64).max for end in ends]
    feeds = {"from": [top, left], "to": stops, "axes": [2, 3]}
    places = [
        w.constant(f"{op.name}.{name}", np.array(value, np.int64)) for name, value in feeds.items()
    ]
    w.node("Slice", op.output, [shuffle.output, *places], name=f"{op.name}.cut")


def _add(w: HostWriter, core: IntCore, op: Add | Mul) -> None:
    feeds = []
    for name in op.inputs:
        feeds += [name, w.unit(core.frac_bits[name]), w.zero_point()]
    feeds += [w.unit(core.frac_bits[op.output]), w.zero_point()]
    result = _unclamped(op) if isinstance(op, Add) else op.output
    w.node(f"QLinear{type(op).__name__}", result, feeds, name=op.name, domain=MICROSOFT)
    if isinstance(op, Add):
        _clamp(w, core.frac_bits, op)


def _average_pool(w: HostWriter, core: IntCore, op: AveragePool) -> None:
    assert op.kernel is not None  # noqa: S101 - resolved before anything is quantised
    factor, shift = mean_factor(op.kernel)
    weight = np.full((1, 1, *op.kernel), factor)
    _weighted(w, core, op, op.input, op.output, weight, shift, op.window)


def _weighted(
    w: HostWriter,
    core: IntCore,
    op: AveragePool | Resize,
    source: str,
    output: str,
    weight: np.ndarray,
    shift: int,
    window: Window,
) -> None:
    """Write a depthwise convolution with the weights (K, 1, kh, kw) for each channel.

    Its result has the scale of its input.
    """
    channels = channels_of(core.ops, {PLANES: core.host_part.planes})[op.input]
    unit = w.unit(core.frac_bits[op.input])
    weight = np.tile(weight.astype(np.int8), (channels, 1, 1, 1))
    feeds = [
        source,
        unit,
        w.zero_point(),
        w.constant(f"{op.name}.weight", weight),
        w.unit(shift),
    ]
    feeds += [_weight_zero(w, op.name), unit, w.zero_point()]
    attributes = {**window_attributes(window), "kernel_shape": list(weight.shape[2:])}
    w.node("QLinearConv", output, feeds, name=op.name, group=channels, **attributes)


def _resize(w: HostWriter, core: IntCore, op: Resize) -> None:
    if not op.bilinear:
        write_float(w, op, op.inputs, op.output)
        return
    weight, shift = bilinear_weights(op.factor)
    wide = f"{op.output}.edged"
    phased = f"{op.output}.phases"
    # Half-pixel centres read one pixel beyond the border, where ONNX's Resize repeats the edge.
    pads = w.constant("edge_pads", np.array([0, 0, 1, 1, 0, 0, 1, 1]))
    w.node("Pad", wide, [op.input, pads], mode="edge")
    _weighted(w, core, op, wide, phased, weight[:, None], shift, Window())
    write_shuffle(w, Shuffle(f"{op.name}.shuffle", phased, op.output, op.factor), phased, op.output)


def _pointwise(w: HostWriter, core: IntCore, op: Pointwise) -> None:
    values = (activation_table(op, core.frac_bits) + ZERO).astype(np.uint8)
    # Gather takes no 8-bit indices.
    place = w.node("Cast", f"{op.output}.place", [op.input], to=TensorProto.INT32)
    table = w.constant(f"{op.name}.table", values)
    w.node("Gather", op.output, [table, place], name=op.name)


_WRITERS: dict[type, Callable[..., Any]] = {
    IntConv: _conv,
    Add: _add,
    Mul: _add,
    **dict.fromkeys(
        (Concat, MaxPool, Shuffle), lambda w, _, op: write_float(w, op, op.inputs, op.output)
    ),
    AveragePool: _average_pool,
    Resize: _resize,
    Pointwise: _pointwise,
}


def read_core(model: ModelProto) -> IntCore:
    """Read the integer core of an INT8 file that `quantize` wrote for the host.

    Raises:
        ModelError: the file does not describe a core, or its description is damaged.
    """
    text = metadata(model).get(KEY)
    if text is not None:
        return described_core(text, constants(model))
    raise ModelError(
        "The network is float, or its file does not describe its integers, as INT8 files of "
        "'beers-deploy quantize' do. Give an INT8 file that this command wrote."
    )


def encoding_faults(model: ModelProto) -> list[str] | None:
    """List where an INT8 file differs from the integer core that its metadata describe.

    The file is written again from the description, and each node and constant must be the same.

    Returns:
        A text for each fault, such as "constant conv1.weight"; empty if there is none. None for a
        file that neither describes its integers nor states that `quantize` wrote it.
    """
    about = metadata(model)
    if KEY not in about and about.get("precision") != LEGAL:
        return None
    try:
        core = read_core(model)
    except ModelError as error:
        return [f"no integers to compare with: {error}"]
    with contradictions("the INT8 network"):
        expected = host_model(core, {}, fixed_tile_px(model)).graph
        faults = []
    for kind, parts, expected_parts in (
        ("constant", model.graph.initializer, expected.initializer),
        ("node", model.graph.node, expected.node),
    ):
        pairs = zip(parts, expected_parts, strict=False)
        faults += [f"{kind} {part.name}" for part, other in pairs if part != other]
        if len(parts) != len(expected_parts):
            faults.append(f"{len(parts)} {kind}s instead of {len(expected_parts)}")
    # Changed weights are encoded as correctly as those that were written.
    if not faults and is_damaged(model):
        faults.append("the checksum of the integers")
    return faults
