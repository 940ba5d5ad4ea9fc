"""The integer core as ONNX, in two encodings of the same numbers, and read back.

The host file runs on stock onnxruntime by integer kernels, from image to restored image. The board file is the core
by itself as QDQ ONNX, with int8 bias and power-of-two scales. Reading a host file back gives numbers to reason
about.
"""

import numpy as np
import onnx
from onnx import TensorProto, helper

from model.io.images import MAX_DN
from profiles.errors import ModelError
from quant.core import IntConv, IntCore
from quant.graph import COARSE_MAX, CORRECTION, COUNT, IMAGE, PLANES, QUARTER, STEP, Add
from quant.onnx_file import GraphWriter, constants, fixed_tile_px, image_info, make_model, metadata
from quant.passes.stream import FINE_MAX, GAIN
from quant.untrusted import contradictions

MICROSOFT = "com.microsoft"
ZERO = 128


def host_model(core: IntCore, about: dict[str, str], tile_px: int | None = None) -> onnx.ModelProto:
    """The whole INT8 network on stock onnxruntime, (N, 1, H, W) float32 in [0, 1] to the same."""
    writer = HostWriter()
    split_planes(writer)
    for op in core.ops:
        if isinstance(op, Add):
            _add(writer, core, op)
        else:
            _host_conv(writer, core, op)
    _merge(writer, core)
    ends = [image_info(IMAGE, 1, tile_px)], [image_info("restored", 1, tile_px)]
    return make_model(writer.graph("convbeers-int8", *ends), about, microsoft=True)


def split_planes(w: "HostWriter") -> None:
    """Write the host's nodes in front of the core, image to uint8 planes: `quant.graph.split` as operators."""
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


def _host_conv(w: "HostWriter", core: IntCore, op: IntConv) -> None:
    shift = op.weight_frac_bits + core.frac_bits[op.input] - op.bias_frac_bits
    bias = op.bias.astype(np.int32) << shift
    feeds = [op.input, w.unit(core.frac_bits[op.input]), w.zero_point()]
    feeds += [w.constant(f"{op.name}.weight", op.weight), w.unit(op.weight_frac_bits)]
    # One a weight: where onnxruntime rewrites weights (see quant.session), it trips over a shared one.
    feeds += [w.constant(f"{op.name}.weight_zero_point", np.array(0, np.int8))]
    feeds += [w.unit(core.frac_bits[op.output]), w.zero_point(), w.constant(f"{op.name}.bias", bias)]
    result = f"{op.output}.linear" if op.relu else op.output
    kernel = list(op.weight.shape[2:])
    w.node("QLinearConv", result, feeds, name=op.name, pads=[op.pad_px] * 4, kernel_shape=kernel)
    if op.relu:
        w.node("Max", op.output, [result, w.zero_point()], name=f"{op.name}.relu")


def _add(w: "HostWriter", core: IntCore, op: Add) -> None:
    feeds = []
    for name in (*op.inputs, op.output):
        quantity = [] if name == op.output else [name]
        feeds += [*quantity, w.unit(core.frac_bits[name]), w.zero_point()]
    w.node("QLinearAdd", op.output, feeds, name=op.name, domain=MICROSOFT)


def _merge(w: "HostWriter", core: IntCore) -> None:
    scale = w.unit(core.frac_bits[CORRECTION])
    if core.output_channels == 1:
        w.node("DequantizeLinear", "host_back.correction", [CORRECTION, scale, w.zero_point()])
    else:
        w.node("DequantizeLinear", "host_back.both", [CORRECTION, scale, w.zero_point()])
        merge_gains(w, core.scale(CORRECTION))
    w.node("Add", "host_back.add", [IMAGE, "host_back.correction"])
    w.node("Clip", "restored", ["host_back.add", w.scalar("zero", 0), w.scalar("one", 1)], name="host_back.clip")


def merge_gains(w: "HostWriter", scale: float) -> None:
    """Write the nodes that make one correction of two gains: `quant.passes.stream.merge` as operators."""
    one_each = w.constant("one_each", np.array([1, 1]))
    w.nodes.append(
        helper.make_node("Split", ["host_back.both", one_each], ["host_back.fine", "host_back.coarse"], axis=1)
    )
    w.nodes[-1].name = "host_back.split"
    w.node("Mul", "host_back.wide", ["host_back.coarse", w.scalar("gain", GAIN)])
    w.node("Abs", "host_back.size", ["host_back.fine"])
    w.node("LessOrEqual", "host_back.fits", ["host_back.size", w.scalar("fine_max", (FINE_MAX + 0.5) * scale)])
    w.node("Where", "host_back.correction", ["host_back.fits", "host_back.fine", "host_back.wide"])


class HostWriter(GraphWriter):
    """Writes the host's operators, each with its domain, and uint8 around 128."""

    domain = ""

    def scalar(self, name: str, value: float) -> str:
        """A float32 constant."""
        return self.constant(name, np.array(value, np.float32))

    def unit(self, frac_bits: int) -> str:
        """The constant 2^-frac_bits: one unit of a tensor."""
        return self.constant(f"scale_2^{-frac_bits}", np.array(2.0**-frac_bits, np.float32))

    def zero_point(self) -> str:
        """The constant 128, around which uint8 stands for int8."""
        return self.constant("zero_point", np.array(ZERO, np.uint8))


def board_model(core: IntCore, about: dict[str, str], tile_px: int | None = None) -> onnx.ModelProto:
    """`planes` (N, 3, H, W) float32, as q * 2^-7, to `correction` (N, 1 or 2, H, W) float32.

    Two channels are two gains of the same correction: `quant.passes.stream.merge` makes one of them.
    """
    writer = _BoardWriter()
    writer.quantised("planes.dequantised", PLANES, core.frac_bits[PLANES])
    for op in core.ops:
        inputs = ["planes.dequantised" if i == PLANES else i for i in op.inputs]
        output = f"{op.output}.float"
        if isinstance(op, Add):
            writer.node("Add", output, inputs, op.name)
        else:
            _board_conv(writer, op, inputs[0], output)
        writer.quantised(op.output, output, core.frac_bits[op.output])
    ends = [image_info(PLANES, COUNT, tile_px)], [image_info(CORRECTION, core.output_channels, tile_px)]
    return make_model(writer.graph("convbeers-core", *ends), about)


def _board_conv(w: "_BoardWriter", op: IntConv, source: str, output: str) -> None:
    weight = w.dequantised(f"{op.name}.weight", op.weight, op.weight_frac_bits)
    bias = w.dequantised(f"{op.name}.bias", op.bias, op.bias_frac_bits)
    result = f"{op.output}.linear" if op.relu else output
    kernel = list(op.weight.shape[2:])
    feeds = [source, weight, bias]
    w.node("Conv", result, feeds, op.name, kernel_shape=kernel, pads=[op.pad_px] * 4)
    if op.relu:
        w.node("Relu", output, [result], f"{op.name}.relu")


class _BoardWriter(GraphWriter):
    """Writes tensors as the board's flow reads them: quantised to int8, and seen as float again."""

    def scale(self, frac_bits: int) -> list[str]:
        name = self.constant(f"scale_2^{-frac_bits}", np.array(2.0**-frac_bits, np.float32))
        return [name, self.constant("zero_point", np.array(0, np.int8))]

    def quantised(self, output: str, source: str, frac_bits: int) -> None:
        """Quantise and dequantise an activation."""
        middle = self.node("QuantizeLinear", f"{source}.int8", [source, *self.scale(frac_bits)])
        self.node("DequantizeLinear", output, [middle, *self.scale(frac_bits)], f"{middle}.float")

    def dequantised(self, name: str, value: np.ndarray, frac_bits: int) -> str:
        """An int8 constant seen as float."""
        feeds = [self.constant(name, value), *self.scale(frac_bits)]
        return self.node("DequantizeLinear", f"{name}.float", feeds)


def read_core(model: onnx.ModelProto) -> IntCore:
    """The core of an INT8 file of the legal regime, its int32 bias at the accumulator's own scale.

    Raises:
        ModelError: another encoding, float scales, or asymmetric numbers.
    """
    reader = _Reader(model)
    for node in model.graph.node:
        if node.op_type == "QLinearConv":
            reader.conv(node)
        elif node.op_type == "QLinearAdd":
            reader.add(node)
        elif node.op_type == "Max":
            reader.relu(node)
    if not reader.ops or PLANES not in reader.frac_bits or CORRECTION not in reader.frac_bits:
        raise _refuse("no such core")
    return IntCore(tuple(reader.ops), reader.frac_bits)


def encoding_faults(model: onnx.ModelProto) -> list[str] | None:
    """Where a file of the legal regime is not what its integers ask for: the host's ends, ReLUs, a reader's scale.

    None for files of others.

    Raises:
        ModelError: nodes that contradict it.
    """
    with contradictions("INT8 model"):
        return _encoding_faults(model)


def _encoding_faults(model: onnx.ModelProto) -> list[str] | None:
    ours = metadata(model).get("precision") == "int8 legal"
    try:
        core = read_core(model)
    except ModelError as error:
        return [error.got] if ours else None
    meant, faults = host_model(core, {}, fixed_tile_px(model)).graph, []
    for kind, found, wanted in (
        ("constant", model.graph.initializer, meant.initializer),
        ("node", model.graph.node, meant.node),
    ):
        faults += [f"{kind} {a.name}" for a, b in zip(found, wanted, strict=False) if a != b]
        faults += [f"{len(found)} {kind}s instead of {len(wanted)}"] if len(found) != len(wanted) else []
    return faults


class _Reader:
    """Collects operations and scales."""

    def __init__(self, model: onnx.ModelProto) -> None:
        self._values = constants(model)
        self.ops: list[IntConv | Add] = []
        self.frac_bits: dict[str, int] = {}

    def conv(self, node: onnx.NodeProto) -> None:
        source, *_, bias = node.input
        weight, frac_bits = self._value(node.input[3]), self._frac_bits(node.input[4], node.input[5], 0)
        self.frac_bits[source] = self._frac_bits(node.input[1], node.input[2], ZERO)
        self.frac_bits[node.output[0]] = self._frac_bits(node.input[6], node.input[7], ZERO)
        whole, product = self._value(bias).astype(np.int64), frac_bits + self.frac_bits[source]
        self.ops.append(IntConv(node.name, source, node.output[0], weight, frac_bits, whole, product, False))

    def add(self, node: onnx.NodeProto) -> None:
        for name, scale, zero in ((node.input[0], 1, 2), (node.input[3], 4, 5), (node.output[0], 6, 7)):
            self.frac_bits[name] = self._frac_bits(node.input[scale], node.input[zero], ZERO)
        self.ops.append(Add(node.name, (node.input[0], node.input[3]), node.output[0]))

    def relu(self, node: onnx.NodeProto) -> None:
        """The larger of a value and the zero point; it becomes part of the convolution."""
        last = self.ops[-1] if self.ops else None
        if not isinstance(last, IntConv) or last.output != node.input[0]:
            return
        self.ops[-1] = IntConv(**{**vars(last), "output": node.output[0], "relu": True})
        self.frac_bits[node.output[0]] = self.frac_bits.pop(last.output)

    def _value(self, name: str) -> np.ndarray:
        if name not in self._values:
            raise _refuse(f"no constant {name}")
        return self._values[name]

    def _frac_bits(self, scale: str, zero: str, symmetric: int) -> int:
        """Of a power-of-two scale around the middle."""
        unit, middle = self._value(scale), self._value(zero)
        mantissa, exponent = np.frexp(unit.ravel()[:1].astype(np.float64))
        if unit.size != 1 or mantissa[0] != 0.5 or int(middle.ravel()[0]) != symmetric:
            raise _refuse(f"scale {float(unit.ravel()[0]):g}, zero point {int(middle.ravel()[0])}")
        return 1 - int(exponent[0])


def _refuse(got: str) -> ModelError:
    remedy = "make it with 'beers-deploy quantize --regime legal'"
    return ModelError("INT8 core", expected="power-of-two scales, symmetric, from planes", got=got, remedy=remedy)
