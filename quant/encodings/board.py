"""The board's file: the integer core by itself as QDQ ONNX, with int8 bias and power-of-two scales."""

import numpy as np
import onnx

from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.encodings.description import BORDER_PX, KEY, PLACE_PX, described_core
from beers_deploy.quant.ends import Ends
from beers_deploy.quant.graph import CORRECTION, PLANES, Conv, Op
from beers_deploy.quant.graph.writer import onnx_weight, write_float
from beers_deploy.quant.onnx_file import GraphWriter, constants, fixed_tile_px, image_info, make_model, metadata
from beers_deploy.quant.untrusted import contradictions


def board_model(core: IntCore, about: dict[str, str], tile_px: int | None = None) -> onnx.ModelProto:
    """`planes` (N, C, H, W) float32, as q * 2^-7, to `correction` (N, C', H', W') float32; `tile_px` is the image's.

    Where the host moves pixels into channels first, the file says of how many pixels a place of the planes is.

    The correction's channels come several times where it has gains or windows: `quant.ends.Ends.merge` makes one.
    """
    writer = BoardWriter()
    writer.quantised("planes.dequantised", PLANES, core.frac_bits[PLANES])
    for op in core.ops:
        feeds, output = ["planes.dequantised" if i == PLANES else i for i in op.inputs], f"{op.output}.float"
        writer.operation(op, feeds, output)
        writer.quantised(op.output, output, core.frac_bits[op.output])
    return core_file(writer, core.ends, about, tile_px)


def core_file(writer: GraphWriter, ends: Ends, about: dict[str, str], tile_px: int | None) -> onnx.ModelProto:
    """The model of what was written, from the planes that `ends` makes to the correction that it finishes."""
    read_px = tile_px and (tile_px + 2 * ends.border_px) // ends.place_px
    size = image_info(PLANES, ends.planes * ends.channels, read_px)
    result = image_info(CORRECTION, ends.copies * ends.outputs, tile_px and tile_px // ends.correction_px)
    if not ends.adds_image:  # of another size than the image, perhaps
        for side, name in zip(result.type.tensor_type.shape.dim[2:], ("rows", "columns"), strict=True):
            side.dim_param = name
    places = {PLACE_PX: str(ends.place_px)} if ends.place_px > 1 else {}
    places |= {BORDER_PX: str(ends.border_px)} if ends.border_px else {}
    said = {key: words for key, words in about.items() if key != KEY}  # it is the core itself
    return make_model(writer.graph("convbeers-core", [size], [result]), said | places)


def as_on_board(model: onnx.ModelProto) -> onnx.ModelProto:
    """A host's file whose core is described in it as the board gets it; any other model as it is.

    What the host spells with several operators, such as a transposed convolution, is one of the DPU's own.
    """
    if KEY not in metadata(model):
        return model
    with contradictions("INT8 model"):
        core = described_core(metadata(model)[KEY], constants(model))
        return board_model(core, {}, fixed_tile_px(model))


class BoardWriter(GraphWriter):
    """Writes tensors as the board's flow reads them: quantised to int8, and seen as float again."""

    def scale(self, tensor: str, frac_bits: int) -> list[str]:  # noqa: ARG002 - tensors of one scale share it here
        """Scale and zero point of a tensor."""
        return [self.unit(frac_bits), self.constant("zero_point", np.array(0, np.int8))]

    def quantised(self, output: str, source: str, frac_bits: int) -> None:
        """Quantise and dequantise an activation."""
        middle = self.node("QuantizeLinear", f"{source}.int8", [source, *self.scale(source, frac_bits)])
        self.node("DequantizeLinear", output, [middle, *self.scale(source, frac_bits)], f"{middle}.float")

    def operation(self, op: IntConv | Op, feeds: list[str], output: str) -> None:
        """Write an operation on tensors seen as float, a convolution's weights and bias as int8 seen so too."""
        if isinstance(op, IntConv):
            weight, kind = onnx_weight(op.weight, op.transposed), (op.activation, op.window, op.groups, op.transposed)
            numbers = {"weight": (weight, op.weight_frac_bits), "bias": (op.bias, op.bias_frac_bits)}
            feeds = [*feeds, *(self._dequantised(f"{op.name}.{role}", *each) for role, each in numbers.items())]
            op = Conv(op.name, op.input, op.output, op.weight, op.bias, *kind)
        write_float(self, op, feeds, output)

    def _dequantised(self, name: str, value: np.ndarray, frac_bits: int) -> str:
        feeds = [self.constant(name, value), *self.scale(name, frac_bits)]
        return self.node("DequantizeLinear", f"{name}.float", feeds)
