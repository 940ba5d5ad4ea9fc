"""A float ONNX network as the short list of operations, and what stays on the host around it.

A file from outside is looked at once, here; behind it nothing asks again.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import onnx

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.graph.moves import MOVES, ORDERS, Resizing, with_shuffles
from beers_deploy.quant.graph.network import (
    REMEDY,
    Network,
    add_channels,
    check_network,
    cut,
    named_apart,
    sized,
    unsupported,
)
from beers_deploy.quant.graph.nodes import Node
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
    Pointwise,
    Resize,
    Shuffle,
    same,
)
from beers_deploy.quant.reading.equivalents import per_channel
from beers_deploy.quant.untrusted import check_runnable, contradictions, times
from beers_deploy.quant.window import Pair, Window


def read_network(model: onnx.ModelProto) -> Network:
    """The operations of a float network that has been simplified (`quant.reading`)."""
    with contradictions("the float network"):
        reader = _Reader(model)
        network = cut(reader.graph(), reader.channels())
        check_network(network)
    return network


def plain_network(model: onnx.ModelProto) -> Network:
    """A network of ConvBEERS' kind: what proofs, the stress battery and bit flips take.

    It adds a correction to an image of one channel, and computes it by same-size convolutions of
    stride 1, ReLU and adds; at full resolution, or at a lower one, with the image's pixels
    rearranged into channels and back.
    """
    network = read_network(model)
    blocks = [[shuffle.block for shuffle in end] for end in (network.front, network.back)]
    same_ends = network == Network(network.graph, front=network.front, back=network.back)
    if not (same_ends and blocks[0] == blocks[1] and len(blocks[0]) <= 1):
        raise unsupported(
            "The network must read an image of one channel, and add it to its result at the end "
            "(a global add)."
        )
    for op in network.graph:
        if not _is_plain(op):
            raise unsupported(
                "The network may have only same-size convolutions of stride 1, ReLU and adds, but "
                f"it has {op.name}."
            )
    return network


def _is_plain(op: Op) -> bool:
    if isinstance(op, Conv):
        alone = op.groups == 1 and not op.transposed and op.window == same(op.weight)
        return alone and op.activation in (Activation.none, Activation.relu)
    return isinstance(op, Add) and op.activation is Activation.none


def correction_graph(model: onnx.ModelProto) -> Graph:
    """Its operations, from `image` (N, S^2, H / S, W / S) to `correction` of the same shape."""
    return plain_network(model).graph


def image_channels(graph: Graph) -> int:
    """Channels of the image as such operations read it: S^2, the pixels of a place."""
    return next(
        int(op.weight.shape[1]) for op in graph if isinstance(op, Conv) and op.input == IMAGE
    )


def refusal(model: onnx.ModelProto) -> str:
    """Return the sentence that says why a float network cannot be quantised; "" if it can."""
    try:
        check_runnable(model, "the float network")
        read_network(model)
    except ModelError as error:
        # `check` calls this, so its user need not be sent to `check`.
        return str(error).removesuffix(f" {REMEDY}")
    return ""


class _Reader:
    """Walks the nodes once; a tensor that is another's by a new name is known by the first."""

    def __init__(self, model: onnx.ModelProto) -> None:
        self.source = with_shuffles(model)
        self.result = model.graph.output[0].name
        self.image, *_ = self.source.inputs
        self.ops: list[Op] = []
        self._places: dict[str, int] = {}  # where the operation that writes a tensor stands
        self._widths: dict[str, int] = {}  # channels of what the first operations write
        self._measured = 0  # so many operations

    def channels(self) -> int:
        """Of the image."""
        sizes = self.source.inputs[self.image]
        if len(sizes) != 4:
            raise unsupported(
                f"The network's input must be (N, C, H, W), but it has {len(sizes)} dimensions."
            )
        return sizes[1] or 1

    def graph(self) -> Graph:
        """The operations from the network's own input to its own output; global pooling takes one
        size of image.
        """
        if len(self.source.outputs) != 1:
            raise unsupported(
                f"The network must have one output, but it has {len(self.source.outputs)}: "
                f"{', '.join(self.source.outputs)}.",
                "Export it with one of them.",
            )
        for node in self.source.nodes:
            self._read(node)
        if not self.ops or self.ops[-1].output != self.result:
            raise unsupported("No operation writes the network's output.")
        graph = named_apart(self.ops, {self.image: IMAGE, self.result: CORRECTION})
        pools = [op for op in graph if isinstance(op, AveragePool) and op.kernel is None]
        rows, columns = self.source.inputs[self.image][2:]
        if pools and not (rows and columns):
            raise unsupported(
                f"The network accepts images of any size, but {pools[0].name} pools over the whole "
                "image, whose size must be known.",
                "Export it with fixed height and width.",
            )
        return sized(graph, (rows, columns)) if pools else graph

    def _read(self, node: Node) -> None:
        if node.op_type in ACTIVATIONS:
            self._activation(node)
            return
        if node.op_type not in READERS:
            remedy = "Replace it by one that the DPU computes, or cut the network in front of it."
            if node.op_type in OF_NO_IMAGE:
                remedy = (
                    "'quantize' accepts networks that make an image of an image: cut the network "
                    "in front of it. 'check' and 'bench' read any network."
                )
            if node.op_type == "Pad":
                remedy = (
                    "Pad in the convolution; a network behind a bank is quantised from its "
                    "weights (.safetensors)."
                )
            raise unsupported(f"The DPU does not compute the operation {node}.", remedy)
        op = READERS[node.op_type](self, node)
        if op is not None:
            self._append(op)

    def _append(self, op: Op) -> None:
        self._places[op.output] = len(self.ops)
        self.ops.append(op)

    def _replace(self, place: int, op: Op) -> None:
        """Put an operation in the place of one whose result has another name."""
        before = self.ops[place].output
        self.ops[place] = op
        del self._places[before]
        self._places[op.output] = place
        if before in self._widths:
            self._widths[op.output] = self._widths[before]

    def _channels_of(self, tensor: str) -> int:
        """Return the channels of what an operation has written."""
        if not self._measured:
            self._widths[self.image] = self.channels()
        add_channels(self._widths, self.ops[self._measured :])
        self._measured = len(self.ops)
        return self._widths[tensor]

    def _require(self, condition: bool, node: Node, rule: str) -> None:
        """Raise ModelError with a rule, "must ..." or "has ...", that the node breaks."""
        if not condition:
            raise unsupported(f"{node} {rule}.")

    def _weights(self, node: Node) -> tuple[np.ndarray, np.ndarray]:
        """Of a convolution, (O, I / groups, kh, kw), and its bias (O,)."""
        weight = self.source.value(node, 1)
        bias = self.source.value(node, 2)
        if weight is None:
            raise unsupported(f"{node} must have constant weights, but they are computed.")
        self._require(
            weight.ndim == 4,
            node,
            f"must be a convolution over rows and columns, but its weights have {weight.ndim} "
            "dimensions",
        )
        if node.op_type == "ConvTranspose":
            weight = np.ascontiguousarray(weight.swapaxes(0, 1))
        bias = np.zeros(len(weight)) if bias is None else bias
        return weight.astype(np.float32), bias.astype(np.float32)

    def _conv(self, node: Node) -> Op:
        weight, bias = self._weights(node)
        groups = int(node.attributes.get("group", 1))
        # A DPU has one group or one a channel: its tools leave others to the processor.
        depthwise = groups == len(weight) and weight.shape[1] == 1
        self._require(
            groups == 1 or depthwise,
            node,
            f"must have one group, or one for each channel (depthwise), got {groups} groups",
        )
        _, window = self._window(node, weight.shape[2:])
        return Conv(
            node.name, node.inputs[0], node.outputs[0], weight, bias, window=window, groups=groups
        )

    def _convtranspose(self, node: Node) -> Op:
        weight, bias = self._weights(node)
        attributes = node.attributes
        strides = attributes.get("strides", [1, 1])
        # AMD's tools leave a transposed convolution with output padding to the processor.
        plain = int(attributes.get("group", 1)) == 1 and not any(
            attributes.get("output_padding", [0])
        )
        self._require(plain, node, "must have one group and no output padding")
        even = (
            set(attributes.get("dilations", [1])) == {1}
            and len(set(strides)) == 1
            and "output_shape" not in attributes
        )
        self._require(
            even,
            node,
            "must have one stride for rows and columns, no dilation and no output_shape, got "
            f"strides {list(strides)}",
        )
        self._require(
            attributes.get("auto_pad", "NOTSET") == "NOTSET",
            node,
            "must state its pads instead of auto_pad",
        )
        _, window = self._window(node, weight.shape[2:])
        return Conv(
            node.name, node.inputs[0], node.outputs[0], weight, bias, window=window, transposed=True
        )

    def _window(self, node: Node, kernel: Sequence[int] = ()) -> tuple[Pair, Window]:
        kernel_and_window = node.window(kernel)
        auto = str(node.attributes.get("auto_pad", ""))
        if kernel_and_window is None:
            raise unsupported(f"{node} must have a window over rows and columns.")
        has_pads = kernel_and_window[1].strides == (1, 1) or not auto.startswith("SAME")
        self._require(
            has_pads, node, f"must state its pads instead of auto_pad {auto} with strides"
        )
        return kernel_and_window

    def _add_or_mul(self, node: Node) -> Op:
        kind = Add if node.op_type == "Add" else Mul
        return self._by_constant(node) or kind(
            node.name, (node.inputs[0], node.inputs[1]), node.outputs[0]
        )

    def _sub(self, node: Node) -> Op | None:
        """Of a constant; what a convolution wrote is added since the file was folded
        (`quant.reading`).
        """
        op = self._by_constant(node)
        self._require(
            op is not None,
            node,
            "is supported only if a convolution writes its second tensor, which nothing else reads",
        )
        return op

    def _by_constant(self, node: Node) -> Op | None:
        """A sum, difference or product with one number a channel: a depthwise convolution of one
        pixel.
        """
        constants = {k: value for k in (0, 1) if (value := self.source.value(node, k)) is not None}
        if not constants:
            return None
        (place, value), *others = constants.items()
        flat = None if others else per_channel(value)
        if flat is None:
            raise unsupported(
                f"{node} must have a constant of one number for each channel, got "
                f"{times(value.shape)}."
            )
        self._require(
            node.op_type != "Sub" or place == 1, node, "must subtract the constant, not the tensor"
        )
        source = node.inputs[1 - place]
        channels = self._channels_of(source)
        self._require(
            value.size in (1, channels),
            node,
            f"must have a constant of {channels} numbers, got {value.size}",
        )
        values = np.broadcast_to(flat.astype(np.float32), (channels,))
        one = np.ones(channels, np.float32)
        none = np.zeros(channels, np.float32)
        operators = {"Add": (one, values), "Sub": (one, -values), "Mul": (values, none)}
        factor, offset = operators[node.op_type]
        return Conv(
            node.name, source, node.outputs[0], factor[:, None, None, None], offset, groups=channels
        )

    def _concat(self, node: Node) -> Op:
        axis = node.attributes.get("axis")
        self._require(
            axis in (1, -3), node, f"must concatenate along the channels, got axis {axis}"
        )
        computed = self.source.constants.keys().isdisjoint(node.inputs)
        self._require(computed, node, "must concatenate computed tensors, got a constant")
        return Concat(node.name, node.inputs, node.outputs[0])

    def _maxpool(self, node: Node) -> Op:
        plain = len(node.outputs) == 1 and not node.attributes.get("ceil_mode", 0)
        self._require(plain, node, "must pool without indices and ceil_mode")
        return MaxPool(node.name, node.inputs[0], node.outputs[0], *self._window(node))

    def _averagepool(self, node: Node) -> Op:
        kernel, window = self._window(node)
        zeros = bool(node.attributes.get("count_include_pad", 0)) or not any(window.pads)
        plain = zeros and not node.attributes.get("ceil_mode", 0)
        self._require(plain, node, "must count its padding and have no ceil_mode")
        return AveragePool(node.name, node.inputs[0], node.outputs[0], kernel, window)

    def _resize(self, node: Node) -> Op:
        resizing = Resizing.of(node, self.source)
        is_uniform = resizing.factors[:2] == (1, 1) and resizing.factors[2] == resizing.factors[3]
        self._require(is_uniform, node, "must enlarge rows and columns by one constant factor")
        factor = int(resizing.factors[2])
        where = resizing.where
        self._require(
            resizing.factors[2] == factor >= 1,
            node,
            f"must enlarge by an integer factor, got {resizing.factors[2]:g}",
        )
        # A DPU enlarges bilinearly by 2 and 4 alone where centres are half-pixel ones.
        if resizing.mode == "linear":
            half = where in ("half_pixel", "pytorch_half_pixel") and factor in (2, 4)
            self._require(
                half,
                node,
                "must enlarge bilinearly by 2 or 4 with half-pixel centres, got "
                f"{where} by {factor}",
            )
        else:
            blocks = resizing.mode == "nearest" and resizing.makes_blocks(factor)
            self._require(
                blocks,
                node,
                "must be a nearest resize that makes a block of each pixel, got "
                f"{resizing.mode}, {where}, {resizing.rounding} by {factor}",
            )
        return Resize(node.name, node.inputs[0], node.outputs[0], factor, resizing.mode == "linear")

    def _shuffle(self, node: Node) -> Op:
        """A pixel shuffle, or Reshape and Transpose as exporters spell one."""
        mode = node.attributes.get("mode", "DCR") if node.op_type not in MOVES else ""
        self._require(
            mode in ORDERS,
            node,
            "must be a pixel shuffle, or part of a Reshape and Transpose that make one",
        )
        up = node.op_type == "DepthToSpace"
        block = int(node.attributes["blocksize"])
        # Of several nodes that spell one shuffle it is the last one's name.
        name = node.proto.name or node.name
        return Shuffle(name, node.inputs[0], node.outputs[0], block, up, ORDERS[mode])

    def _activation(self, node: Node) -> None:
        activation = self._which(node)
        # HardSigmoid and HardSwish are functions of a rounded value, the others of the exact sums.
        on_sums = activation not in (Activation.hard_sigmoid, Activation.hard_swish)
        writer = self._places.get(node.inputs[0])
        producer = self.ops[writer] if writer is not None else None
        # A DPU computes no activation but ReLU behind a sum of two tensors.
        fusible = isinstance(producer, Conv) or (
            isinstance(producer, Add) and activation is Activation.relu
        )
        can_fuse = (
            getattr(producer, "activation", None) is Activation.none
            and self.source.reads(node.inputs[0]) == 1
        )
        # The host computes LeakyReLU on a convolution's own sums, which a transposed one has in
        # phases.
        phased = (
            isinstance(producer, Conv)
            and producer.transposed
            and activation is Activation.leaky_relu
        )
        if on_sums and fusible and can_fuse and not phased and writer is not None:
            assert isinstance(producer, Conv | Add)  # noqa: S101
            self._replace(writer, replace(producer, output=node.outputs[0], activation=activation))
        else:
            self._append(Pointwise(node.name, node.inputs[0], node.outputs[0], activation))

    def _which(self, node: Node) -> Activation:
        activation = ACTIVATIONS[node.op_type]
        if node.op_type == "LeakyRelu":
            slope = float(node.attributes.get("alpha", 0.01))
            self._require(
                slope == np.float32(LEAKY_SLOPE),
                node,
                f"must have a slope of 26/256 (0.1015625), got {slope:g}",
            )
        if node.op_type == "Clip":
            low, high = (self.source.value(node, k) for k in (1, 2))
            six = low is not None and high is not None and float(low) == 0 and float(high) == 6
            self._require(six, node, "must clip from 0 to 6 (ReLU6)")
        if node.op_type == "HardSigmoid":
            alpha = node.attributes.get("alpha", 0.2)
            beta = node.attributes.get("beta", 0.5)
            plain = bool(np.isclose(alpha, 1 / 6, 1e-4)) and beta == 0.5
            self._require(
                plain, node, f"must have alpha 1/6 and beta 0.5, got {alpha:g} and {beta:g}"
            )
        return activation


READERS: dict[str, Callable[[_Reader, Node], Op | None]] = {
    "Add": _Reader._add_or_mul,
    "AveragePool": _Reader._averagepool,
    "Concat": _Reader._concat,
    "Conv": _Reader._conv,
    "ConvTranspose": _Reader._convtranspose,
    "DepthToSpace": _Reader._shuffle,
    "GlobalAveragePool": lambda _, node: AveragePool(
        node.name, node.inputs[0], node.outputs[0], None
    ),
    "MaxPool": _Reader._maxpool,
    "Mul": _Reader._add_or_mul,
    "Resize": _Reader._resize,
    "SpaceToDepth": _Reader._shuffle,
    "Sub": _Reader._sub,
    **dict.fromkeys(MOVES, _Reader._shuffle),
}

OF_NO_IMAGE = {"Flatten", "Gemm", "MatMul", "NonMaxSuppression", "Sigmoid", "Softmax"}
"""Operators with which classifiers and detectors end."""

ACTIVATIONS = {
    "Relu": Activation.relu,
    "Clip": Activation.relu6,
    "LeakyRelu": Activation.leaky_relu,
    "HardSigmoid": Activation.hard_sigmoid,
    "HardSwish": Activation.hard_swish,
}
