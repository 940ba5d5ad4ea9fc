"""Write the board's files: the integer core alone as QDQ ONNX, with int8 bias and power-of-two
scales; and VINT8.

HardSigmoid, HardSwish and means over windows whose size is no power of two are ONNX's own operators
in both files. The host's file has the DPU's approximations of them, so that results may differ by a
few steps.
"""

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from onnx import ModelProto, shape_inference

from beers_deploy.model.io.files import write_text
from beers_deploy.profiles.errors import OptionError
from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.encodings.description import BORDER_PX, KEY, PLACE_PX, described_core
from beers_deploy.quant.encodings.explicit import made_explicit
from beers_deploy.quant.graph import CORRECTION, PLANES, Activation, Add, Conv, Op, Pointwise
from beers_deploy.quant.graph.writer import onnx_weight, write_float
from beers_deploy.quant.host_part import HostPart
from beers_deploy.quant.onnx.image_input import fixed_tile_px, image_info
from beers_deploy.quant.onnx.messages import constants
from beers_deploy.quant.onnx_file import GraphWriter, make_model, metadata
from beers_deploy.quant.untrusted import contradictions


def board_model(core: IntCore, about: dict[str, str], tile_px: int | None = None) -> ModelProto:
    """Write a core alone as an ONNX model with QuantizeLinear and DequantizeLinear (QDQ), which
    board flows read.

    It reads the tensor `planes` (N, C, H, W) float32, multiples of 2^-7, and returns the tensor
    `correction` (N, C', H', W') float32. The channels of that come in the copies that
    `HostPart.decode` combines to one value. If the host rearranges pixels into channels first, the
    metadata record the number of pixels per place of the planes.

    Args:
        core: the integer core.
        about: metadata of the file, by key.
        tile_px: rows and columns of the image for which the file is fixed; None for any size.
    """
    writer = BoardWriter()
    writer.quantized("planes.dequantised", PLANES, core.frac_bits[PLANES])
    for op in core.ops:
        feeds = ["planes.dequantised" if i == PLANES else i for i in op.inputs]
        output = f"{op.output}.float"
        writer.operation(op, feeds, output)
        writer.quantized(op.output, output, core.frac_bits[op.output])
    return made_explicit(_core_file(writer, core.host_part, about, tile_px), TEXTS)


CORE_NAME = "convbeers-core"
TEXTS = {
    CORE_NAME: "The integer core of an INT8 network, as QDQ: each tensor, weight and bias is an "
    "int8 integer times a power of two. Ties round up on a DPU.",
    PLANES: "The image, encoded by the host as int8 planes times 2^-7: image, plane, row, column.",
    CORRECTION: "What the host decodes and adds to the image: image, copy, row, column.",
}


def _core_file(
    writer: GraphWriter, host_part: HostPart, about: dict[str, str], tile_px: int | None
) -> ModelProto:
    read_px = tile_px and (tile_px + 2 * host_part.border_px) // host_part.place_px
    size = image_info(PLANES, host_part.planes, read_px)
    written = host_part.decoding.copies * host_part.outputs
    factor = host_part.base.factor
    # The side of the square of pixels that one pixel of the core's result becomes.
    block_px = math.prod(shuffle.block for shuffle in host_part.back)
    written_px = tile_px and (tile_px * factor + 2 * host_part.crop_px) // block_px
    result = image_info(CORRECTION, written, written_px)
    # A result that the image itself is not added to may have another size.
    if factor > 1 or not host_part.adds_image:
        sides = result.type.tensor_type.shape.dim[2:]
        for side, name in zip(sides, ("rows", "columns"), strict=True):
            side.dim_param = name
    places = {PLACE_PX: str(host_part.place_px)} if host_part.place_px > 1 else {}
    places |= {BORDER_PX: str(host_part.border_px)} if host_part.border_px else {}
    # This file is the core itself, so it needs no description of one.
    entries = {key: words for key, words in about.items() if key != KEY}
    return make_model(writer.graph(CORE_NAME, [size], [result]), entries | places)


def as_on_board(model: ModelProto) -> ModelProto:
    """Return an INT8 file that was written for onnxruntime in the board's encoding of the same
    integers.

    The checker reads networks this way, because operators for which onnxruntime needs several
    nodes, such as a transposed convolution, are then single operators.

    Args:
        model: a model. One that does not describe its integers is returned unchanged.
    """
    if KEY not in metadata(model):
        return model
    with contradictions("the INT8 network"):
        core = described_core(metadata(model)[KEY], constants(model))
        return board_model(core, {}, fixed_tile_px(model))


class BoardWriter(GraphWriter):
    """A graph under construction for the board's file, in which each tensor is quantised to int8,
    then dequantised.
    """

    def scale(self, tensor: str, frac_bits: int) -> list[str]:  # noqa: ARG002 - tensors of one scale share it here
        """Add the scale 2^-frac_bits and the zero point 0 of a tensor to the file.

        Args:
            tensor: name of the tensor. In this encoding tensors of equal scale share a constant;
                the encoding for AMD's NPU (VINT8) writes one for each tensor.
            frac_bits: its number of fractional bits.

        Returns:
            The names of the two constants: [scale, zero point].
        """
        return [self.unit(frac_bits), self.constant("zero_point", np.array(0, np.int8))]

    def quantized(self, output: str, source: str, frac_bits: int) -> None:
        """Write the nodes that quantise an activation to int8 and dequantise it again.

        Args:
            output: the name of the dequantised tensor.
            source: the name of the tensor in float.
            frac_bits: the number of fractional bits of its scale.
        """
        middle = self.node(
            "QuantizeLinear", f"{source}.int8", [source, *self.scale(source, frac_bits)]
        )
        self.node(
            "DequantizeLinear", output, [middle, *self.scale(source, frac_bits)], f"{middle}.float"
        )

    def operation(self, op: IntConv | Op, feeds: list[str], output: str) -> None:
        """Write an operation that reads and writes dequantised tensors.

        A convolution's weights and bias are stored as int8, with a DequantizeLinear behind each.

        Args:
            op: the operation.
            feeds: the names of the dequantised tensors that it reads.
            output: the name of its result in float, before it is quantised.
        """
        if isinstance(op, IntConv):
            weight = onnx_weight(op.weight, op.transposed)
            numbers = {
                "weight": (weight, op.weight_frac_bits),
                "bias": (op.bias, op.bias_frac_bits),
            }
            feeds = list(feeds)
            for role, (value, frac_bits) in numbers.items():
                name = f"{op.name}.{role}"
                integers = [self.constant(name, value), *self.scale(name, frac_bits)]
                feeds.append(self.node("DequantizeLinear", f"{name}.float", integers))
            op = Conv(
                op.name,
                op.input,
                op.output,
                op.weight,
                op.bias,
                activation=op.activation,
                window=op.window,
                groups=op.groups,
                transposed=op.transposed,
            )
        write_float(self, op, feeds, output)


CONFIG = "vitisai_config.json"
"""The file that AMD's compiler reads in addition to the network."""
CLAMPS = (Activation.relu, Activation.relu6)


def vint8_model(core: IntCore, about: dict[str, str], tile_px: int | None) -> ModelProto:
    """Write a core as VINT8, the INT8 file that AMD's current flow for its NPU compiles.

    It has the integers of the board's file in another layout, for an image of one size, with every
    size stated. Each reader of a tensor has its own pair of QuantizeLinear and DequantizeLinear,
    and each tensor its own scale and zero point.

    A pair also separates an operation from its clamp (ReLU or ReLU6), as AMD's quantiser writes it.
    No bit changes, because a value on the grid of the result may be clamped before or after
    rounding. LeakyReLU is not a clamp: it follows the sums directly, as the core computes it.

    Args:
        core: the integer core.
        about: metadata of the file, by key.
        tile_px: rows and columns of the image for which the file is fixed.

    Raises:
        OptionError: `tile_px` is None.
    """
    side_px = required_tile(tile_px, OF_NPU)
    frac_bits = dict(core.frac_bits)
    parts: list[IntConv | Op] = []
    for op in core.ops:
        part = op
        if isinstance(op, IntConv | Add) and op.activation in CLAMPS:
            # An operation and its clamp share the scale of the result, so that no bit changes.
            inner = f"{op.output}.linear"
            frac_bits[inner] = frac_bits[op.output]
            parts.append(replace(op, output=inner, activation=Activation.none))
            part = Pointwise(f"{op.name}.{op.activation.name}", inner, op.output, op.activation)
        parts.append(part)
    writer = _PairWriter(frac_bits)
    for op in parts:
        writer.operation(op, [writer.read(name) for name in op.inputs], writer.source(op.output))
    writer.read(CORRECTION, CORRECTION)
    model = _core_file(writer, core.host_part, about, side_px)
    # The compiler of an NPU requires that sizes are stated, also those of inner tensors.
    return shape_inference.infer_shapes(model, strict_mode=True)


OF_NPU = "an NPU, because its compiler accepts fixed sizes only"


def required_tile(tile_px: int | None, use: str) -> int:
    """Return the side of a tile in pixels, or raise OptionError if the user gave none.

    Args:
        tile_px: the side, or None.
        use: the use that needs a tile of fixed size, for the message.
    """
    if tile_px is None:
        raise OptionError(f"`tile` must be given for {use}. Give a side in pixels, such as 640.")
    return tile_px


class _PairWriter(BoardWriter):
    """Writes each tensor once in float, and once as int8 for each of its readers."""

    def __init__(self, frac_bits: dict[str, int]) -> None:
        super().__init__()
        self._frac_bits = frac_bits
        self._readers = Counter[str]()

    def scale(self, tensor: str, frac_bits: int) -> list[str]:
        """Return scale and zero point of a tensor, which no other tensor shares."""
        # AMD's quantiser adjusts a scale in place, which would move all tensors that share it.
        scale = self.constant(f"{tensor}.scale", np.array(2.0**-frac_bits, np.float32))
        return [scale, self.constant(f"{tensor}.zero_point", np.array(0, np.int8))]

    def source(self, tensor: str) -> str:
        """Return the name of a tensor in float, before it is rounded."""
        return tensor if tensor == PLANES else f"{tensor}.float"

    def read(self, tensor: str, name: str = "") -> str:
        """Add a Q/DQ pair for one more reader of a tensor, and return the name that it reads."""
        self._readers[tensor] += 1
        reader = f"{tensor}.{self._readers[tensor]}"
        numbers = self.scale(tensor, self._frac_bits[tensor])
        middle = self.node("QuantizeLinear", f"{reader}.int8", [self.source(tensor), *numbers])
        return self.node("DequantizeLinear", name or reader, [middle, *numbers])


def save_config(core: Path, device: str) -> Path:
    """Write the configuration that AMD's compiler reads next to a VINT8 file, and return its path.

    Args:
        core: the path of the VINT8 file, in whose folder the configuration is written.
        device: the name of the device in AMD's words. All other settings are the same for every
            network.
    """
    settings = {"device": device, "optimize_level": 2}
    passes = [
        {"name": "init", "plugin": "vaip-pass_init"},
        {
            "name": "vaiml_partition",
            "plugin": "vaip-pass_vaiml_partition",
            "vaiml_config": settings,
        },
    ]
    target = {"name": "VAIML", "pass": ["init", "vaiml_partition"]}
    config = {"passes": passes, "target": "VAIML", "targets": [target]}
    write_text(core.with_name(CONFIG), json.dumps(config, indent=1) + "\n")
    return core.with_name(CONFIG)
