"""Nodes rewritten as the equal ones that a DPU and a quantiser know, in place: what no runtime's
optimisation does.

Every rewriting is exact but for the rounding of float32, borders included. `quant.reading.folding`
calls it, and says what holds behind it.
"""

from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from math import prod

import numpy as np
import onnx
from onnx import NodeProto, TensorProto, helper

from beers_deploy.quant.reading.nodes import Nodes, Shapes, attributes_of, shapes_of

ARITHMETIC = {"Add", "Div", "Mul", "Sub"}
NORMALISATION = "BatchNormalization"
SHAPED = {"Cast", "Gemm", "ReduceMean", "Softmax"}
"""What may be rewritten where shapes are known."""


@dataclass(frozen=True)
class Affine:
    """scale * x + shift, each (C,) float64, or (1,) for all channels."""

    scale: np.ndarray
    shift: np.ndarray

    @property
    def channels(self) -> int:
        """How many numbers it has."""
        return max(len(self.scale), len(self.shift))


def rewrite(model: onnx.ModelProto) -> None:
    """Rewrite a float network's nodes; its inputs and outputs keep their names."""
    graph = Nodes(model.graph)
    for step in (_sum, _difference, _behind, _hard_swish):
        graph.pass_over(step)
    graph.write()
    if any(node.op_type in SHAPED or _affine(graph, node) for node in graph.nodes):
        shapes = shapes_of(model)
        _in_front(graph, shapes)
        for shaped in (_cast, _mean, _depthwise):
            graph.pass_over(partial(shaped, shapes))
        # A normalisation that has become a convolution takes in what stands around it.
        graph.pass_over(_behind)
        _in_front(graph, shapes)
        graph.pass_over(Unflatten(shapes))
        graph.write()


def _sum(_: Nodes, node: NodeProto) -> list[NodeProto] | None:
    """A Sum of several as Adds, one after the other."""
    if node.op_type != "Sum" or len(node.input) < 2:
        return None
    subtotal = node.input[0]
    adds = []
    for number, name in enumerate(node.input[1:], 1):
        is_last = number == len(node.input) - 1
        output = node.output[0] if is_last else f"{node.output[0]}.{number}"
        adds.append(
            helper.make_node(
                "Add", [subtotal, name], [output], name=node.name if is_last else output
            )
        )
        subtotal = output
    return adds


def _difference(graph: Nodes, node: NodeProto) -> list[NodeProto] | None:
    """What is subtracted is negated in the convolution that computes it, and added."""
    if node.op_type != "Sub":
        return None
    before = graph.sole_writer(node.input[1])
    if before is None or not graph.is_linear(before) or node.input[0] in graph.constants:
        return None
    _scale_results(graph, before, Affine(np.full(1, -1.0), np.zeros(1)))
    return [helper.make_node("Add", node.input, node.output, name=node.name)]


def _behind(graph: Nodes, node: NodeProto) -> list[NodeProto] | None:
    """What works on each channel by itself, folded into the convolution that it follows."""
    match = _affine(graph, node)
    if match is None:
        return None
    source, affine = match
    before = graph.sole_writer(source)
    if before is None or not graph.is_linear(before):
        return None
    if affine.channels not in (1, graph.width(before)):
        return None
    _scale_results(graph, before, affine)
    graph.rename(source, node.output[0])
    return []


def _affine(graph: Nodes, node: NodeProto) -> tuple[str, Affine] | None:
    """The tensor that a node works on and what it does to each channel, None where it does
    something else.
    """
    if node.op_type == NORMALISATION:
        return _normalisation(graph, node)
    if node.op_type not in ARITHMETIC:
        return None
    for place in (0, 1):
        value = per_channel(graph.value(node.input[1 - place]))
        if value is not None and node.input[place] not in graph.constants:
            affine = _arithmetic(node.op_type, value, place)
            return None if affine is None else (node.input[place], affine)
    return None


def _arithmetic(kind: str, value: np.ndarray, place: int) -> Affine | None:
    """What one constant a channel does to the operand at this place."""
    one = np.ones_like(value)
    zero = np.zeros_like(value)
    if kind == "Add":
        return Affine(one, value)
    if kind == "Mul":
        return Affine(value, zero)
    if kind == "Sub":
        return Affine(one, -value) if place == 0 else Affine(-one, value)
    return Affine(1 / value, zero) if place == 0 and value.all() else None


def _normalisation(graph: Nodes, node: NodeProto) -> tuple[str, Affine] | None:
    values = [graph.value(name) for name in node.input[1:5]]
    attributes = attributes_of(node)
    if (
        attributes.get("training_mode", 0)
        or len(node.output) > 1
        or any(value is None for value in values)
    ):
        return None
    gain, offset, mean, variance = values
    scale = gain / np.sqrt(variance + attributes.get("epsilon", 1e-5))
    return node.input[0], Affine(scale, offset - mean * scale)


def per_channel(value: np.ndarray | None) -> np.ndarray | None:
    """(C,) or (1,) of a constant that is one number a channel of (N, C, H, W),
    None of any other.
    """
    if value is None or value.ndim > 4:
        return None
    shape = (1,) * (4 - value.ndim) + value.shape
    return value.reshape(-1) if shape[0] == shape[2] == shape[3] == 1 else None


def _scale_results(graph: Nodes, node: NodeProto, affine: Affine) -> None:
    """Fold into a convolution what is done to its results; its weights may serve others too."""
    weight, bias = _numbers(graph, node)
    groups = attributes_of(node).get("group", 1)
    scale = np.broadcast_to(affine.scale, bias.shape)
    if node.op_type == "Conv":
        weight = weight * scale.reshape(-1, 1, 1, 1)
    else:
        # A transposed convolution has its weights as (I, O / groups, kh, kw): the results of a
        # group stand along the second axis.
        split = weight.reshape(groups, -1, *weight.shape[1:]) * scale.reshape(groups, 1, -1, 1, 1)
        weight = split.reshape(weight.shape)
    _set_numbers(graph, node, weight, bias * scale + affine.shift)


def _numbers(graph: Nodes, node: NodeProto) -> tuple[np.ndarray, np.ndarray]:
    """Weights and bias (O,) of a convolution."""
    weight = graph.value(node.input[1])
    bias = (
        graph.value(node.input[2])
        if len(node.input) > 2 and node.input[2]
        else np.zeros(graph.width(node))
    )
    if weight is None or bias is None:  # `is_linear` has seen to it
        raise ValueError(f"{node.name} without weights")
    return weight, bias


def _set_numbers(graph: Nodes, node: NodeProto, weight: np.ndarray, bias: np.ndarray) -> None:
    name = node.name or node.output[0]
    node.input[:] = [
        node.input[0],
        graph.keep(f"{name}.weight", weight),
        graph.keep(f"{name}.bias", bias),
    ]


def _hard_swish(graph: Nodes, node: NodeProto) -> list[NodeProto] | None:
    """A tensor times its own HardSigmoid, as the runtime and older exporters spell it."""
    if node.op_type != "Mul":
        return None
    for source, gate in (node.input, reversed(node.input)):
        before = graph.writers.get(gate)
        if before is None or before.op_type != "HardSigmoid" or before.input[0] != source:
            continue
        attributes = attributes_of(before)
        if np.allclose(
            (attributes.get("alpha", 0.2), attributes.get("beta", 0.5)), (1 / 6, 0.5), atol=1e-6
        ):
            return [helper.make_node("HardSwish", [source], node.output, name=node.name)]
    return None


def _cast(shapes: Shapes, graph: Nodes, node: NodeProto) -> list[NodeProto] | None:
    """What is float32 already; the runtime leaves such a cast where it writes a result."""
    before = (
        graph.sole_writer(node.input[0])
        if node.op_type == "Cast" and node.input[0] in shapes
        else None
    )
    if before is None or attributes_of(node)["to"] != TensorProto.FLOAT:
        return None
    graph.rename(node.input[0], node.output[0])
    return []


def _mean(shapes: Shapes, _: Nodes, node: NodeProto) -> list[NodeProto] | None:
    attributes = attributes_of(node)
    axes = {axis % 4 for axis in attributes.get("axes", [])}
    image = len(shapes.get(node.input[0], ())) == 4
    if node.op_type != "ReduceMean" or not image or axes != {2, 3}:
        return None
    pooled = node.output[0] if attributes.get("keepdims", 1) else f"{node.output[0]}.pooled"
    pool = helper.make_node("GlobalAveragePool", node.input, [pooled], name=node.name)
    if pooled == node.output[0]:
        return [pool]
    shapes[pooled] = (*shapes[node.input[0]][:2], 1, 1)
    return [pool, helper.make_node("Flatten", [pooled], node.output, name=f"{node.output[0]}.flat")]


def _in_front(graph: Nodes, shapes: Shapes) -> None:
    """What works on each channel by itself, folded into all the convolutions that read it, where
    that is exact.
    """
    readers = graph.readers()
    results = set(graph.ends)
    folded_ids = set[int]()
    for node in graph.nodes[::-1]:
        result = node.output[0]
        match = _affine(graph, node)
        behind = readers.get(result, [])
        if match is None or not behind or result in results:
            continue
        source, affine = match
        if not _keeps_channels(source, affine, shapes):
            continue
        if all(_may_scale_inputs(graph, reader, result, affine) for reader in behind):
            for reader in behind:
                _scale_inputs(graph, reader, affine)
                reader.input[0] = source
            # The map's readers change with each fold, and the loop goes on with what writes it.
            others = [reader for reader in readers[source] if reader is not node]
            readers[source] = others + behind
            folded_ids.add(id(node))
    graph.nodes = [node for node in graph.nodes if id(node) not in folded_ids]


def _keeps_channels(source: str, affine: Affine, shapes: Shapes) -> bool:
    """Whether each constant meets a channel of its own: one channel times many constants would be
    many.
    """
    return affine.channels == 1 or (
        len(shapes.get(source, ())) == 4 and shapes[source][1] == affine.channels
    )


def _may_scale_inputs(graph: Nodes, node: NodeProto, name: str, affine: Affine) -> bool:
    """Zeros that a convolution pads with are not shifted: a shift passes one
    without padding alone.
    """
    attributes = attributes_of(node)
    states_pads = attributes.get("auto_pad", "NOTSET") in ("NOTSET", "VALID")
    unpadded = node.op_type == "Conv" and states_pads and not any(attributes.get("pads", []))
    return (
        graph.is_linear(node)
        and list(node.input).count(name) == 1
        and (unpadded or not affine.shift.any())
    )


def _scale_inputs(graph: Nodes, node: NodeProto, affine: Affine) -> None:
    weight, bias = _numbers(graph, node)
    groups = attributes_of(node).get("group", 1)
    if node.op_type == "ConvTranspose":
        # Its weights begin with the inputs, and `_may_scale_inputs` lets no shift reach it.
        _set_numbers(graph, node, weight * affine.scale.reshape(-1, 1, 1, 1), bias)
        return
    split = weight.reshape(groups, -1, *weight.shape[1:])  # (G, O / G, I / G, kh, kw)
    scale, shift = (
        np.broadcast_to(v, groups * weight.shape[1]).reshape(groups, 1, -1, 1, 1)
        for v in (affine.scale, affine.shift)
    )
    offset = (split * shift).sum(axis=(2, 3, 4)).reshape(-1)
    _set_numbers(graph, node, (split * scale).reshape(weight.shape), bias + offset)


def _depthwise(shapes: Shapes, graph: Nodes, node: NodeProto) -> list[NodeProto] | None:
    """A normalisation of images that no convolution took in: a depthwise one of a single pixel."""
    # The normalisation in front may just have become a convolution, which takes this one in.
    replacement = _behind(graph, node)
    match = _affine(graph, node) if node.op_type == NORMALISATION else None
    if replacement is not None or match is None or len(shapes.get(node.input[0], ())) != 4:
        return replacement
    source, affine = match
    name = node.name or node.output[0]
    conv = helper.make_node("Conv", [source], node.output, name=name, kernel_shape=[1, 1])
    conv.attribute.append(helper.make_attribute("group", affine.channels))
    _set_numbers(graph, conv, affine.scale.reshape(-1, 1, 1, 1), affine.shift)
    return [conv]


POINTWISE = {"Clip", "Elu", "HardSigmoid", "HardSwish", "LeakyRelu", "Relu", "Sigmoid", "Tanh"}
Map = tuple[int, int, int]
"""Channels, height, width."""


class Unflatten:
    """A step of `Nodes.pass_over`, which remembers flat maps: fully connected layers as
    convolutions of whole maps.

    The flattening is left behind them. A Softmax over what is flat becomes one along the channels
    of one pixel.
    """

    def __init__(self, shapes: Shapes) -> None:
        self._shapes = shapes
        self._maps: dict[str, tuple[str, Map]] = {}

    def __call__(self, graph: Nodes, node: NodeProto) -> list[NodeProto] | None:
        """What stands for a node, None where it stays."""
        if self._flattens(graph, node):
            source = node.input[0]
            channels, height, width = self._shapes[source][1:]
            self._maps[node.output[0]] = source, (channels, height, width)
        flat_map = self._maps.get(node.input[0]) if node.input else None
        if flat_map is None or len(node.output) != 1:
            return None
        source, size = flat_map
        if node.op_type == "Gemm":
            return self._connected(graph, node, source, size)
        if (
            node.op_type == "Softmax"
            and size[1:] == (1, 1)
            and attributes_of(node).get("axis", -1) in (1, -1)
        ):
            return self._flat(
                helper.make_node("Softmax", [source], node.output, name=node.name, axis=1), size
            )
        if node.op_type in POINTWISE:
            image = deepcopy(node)
            image.input[0] = source
            return self._flat(image, size)
        is_private = (
            graph.reads[node.input[0]] == 1 and graph.reads[source] <= 1 and source in graph.writers
        )
        maps = [1, *size], [0, *size], [-1, *size]
        if is_private and node.op_type == "Reshape" and graph.integers(node.input[1]) in maps:
            # The Reshape makes the map again that was flattened, so both nodes go.
            graph.rename(source, node.output[0])
            return []
        return None

    def _flattens(self, graph: Nodes, node: NodeProto) -> bool:
        """Whether a node makes (N, C H W) of a map whose size is known."""
        sizes = self._shapes.get(node.input[0], ()) if node.input else ()
        if len(sizes) != 4 or min(sizes[1:]) < 1:
            return False
        if node.op_type == "Flatten":
            return attributes_of(node).get("axis", 1) in (1, -3)
        operand = graph.integers(node.input[1]) if len(node.input) == 2 else None
        if node.op_type == "Squeeze" and operand:
            return {axis % 4 for axis in operand} == {2, 3}
        if (
            node.op_type != "Reshape"
            or operand is None
            or len(operand) != 2
            or attributes_of(node).get("allowzero", 0)
        ):
            return False
        # In ONNX's Reshape a 0 copies the source's size and -1 stands for whatever is left.
        return operand[1] == prod(sizes[1:]) or (operand[1] == -1 and operand[0] in (0, sizes[0]))

    def _connected(
        self, graph: Nodes, node: NodeProto, source: str, size: Map
    ) -> list[NodeProto] | None:
        attributes = attributes_of(node)
        weight = graph.array(node.input[1])
        bias = graph.array(node.input[2]) if len(node.input) > 2 and node.input[2] else np.zeros(1)
        if weight is None or bias is None or weight.ndim != 2 or attributes.get("transA", 0):
            return None
        weight = (weight if attributes.get("transB", 0) else weight.T) * np.float32(
            attributes.get("alpha", 1.0)
        )
        if weight.shape[1] != prod(size) or bias.size not in (1, len(weight)):
            return None
        offset = np.broadcast_to(bias.reshape(-1) * attributes.get("beta", 1.0), len(weight))
        name = node.name or node.output[0]
        values = {"weight": weight.reshape(-1, *size), "bias": offset}
        numbers = [graph.keep(f"{name}.{role}", value) for role, value in values.items()]
        conv = helper.make_node(
            "Conv", [source, *numbers], node.output, name=name, kernel_shape=list(size[1:])
        )
        return self._flat(conv, (len(weight), 1, 1))

    def _flat(self, image: NodeProto, size: Map) -> list[NodeProto]:
        """A node that gives a map, and the map flat under the name of its result."""
        name = image.output[0]
        image.output[0] = f"{name}.map"
        self._maps[name] = image.output[0], size
        return [image, helper.make_node("Flatten", image.output, [name], name=f"{name}.flat")]
