"""The network as a short list of operations, convolutions and adds: what quantisation works on.

A float ONNX file from outside is looked at once, as it is read into that list; behind it nothing asks again. The
list is written back as float ONNX with every tensor an output: what calibration looks at. The 12-bit image enters
in planes: a coarse one, its remainder, and a third for finer weights.
"""

from dataclasses import dataclass, replace

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from model.io.images import MAX_DN
from profiles.errors import ModelError
from quant.onnx_file import GraphWriter, image_info, make_model
from quant.untrusted import contradictions

IMAGE, CORRECTION = "image", "correction"


@dataclass(frozen=True)
class Conv:
    """A 3 x 3-like convolution of stride 1 with zero padding, ReLU fused where one follows."""

    name: str
    input: str
    output: str
    weight: np.ndarray  # (O, I, kh, kw) float32
    bias: np.ndarray  # (O,) float32
    relu: bool = False

    @property
    def inputs(self) -> tuple[str, ...]:
        """The tensors it reads."""
        return (self.input,)

    @property
    def pad_px(self) -> int:
        """Zero padding on each side."""
        return int(self.weight.shape[2]) // 2


@dataclass(frozen=True)
class Add:
    """An element-wise sum of two tensors of the stream."""

    name: str
    inputs: tuple[str, str]
    output: str


Op = Conv | Add
Graph = tuple[Op, ...]


def tensors(graph: Graph) -> list[str]:
    """The names of all results, in order."""
    return [op.output for op in graph]


def relu_count(graph: Graph) -> int:
    """How many convolutions carry a ReLU: quantisers have been seen to drop them without a word."""
    return sum(isinstance(op, Conv) and op.relu for op in graph)


PLANES = "planes"
STEP = 32
COARSE_MAX = 127
QUARTER = 4
COUNT = 3
PLANES_FRAC_BITS = 7
"""The planes' scale is 2^-7: coarse 127 stands for about 1, the full scale."""


def split(image: np.ndarray) -> np.ndarray:
    """(N, 1, H, W) float32 in [0, 1] to the planes (N, 3, H, W) int8."""
    dn = np.clip(np.rint(image * np.float32(MAX_DN)), 0, MAX_DN)
    coarse = np.minimum(np.rint(dn / STEP), COARSE_MAX)
    remainder = dn - STEP * coarse
    return np.concatenate([coarse, remainder, np.rint(remainder / QUARTER)], axis=1).astype(np.int8)


def read_planes(graph: Graph) -> Graph:
    """The same graph with a first convolution that reads the planes (as q * 2^-7) instead of the image."""
    first = graph[0]
    assert isinstance(first, Conv)  # noqa: S101 - correction_graph has seen to it
    assert first.input == IMAGE  # noqa: S101
    unit = np.float32(2.0**PLANES_FRAC_BITS / MAX_DN)
    planes = [first.weight * (STEP * unit), first.weight * unit, np.zeros_like(first.weight)]
    weight = np.concatenate(planes, axis=1)
    return (replace(first, input=PLANES, weight=weight.astype(np.float32)), *graph[1:])


def coarse_plane_only(graph: Graph) -> Graph:
    """A plane-reading graph that does not look at the remainder: 7 bits of the image, to show what the others buy."""
    first = graph[0]
    assert isinstance(first, Conv)  # noqa: S101
    weight = first.weight.copy()
    weight[:, 1:] = 0
    return (replace(first, weight=weight), *graph[1:])


def check_graph(graph: Graph) -> None:
    """Refuse what cannot be quantised, before anything is computed.

    Raises:
        ModelError: ends other than convolutions of one channel, a tensor read that nobody wrote, widths that do not
            fit, or weights that are no numbers.
    """
    if not graph or not isinstance(graph[0], Conv) or graph[0].input != IMAGE or graph[0].weight.shape[1] != 1:
        raise refused_graph("a first convolution that reads an image of one channel", _kind(graph[:1]))
    if not isinstance(graph[-1], Conv) or graph[-1].output != CORRECTION or len(graph[-1].weight) != 1:
        raise refused_graph("a last convolution that writes a correction of one channel", _kind(graph[-1:]))
    widths = {IMAGE: 1}
    for op in graph:
        widths[op.output] = _conv_width(op, widths) if isinstance(op, Conv) else _add_width(op, widths)
    stream = {widths[name] for op in graph if isinstance(op, Add) for name in (*op.inputs, op.output)}
    if len(stream) > 1:
        raise refused_graph("adds of one width", f"widths {sorted(stream)}")


def _conv_width(op: Conv, widths: dict[str, int]) -> int:
    if _width(op, op.input, widths) != op.weight.shape[1]:
        raise refused_graph(f"{op.weight.shape[1]} channels for {op.name}", f"{widths[op.input]}")
    if not (np.isfinite(op.weight).all() and np.isfinite(op.bias).all()):
        raise refused_graph("finite weights", f"NaN or infinity in {op.name}")
    return len(op.weight)


def _add_width(op: Add, widths: dict[str, int]) -> int:
    left, right = (_width(op, name, widths) for name in op.inputs)
    if left != right:
        raise refused_graph(f"two tensors of one width for {op.name}", f"{left} and {right} channels")
    return left


def _width(op: Conv | Add, name: str, widths: dict[str, int]) -> int:
    if name not in widths:
        raise refused_graph(
            f"{op.name} behind what it reads, and a ReLU's convolution read behind the ReLU only", name
        )
    return widths[name]


def _kind(ops: Graph) -> str:
    if not ops:
        return "no operation"
    op = ops[0]
    return f"{op.name}, " + (f"a convolution of {op.weight.shape[:2]}" if isinstance(op, Conv) else "an add")


def refused_graph(expected: str, got: str) -> ModelError:
    """The sentence for a network that cannot be quantised."""
    remedy = "see docs/commands.md for what 'quantize' takes; other INT8 files can be checked and gated all the same"
    return ModelError("float model", expected=expected, got=got, remedy=remedy)


def correction_graph(model: onnx.ModelProto) -> Graph:
    """The operations from `image` to `correction`, in order, the global add taken off.

    Raises:
        ModelError: an operation of another kind, no global add at the end, or as `quant.graph` says.
    """
    with contradictions("float model"):
        graph = _correction_graph(model)
    check_graph(graph)
    return graph


def refusal(model: onnx.ModelProto) -> str:
    """Why a float network cannot be quantised, as a sentence; empty where it can."""
    try:
        correction_graph(model)
    except ModelError as error:
        return f"expected {error.expected}, got {error.got}"
    return ""


def _correction_graph(model: onnx.ModelProto) -> Graph:
    weights = {t.name: numpy_helper.to_array(t) for t in model.graph.initializer}
    image, restored = model.graph.input[0].name, model.graph.output[0].name
    ops: list[Op] = []
    for node in model.graph.node:
        if node.op_type == "Relu":
            _fuse_relu(ops, node)
        else:
            ops.append(_read(node, weights))
    last = ops.pop() if ops else None
    if not (isinstance(last, Add) and last.output == restored and image in last.inputs):
        raise refused_graph("a global add of the image at the end", last.name if last else "no node")
    correction = last.inputs[1 - last.inputs.index(image)]
    if any(image in op.inputs for op in ops[1:]):
        raise refused_graph("an image that only the first convolution and the global add read", "another reader")
    return tuple(_rename(op, {image: IMAGE, correction: CORRECTION}) for op in ops)


def _read(node: onnx.NodeProto, weights: dict[str, np.ndarray]) -> Op:
    name = node.name or node.output[0]
    if node.op_type == "Add" and not any(i in weights for i in node.input):
        return Add(name, (node.input[0], node.input[1]), node.output[0])
    if node.op_type == "Conv" and node.input[1] in weights and _is_plain(node, weights[node.input[1]]):
        weight = weights[node.input[1]].astype(np.float32)
        bias = weights[node.input[2]] if len(node.input) > 2 else np.zeros(len(weight))
        return Conv(name, node.input[0], node.output[0], weight, bias.astype(np.float32))
    raise refused_graph("only same-size convolutions of stride 1, ReLU and adds", f"{node.op_type} {name}")


def _is_plain(node: onnx.NodeProto, weight: np.ndarray) -> bool:
    given = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
    kernel = weight.shape[2]
    unit = all(set(given.get(key, [1])) == {1} for key in ("strides", "dilations")) and given.get("group", 1) == 1
    same = list(given.get("pads", [0] * 4)) == [kernel // 2] * 4 and kernel % 2 == 1 and kernel == weight.shape[3]
    return unit and same and given.get("auto_pad", b"NOTSET") == b"NOTSET"


def _fuse_relu(ops: list[Op], node: onnx.NodeProto) -> None:
    before = ops[-1] if ops else None
    if not isinstance(before, Conv) or before.output != node.input[0]:
        raise refused_graph("each ReLU right behind a convolution", f"ReLU {node.name}")
    ops[-1] = replace(before, output=node.output[0], relu=True)


def _rename(op: Op, names: dict[str, str]) -> Op:
    output = names.get(op.output, op.output)
    if isinstance(op, Conv):
        return replace(op, input=names.get(op.input, op.input), output=output)
    left, right = (names.get(i, i) for i in op.inputs)
    return replace(op, inputs=(left, right), output=output)


def graph_to_onnx(graph: Graph, outputs: list[str]) -> onnx.ModelProto:
    """The graph from `planes` (N, 3, H, W) float32 to the named tensors."""
    writer = GraphWriter()
    for op in graph:
        if isinstance(op, Add):
            writer.node("Add", op.output, op.inputs, op.name)
            continue
        feeds = [
            op.input,
            writer.constant(f"{op.name}.weight", op.weight),
            writer.constant(f"{op.name}.bias", op.bias),
        ]
        result = f"{op.output}.linear" if op.relu else op.output
        writer.node("Conv", result, feeds, op.name, pads=[op.pad_px] * 4)
        if op.relu:
            writer.node("Relu", op.output, [result], f"{op.name}.relu")
    results = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["N", "C", "H", "W"]) for n in outputs]
    return make_model(writer.graph("core", [image_info(PLANES, COUNT, None)], results), {})
