"""A float ONNX network as the short list of operations, and what stays on the host around it.

A file from outside is looked at once, here; behind it nothing asks again.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import onnx
from onnx import helper

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.graph.network import (
    Network,
    channels_of,
    check_network,
    cut,
    named_apart,
    refused_graph,
    renamed,
    sized,
)
from beers_deploy.quant.graph.operations import (
    CORRECTION,
    IMAGE,
    LEAKY_SLOPE,
    Activation,
    Add,
    AveragePool,
    Concat,
    Conv,
    Graph,
    MaxPool,
    Mul,
    Op,
    Pair,
    Pointwise,
    Resize,
    Shuffle,
    Window,
    is_plain,
)
from beers_deploy.quant.graph.tail import without_tail
from beers_deploy.quant.graph.trials import MOVES, makes_blocks, spelled_shuffle
from beers_deploy.quant.onnx_file import constants
from beers_deploy.quant.untrusted import contradictions, times


def read_network(model: onnx.ModelProto) -> Network:
    """The operations of a float network that has been simplified (`quant.reading`)."""
    with contradictions("float model"):
        body, tail = without_tail(model, {*READERS, *ACTIVATIONS})
        reader = _Reader(body)
        network = replace(cut(reader.sized_graph(), _channels_in(model), reader.flat, reader.softmax), tail=tail)
        check_network(network)
    return network


def plain_network(model: onnx.ModelProto) -> Network:
    """A network of ConvBEERS' kind: what proofs, the stress battery, bit flips and the free regime take.

    It adds a correction to an image of one channel, and computes it by same-size convolutions of stride 1, ReLU and
    adds; at full resolution, or at a lower one, with the image's pixels rearranged into channels and back.
    """
    network = read_network(model)
    blocks = [[shuffle.block for shuffle in end] for end in (network.front, network.back)]
    same_ends = network == Network(network.graph, front=network.front, back=network.back)
    if not (same_ends and blocks[0] == blocks[1] and len(blocks[0]) <= 1):
        raise refused_graph("an image of one channel, and a global add of it at the end", "another network")
    for op in network.graph:
        if not (isinstance(op, Conv | Add) and is_plain(op)):
            raise refused_graph("only same-size convolutions of stride 1, ReLU and adds", op.name)
    return network


def correction_graph(model: onnx.ModelProto) -> Graph:
    """Its operations, from `image` (N, S^2, H / S, W / S) to `correction` of the same shape."""
    return plain_network(model).graph


def image_channels(graph: Graph) -> int:
    """Channels of the image as such operations read it: S^2, the pixels of a place."""
    return next(int(op.weight.shape[1]) for op in graph if isinstance(op, Conv) and op.input == IMAGE)


def refusal(model: onnx.ModelProto) -> str:
    """Why a float network cannot be quantised, as a sentence; empty where it can."""
    try:
        read_network(model)
    except ModelError as error:
        return f"expected {error.expected}, got {error.got}"
    return ""


def _channels_in(model: onnx.ModelProto) -> int:
    sizes = model.graph.input[0].type.tensor_type.shape.dim
    if len(sizes) != 4:
        raise refused_graph("an input of (N, C, H, W)", f"{len(sizes)} sizes")
    return int(sizes[1].dim_value) or 1


@dataclass(frozen=True)
class _Node:
    """An ONNX node: what it reads and writes, and its attributes by name."""

    proto: onnx.NodeProto
    op_type: str
    name: str
    input: list[str]
    output: list[str]
    given: dict[str, Any]

    @classmethod
    def of(cls, proto: onnx.NodeProto) -> "_Node":
        given = {a.name: helper.get_attribute_value(a) for a in proto.attribute}
        name = proto.name or proto.output[0]
        return cls(proto, proto.op_type, name, list(proto.input), list(proto.output), given)


class _Reader:
    """Walks the nodes once; a tensor that is another's by a new name is known by the first."""

    def __init__(self, model: onnx.ModelProto) -> None:
        self.model, self.values = model, constants(model)
        self.image = model.graph.input[0].name
        self.ops: list[Op] = []
        self.readers: dict[str, int] = {value.name: 1 for value in model.graph.output}
        for node in model.graph.node:
            for name in node.input:
                self.readers[name] = self.readers.get(name, 0) + 1
        self.flat = self.softmax = False
        # Chains of moves by the tensor that they have come to; and which tensors another move goes on from.
        self.chains: dict[str, list[_Node]] = {}
        self.moving = {node.input[0]: True for node in model.graph.node if node.op_type in MOVES}

    def graph(self) -> tuple[Op, ...]:
        """The operations, from the network's own input to its own output."""
        if len(self.model.graph.output) != 1:
            got = ", ".join(value.name for value in self.model.graph.output)
            raise refused_graph("one output", f"{len(self.model.graph.output)}: {got}", "export it with one of them")
        for node in self.model.graph.node:
            if node.op_type != "Constant":
                self._read(node)
        if not self.ops or self.ops[-1].output != self.model.graph.output[0].name:
            raise refused_graph("an operation that writes the output", "none")
        return named_apart(self.ops, {self.image: IMAGE, self.ops[-1].output: CORRECTION})

    def sized_graph(self) -> tuple[Op, ...]:
        """As `graph`, the windows of global pooling known: a network that pools so has one size of image."""
        graph = self.graph()
        pools = [op for op in graph if isinstance(op, AveragePool) and op.kernel is None]
        rows, columns = (side.dim_value for side in self.model.graph.input[0].type.tensor_type.shape.dim[2:])
        if pools and not (rows and columns):
            remedy = "export it with fixed height and width: what pools over the whole image has one size"
            raise refused_graph("images of one size", f"any size, and global pooling at {pools[0].name}", remedy)
        return sized(graph, (rows, columns)) if pools else graph

    def _read(self, proto: onnx.NodeProto) -> None:
        node = _Node.of(proto)
        if node.op_type in ACTIVATIONS:
            self._activation(node)
            return
        if node.op_type not in READERS:
            remedy = "replace it by one that the DPU computes, or cut the network in front of it"
            if node.op_type == "Pad":
                remedy = (
                    "pad in the convolution; a network behind a bank is quantised from its weights (.safetensors)"
                )
            raise refused_graph("operations that a DPU computes", f"{node.op_type} {node.name}", remedy)
        op = READERS[node.op_type](self, node)
        if op is not None:
            self.ops.append(op)

    def _require(self, sound: bool, node: _Node, expected: str, got: str) -> None:
        if not sound:
            raise refused_graph(expected, f"{got} at {node.op_type} {node.name}")

    def _constant(self, node: _Node, place: int) -> np.ndarray | None:
        return self.values.get(node.input[place]) if place < len(node.input) else None

    def _weights(self, node: _Node) -> tuple[np.ndarray, np.ndarray | None]:
        weight = self._constant(node, 1)
        if weight is None:
            raise refused_graph("weights that are constants", f"computed ones at {node.op_type} {node.name}")
        return weight.astype(np.float32), self._constant(node, 2)

    def _conv(self, node: _Node) -> Op:
        weight, bias = self._weights(node)
        self._require(weight.ndim == 4, node, "convolutions over rows and columns", f"weights of {weight.ndim} sizes")
        groups = int(node.given.get("group", 1))
        depthwise = groups == len(weight) and weight.shape[1] == 1
        self._require(groups == 1 or depthwise, node, "one group, or one a channel (depthwise)", f"{groups} groups")
        bias = np.zeros(len(weight)) if bias is None else bias
        window = self._window(node, (weight.shape[2], weight.shape[3]))
        return Conv(
            node.name, node.input[0], node.output[0], weight, bias.astype(np.float32), window=window, groups=groups
        )

    def _convtranspose(self, node: _Node) -> Op:
        weight, bias = self._weights(node)
        given, strides = node.given, node.given.get("strides", [1, 1])
        plain = int(given.get("group", 1)) == 1 and not any(given.get("output_padding", [0]))
        self._require(plain, node, "transposed convolutions of one group, without output padding", "another")
        even = set(given.get("dilations", [1])) == {1} and len(set(strides)) == 1 and "output_shape" not in given
        self._require(even, node, "transposed convolutions of one stride, undilated, sized by it", f"{list(strides)}")
        self._require(given.get("auto_pad", b"NOTSET") == b"NOTSET", node, "stated pads", "auto_pad")
        weight = np.ascontiguousarray(weight.swapaxes(0, 1))
        bias = np.zeros(len(weight)) if bias is None else bias
        window = self._window(node, (weight.shape[2], weight.shape[3]))
        kind = {"window": window, "transposed": True}
        return Conv(node.name, node.input[0], node.output[0], weight, bias.astype(np.float32), **kind)  # type: ignore[arg-type]

    def _window(self, node: _Node, kernel: Pair) -> Window:
        strides, dilations = _pair(node.given.get("strides", [1, 1])), _pair(node.given.get("dilations", [1, 1]))
        auto = node.given.get("auto_pad", b"NOTSET").decode()
        pads = node.given.get("pads", [0, 0, 0, 0])
        if auto.startswith("SAME"):
            self._require(strides == (1, 1), node, "stated pads", f"auto_pad {auto} with strides")
            extents = [(k - 1) * d for k, d in zip(kernel, dilations, strict=True)]
            less, more = [e // 2 for e in extents], [e - e // 2 for e in extents]
            pads = [*less, *more] if auto == "SAME_UPPER" else [*more, *less]
        return Window(strides, (int(pads[0]), int(pads[1]), int(pads[2]), int(pads[3])), dilations)

    def _flatten(self, node: _Node) -> None:
        """At the end, where what is flat is (N, K): inside it stays (N, K, 1, 1)."""
        ends = node.output[0] == self.model.graph.output[0].name and bool(self.ops) and node.given.get("axis", 1) == 1
        self._require(ends and self.ops[-1].output == node.input[0], node, "Flatten at the end alone", "another")
        self.ops[-1] = renamed(self.ops[-1], {node.input[0]: node.output[0]})
        self.flat = True

    def _softmax(self, node: _Node) -> None:
        """Along the channels, at the end, where the host does it."""
        rest = [_Node.of(proto) for proto in self.model.graph.node if node.output[0] in proto.input]
        ends = node.output[0] == self.model.graph.output[0].name
        flattened = [each.op_type for each in rest] == ["Flatten"]
        last = bool(self.ops) and self.ops[-1].output == node.input[0] and self.readers[node.input[0]] == 1
        channels = node.given.get("axis", -1) in (1, -3)
        self._require(
            (ends or flattened) and last and channels, node, "Softmax of channels at the end alone", "another"
        )
        self.ops[-1] = renamed(self.ops[-1], {node.input[0]: node.output[0]})
        self.softmax = True

    def _add_or_mul(self, node: _Node) -> Op:
        kind = Add if node.op_type == "Add" else Mul
        return self._by_constant(node) or kind(node.name, (node.input[0], node.input[1]), node.output[0])

    def _sub(self, node: _Node) -> Op | None:
        """Of a constant; what a convolution wrote is added since the file was folded (`quant.reading`)."""
        op = self._by_constant(node)
        expected = "a difference whose second tensor a convolution writes, for it alone"
        self._require(op is not None, node, expected, "another")
        return op

    def _by_constant(self, node: _Node) -> Op | None:
        """A sum, difference or product with one number a channel: a depthwise convolution of one pixel."""
        found = [k for k in (0, 1) if self._constant(node, k) is not None]
        if not found:
            return None
        value = self.values[node.input[found[0]]].astype(np.float32)
        shape = (1,) * (4 - value.ndim) + value.shape  # as ONNX aligns it with (N, C, H, W)
        own = value.ndim <= 4 and shape[0] == shape[2] == shape[3] == 1 and found != [0, 1]
        self._require(own, node, "a constant of one number a channel", f"one of {times(value.shape)}")
        value = value.ravel()
        self._require(node.op_type != "Sub" or found == [1], node, "a constant that is taken off", "another")
        channels = self._width(node.input[1 - found[0]])
        self._require(len(value) in (1, channels), node, f"{channels} numbers", f"{len(value)}")
        value = np.broadcast_to(value, (channels,))
        one, none = np.ones(channels, np.float32), np.zeros(channels, np.float32)
        factor, offset = {"Add": (one, value), "Sub": (one, -value), "Mul": (value, none)}[node.op_type]
        weight = factor[:, None, None, None]
        return Conv(
            node.name, node.input[1 - found[0]], node.output[0], weight, offset.astype(np.float32), groups=channels
        )

    def _width(self, name: str) -> int:
        return channels_of(tuple(self.ops), {self.image: _channels_in(self.model)})[name]

    def _concat(self, node: _Node) -> Op:
        self._require(
            node.given.get("axis") in (1, -3), node, "concat along the channels", f"axis {node.given.get('axis')}"
        )
        self._require(not any(i in self.values for i in node.input), node, "computed tensors", "a constant")
        return Concat(node.name, tuple(node.input), node.output[0])

    def _maxpool(self, node: _Node) -> Op:
        kernel = _pair(node.given["kernel_shape"])
        plain = len(node.output) == 1 and not node.given.get("ceil_mode", 0)
        self._require(plain, node, "max pooling without indices or ceil_mode", "another")
        return MaxPool(node.name, node.input[0], node.output[0], kernel, self._window(node, kernel))

    def _averagepool(self, node: _Node) -> Op:
        kernel = _pair(node.given["kernel_shape"])
        window = self._window(node, kernel)
        zeros = bool(node.given.get("count_include_pad", 0)) or not any(window.pads)
        self._require(
            zeros and not node.given.get("ceil_mode", 0), node, "average pooling that counts padding", "another"
        )
        return AveragePool(node.name, node.input[0], node.output[0], kernel, window)

    def _globalaveragepool(self, node: _Node) -> Op:
        return AveragePool(node.name, node.input[0], node.output[0], None)

    def _resize(self, node: _Node) -> Op:
        scales = self._constant(node, 2)
        sound = scales is not None and scales.size == 4 and (scales[:2] == 1).all() and scales[2] == scales[3]
        self._require(bool(sound), node, "a resize by a constant factor of rows and columns", "another")
        assert scales is not None  # noqa: S101
        factor, mode = float(scales[2]), node.given.get("mode", b"nearest").decode()
        self._require(factor == int(factor) >= 1, node, "a whole factor", f"{factor:g}")
        where = node.given.get("coordinate_transformation_mode", b"half_pixel").decode()
        if mode == "linear":
            half = where in ("half_pixel", "pytorch_half_pixel") and factor in (2, 4)
            self._require(half, node, "bilinear by 2 or 4 with half-pixel centres", f"{where} by {factor:g}")
        else:
            rounding = node.given.get("nearest_mode", b"round_prefer_floor").decode()
            blocks = mode == "nearest" and makes_blocks(int(factor), where, rounding)
            expected = "a nearest resize that makes a block of each pixel"
            self._require(blocks, node, expected, f"{mode}, {where}, {rounding} by {factor:g}")
        return Resize(node.name, node.input[0], node.output[0], int(factor), mode == "linear")

    def _shuffle(self, node: _Node) -> Op:
        up, columns_first = node.op_type == "DepthToSpace", node.given.get("mode", b"DCR") == b"CRD"
        return Shuffle(node.name, node.input[0], node.output[0], int(node.given["blocksize"]), up, columns_first)

    def _move(self, node: _Node) -> Op | None:
        """Reshape and Transpose as exporters spell pixel shuffles: followed to the last of them, then tried out."""
        chain = [*self.chains.pop(node.input[0], []), node]
        if self.moving.get(node.output[0]):
            self._require(
                self.readers[node.output[0]] == 1, node, "a pixel shuffle that is read at its end", "another"
            )
            self.chains[node.output[0]] = chain
            return None
        protos, channels = [each.proto for each in chain], self._width(chain[0].input[0])
        found = spelled_shuffle(protos, node.name, channels, self.model)
        self._require(found is not None, chain[0], "Reshape and Transpose that spell a pixel shuffle", "another")
        return found

    def _activation(self, node: _Node) -> None:
        activation = self._which(node)
        writer = next((k for k, op in enumerate(self.ops) if op.output == node.input[0]), None)
        before = self.ops[writer] if writer is not None else None
        fusible = isinstance(before, Conv) or (isinstance(before, Add) and activation is Activation.relu)
        free = getattr(before, "activation", None) is Activation.none and self.readers[node.input[0]] == 1
        # The host computes LeakyReLU on a convolution's own sums, which a transposed one has in phases.
        phased = isinstance(before, Conv) and before.transposed and activation is Activation.leaky_relu
        if activation.fused and fusible and free and not phased and writer is not None:
            assert isinstance(before, Conv | Add)  # noqa: S101
            self.ops[writer] = replace(before, output=node.output[0], activation=activation)
        else:
            self.ops.append(Pointwise(node.name, node.input[0], node.output[0], activation))

    def _which(self, node: _Node) -> Activation:
        activation = ACTIVATIONS[node.op_type]
        if node.op_type == "LeakyRelu":
            slope = float(node.given.get("alpha", 0.01))
            self._require(slope == np.float32(LEAKY_SLOPE), node, "a slope of 26/256 (0.1015625)", f"{slope:g}")
        if node.op_type == "Clip":
            low, high = (self._constant(node, k) for k in (1, 2))
            six = low is not None and high is not None and float(low) == 0 and float(high) == 6
            self._require(six, node, "a clip from 0 to 6 (ReLU6)", "another")
        if node.op_type == "HardSigmoid":
            plain = np.isclose(node.given.get("alpha", 0.2), 1 / 6, 1e-4) and node.given.get("beta", 0.5) == 0.5
            self._require(bool(plain), node, "HardSigmoid with alpha 1/6", f"{node.given.get('alpha', 0.2):g}")
        return activation


READERS: dict[str, Callable[[_Reader, _Node], Op | None]] = {
    "Add": _Reader._add_or_mul,
    "AveragePool": _Reader._averagepool,
    "Concat": _Reader._concat,
    "Conv": _Reader._conv,
    "ConvTranspose": _Reader._convtranspose,
    "DepthToSpace": _Reader._shuffle,
    "Flatten": _Reader._flatten,
    "GlobalAveragePool": _Reader._globalaveragepool,
    "MaxPool": _Reader._maxpool,
    "Mul": _Reader._add_or_mul,
    "Resize": _Reader._resize,
    "Softmax": _Reader._softmax,
    "SpaceToDepth": _Reader._shuffle,
    "Sub": _Reader._sub,
    **dict.fromkeys(MOVES, _Reader._move),
}

ACTIVATIONS = {
    "Relu": Activation.relu,
    "Clip": Activation.relu6,
    "LeakyRelu": Activation.leaky_relu,
    "HardSigmoid": Activation.hard_sigmoid,
    "HardSwish": Activation.hard_swish,
}


def _pair(values: list[int]) -> Pair:
    if len(values) != 2:
        raise refused_graph("windows over rows and columns", f"one over {len(values)} sizes")
    return int(values[0]), int(values[1])
