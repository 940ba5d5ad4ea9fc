"""The integer core by itself in the board's spelling: QDQ ONNX with int8 bias and power-of-two scales.

This is what a VCK190 flow is handed. Input `planes` and output `correction` are float32 multiples of their scales;
splitting the image and adding the correction stay with the host.
"""

import numpy as np
import onnx
from onnx import helper, numpy_helper

from quant.core import IntConv, IntCore
from quant.graph import CORRECTION, Add
from quant.onnx_file import image_info, make_model
from quant.planes import COUNT, PLANES


def board_model(core: IntCore, about: dict[str, str], tile_px: int | None = None) -> onnx.ModelProto:
    """`planes` (N, 3, H, W) float32, as q * 2^-7, to `correction` (N, 1 or 2, H, W) float32.

    Two channels are two gains of the same correction: `quant.passes.dual_gain.merge` makes one of them.
    """
    writer = _Writer()
    writer.quantised("planes.dequantised", PLANES, core.positions[PLANES])
    for op in core.ops:
        inputs = ["planes.dequantised" if i == PLANES else i for i in op.inputs]
        output = f"{op.output}.float"
        if isinstance(op, Add):
            writer.nodes.append(helper.make_node("Add", inputs, [output], name=op.name))
        else:
            _conv(writer, op, inputs[0], output)
        writer.quantised(op.output, output, core.positions[op.output])
    ends = [image_info(PLANES, COUNT, tile_px)], [image_info(CORRECTION, core.output_channels, tile_px)]
    graph = helper.make_graph(writer.nodes, "convbeers-core", *ends, list(writer.weights.values()))
    return make_model(graph, about)


def _conv(w: "_Writer", op: IntConv, source: str, output: str) -> None:
    weight = w.dequantised(f"{op.name}.weight", op.weight, op.weight_position)
    bias = w.dequantised(f"{op.name}.bias", op.bias, op.bias_position)
    result = f"{op.output}.linear" if op.relu else output
    kernel = list(op.weight.shape[2:])
    feeds = [source, weight, bias]
    w.nodes.append(helper.make_node("Conv", feeds, [result], name=op.name, pads=[op.pad_px] * 4, kernel_shape=kernel))
    if op.relu:
        w.nodes.append(helper.make_node("Relu", [result], [output], name=f"{op.name}.relu"))


class _Writer:
    """Collects nodes and constants."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: dict[str, onnx.TensorProto] = {}

    def scale(self, position: int) -> list[str]:
        name = f"scale_2^{-position}"
        self.weights.setdefault(name, numpy_helper.from_array(np.array(2.0**-position, np.float32), name))
        self.weights.setdefault("zero_point", numpy_helper.from_array(np.array(0, np.int8), "zero_point"))
        return [name, "zero_point"]

    def quantised(self, output: str, source: str, position: int) -> None:
        """Quantise and dequantise an activation."""
        middle = f"{source}.int8"
        self.nodes.append(helper.make_node("QuantizeLinear", [source, *self.scale(position)], [middle], name=middle))
        self.nodes.append(
            helper.make_node("DequantizeLinear", [middle, *self.scale(position)], [output], name=f"{middle}.float")
        )

    def dequantised(self, name: str, value: np.ndarray, position: int) -> str:
        """An int8 constant seen as float."""
        self.weights[name] = numpy_helper.from_array(value, name)
        result = f"{name}.float"
        feeds = [name, *self.scale(position)]
        self.nodes.append(helper.make_node("DequantizeLinear", feeds, [result], name=result))
        return result
