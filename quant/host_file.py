"""The integer core as ONNX for the host: integer kernels of onnxruntime, from image to restored image.

    image -> [scale to DN, split into planes] -> int8 core -> [dequantise, add to the image, clip] -> restored

The numbers are the board's, in the spelling that onnxruntime runs fastest on a CPU (14 times faster than signed
activations, 2.8 times faster than float32, measured at 8 x 32):

1. An activation q in [-128, 127] is stored as uint8 q + 128, zero point 128; weights stay int8.
2. The int8 bias becomes the int32 bias that the integer kernels take: bias << shift_bias is the same number.
3. ReLU is the larger of the value and the zero point.
"""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from quant.core import IntConv, IntCore
from quant.graph import CORRECTION, IMAGE, Add
from quant.onnx_file import image_info, make_model
from quant.passes.dual_gain import FINE_MAX, GAIN
from quant.planes import COARSE_MAX, MAX_DN, PLANES, QUARTER, STEP

MICROSOFT = "com.microsoft"
ZERO = 128


def host_model(core: IntCore, about: dict[str, str], tile_px: int | None = None) -> onnx.ModelProto:
    """The whole INT8 network on stock onnxruntime, (N, 1, H, W) float32 in [0, 1] to the same."""
    writer = _Writer()
    _split_planes(writer)
    for op in core.ops:
        if isinstance(op, Add):
            _add(writer, core, op)
        else:
            _conv(writer, core, op)
    _merge(writer, core)
    ends = [image_info(IMAGE, 1, tile_px)], [image_info("restored", 1, tile_px)]
    graph = helper.make_graph(writer.nodes, "convbeers-int8", *ends, list(writer.weights.values()))
    return make_model(graph, about, microsoft=True)


def _split_planes(w: "_Writer") -> None:
    """See quant.planes for the arithmetic."""
    w.node("Mul", "host_front.scale", [IMAGE, w.scalar("max_dn", MAX_DN)])
    w.node("Round", "host_front.round", ["host_front.scale"])
    w.node("Clip", "host_front.dn", ["host_front.round", w.scalar("zero", 0), w.scalar("max_dn", MAX_DN)])
    w.node("Mul", "host_front.steps", ["host_front.dn", w.scalar("one_step", 1 / STEP)])
    w.node("Round", "host_front.whole_steps", ["host_front.steps"])
    w.node("Min", "host_front.coarse", ["host_front.whole_steps", w.scalar("coarse_max", COARSE_MAX)])
    w.node("Mul", "host_front.coarse_dn", ["host_front.coarse", w.scalar("step", STEP)])
    w.node("Sub", "host_front.remainder", ["host_front.dn", "host_front.coarse_dn"])
    w.node("Mul", "host_front.quarters", ["host_front.remainder", w.scalar("one_quarter", 1 / QUARTER)])
    w.node("Round", "host_front.quarter", ["host_front.quarters"])
    planes = ["host_front.coarse", "host_front.remainder", "host_front.quarter"]
    w.node("Concat", "host_front.planes", planes, axis=1)
    w.node("Add", "host_front.offset", ["host_front.planes", w.scalar("offset", ZERO)])
    w.node("Cast", PLANES, ["host_front.offset"], to=TensorProto.UINT8)


def _conv(w: "_Writer", core: IntCore, op: IntConv) -> None:
    shift = op.weight_position + core.positions[op.input] - op.bias_position
    bias = op.bias.astype(np.int32) << shift
    feeds = [op.input, w.unit(core.positions[op.input]), w.zero_point()]
    feeds += [w.constant(f"{op.name}.weight", op.weight), w.unit(op.weight_position)]
    # One a weight: where onnxruntime rewrites weights (see quant.session), it trips over a shared one.
    feeds += [w.constant(f"{op.name}.weight_zero_point", np.array(0, np.int8))]
    feeds += [w.unit(core.positions[op.output]), w.zero_point(), w.constant(f"{op.name}.bias", bias)]
    result = f"{op.output}.linear" if op.relu else op.output
    kernel = list(op.weight.shape[2:])
    w.node("QLinearConv", result, feeds, name=op.name, pads=[op.pad_px] * 4, kernel_shape=kernel)
    if op.relu:
        w.node("Max", op.output, [result, w.zero_point()], name=f"{op.name}.relu")


def _add(w: "_Writer", core: IntCore, op: Add) -> None:
    feeds = []
    for name in (*op.inputs, op.output):
        quantity = [] if name == op.output else [name]
        feeds += [*quantity, w.unit(core.positions[name]), w.zero_point()]
    w.node("QLinearAdd", op.output, feeds, name=op.name, domain=MICROSOFT)


def _merge(w: "_Writer", core: IntCore) -> None:
    scale = w.unit(core.positions[CORRECTION])
    if core.output_channels == 1:
        w.node("DequantizeLinear", "host_back.correction", [CORRECTION, scale, w.zero_point()])
    else:
        w.node("DequantizeLinear", "host_back.both", [CORRECTION, scale, w.zero_point()])
        _merge_gains(w, core.scale(CORRECTION))
    w.node("Add", "host_back.add", [IMAGE, "host_back.correction"])
    w.node("Clip", "restored", ["host_back.add", w.scalar("zero", 0), w.scalar("one", 1)], name="host_back.clip")


def _merge_gains(w: "_Writer", scale: float) -> None:
    """See quant.passes.dual_gain.merge for the arithmetic."""
    halves = w.constant("one_each", np.array([1, 1]))
    w.nodes.append(
        helper.make_node("Split", ["host_back.both", halves], ["host_back.fine", "host_back.coarse"], axis=1)
    )
    w.nodes[-1].name = "host_back.split"
    w.node("Mul", "host_back.wide", ["host_back.coarse", w.scalar("gain", GAIN)])
    w.node("Abs", "host_back.size", ["host_back.fine"])
    w.node("LessOrEqual", "host_back.fits", ["host_back.size", w.scalar("fine_max", (FINE_MAX + 0.5) * scale)])
    w.node("Where", "host_back.correction", ["host_back.fits", "host_back.fine", "host_back.wide"])


class _Writer:
    """Collects nodes and constants; a constant of one name is written once."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: dict[str, onnx.TensorProto] = {}

    def node(
        self,
        kind: str,
        output: str,
        inputs: list[str],
        name: str = "",
        domain: str = "",
        **attributes: int | list[int],
    ) -> None:
        node = helper.make_node(kind, inputs, [output], name=name or output, domain=domain)
        node.attribute.extend(helper.make_attribute(key, value) for key, value in attributes.items())
        self.nodes.append(node)

    def constant(self, name: str, value: np.ndarray) -> str:
        self.weights.setdefault(name, numpy_helper.from_array(value, name))
        return name

    def scalar(self, name: str, value: float) -> str:
        return self.constant(name, np.array(value, np.float32))

    def unit(self, position: int) -> str:
        return self.constant(f"scale_2^{-position}", np.array(2.0**-position, np.float32))

    def zero_point(self) -> str:
        return self.constant("zero_point", np.array(ZERO, np.uint8))
