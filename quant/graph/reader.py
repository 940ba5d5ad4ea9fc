"""Read a float ONNX network as the short list of operations, split into host and DPU part.

A file from outside is checked once, here; behind it nothing asks again.
"""

from dataclasses import replace

import numpy as np
import onnx

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.graph.node_operations import ACTIVATIONS, READERS, read_activation, require
from beers_deploy.quant.graph.operations import (
    CORRECTION,
    IMAGE,
    Activation,
    Add,
    AveragePool,
    Conv,
    Graph,
    Mul,
    Op,
    Pointwise,
)
from beers_deploy.quant.graph.pixel_shuffle import with_shuffles
from beers_deploy.quant.graph.split_network import (
    ADAPT,
    REMEDY,
    SplitNetwork,
    add_channels,
    check_network,
    cut,
    named_apart,
    sized,
    unsupported,
)
from beers_deploy.quant.onnx.graph import Node
from beers_deploy.quant.onnx.runnable import check_runnable
from beers_deploy.quant.simplify.fold_affine import per_channel
from beers_deploy.quant.untrusted import contradictions, times

NO_IMAGE = {"Flatten", "Gemm", "MatMul", "NonMaxSuppression", "Sigmoid", "Softmax"}
"""Operators with which classifiers and detectors end."""
ADAPTABLE = {"PRelu", "Sigmoid"}
"""Operators that `quant.adapt` replaces, but for one that writes the network's result."""


def read_network(model: onnx.ModelProto) -> SplitNetwork:
    """Read the operations of a float network that has been simplified (`quant.simplify`)."""
    with contradictions("the float network"):
        reader = _Reader(model)
        network = cut(reader.graph(), reader.channels())
        check_network(network)
    return network


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
    """Reads the nodes once, in order."""

    def __init__(self, model: onnx.ModelProto) -> None:
        self.source = with_shuffles(model)
        self.image, *_ = self.source.inputs
        self.ops: list[Op] = []
        self._places: dict[str, int] = {}  # where the operation that writes a tensor stands
        self._widths: dict[str, int] = {}  # channels of what the first operations write
        self._measured = 0  # how many operations `_widths` covers

    def channels(self) -> int:
        """Return the channels of the image."""
        sizes = self.source.inputs[self.image]
        if len(sizes) != 4:
            raise unsupported(
                f"The network's input must be (N, C, H, W), but it has {len(sizes)} dimensions."
            )
        return sizes[1] or 1

    def graph(self) -> Graph:
        """Return the operations from `IMAGE` to `CORRECTION`; global pooling needs a fixed size."""
        if len(self.source.outputs) != 1:
            raise unsupported(
                f"The network must have one output, but it has {len(self.source.outputs)}: "
                f"{', '.join(self.source.outputs)}.",
                "Export it with one of them.",
            )
        (result,) = self.source.outputs
        for node in self.source.nodes:
            self._read(node)
        if not self.ops or self.ops[-1].output != result:
            raise unsupported("No operation writes the network's output.")
        graph = named_apart(self.ops, {self.image: IMAGE, result: CORRECTION})
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
        elif node.op_type in ("Add", "Mul", "Sub"):
            self._append(self._arithmetic(node))
        elif node.op_type in READERS:
            self._append(READERS[node.op_type](node, self.source))
        else:
            remedy = "Replace it by one that the DPU computes, or cut the network in front of it."
            if node.op_type in ADAPTABLE and node.outputs != self.source.outputs:
                remedy = ADAPT
            elif node.op_type in NO_IMAGE:
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

    def _append(self, op: Op) -> None:
        self._places[op.output] = len(self.ops)
        self.ops.append(op)

    def _channels_of(self, tensor: str) -> int:
        """Return the channels of what an operation has written."""
        if not self._measured:
            self._widths[self.image] = self.channels()
        add_channels(self._widths, self.ops[self._measured :])
        self._measured = len(self.ops)
        return self._widths[tensor]

    def _arithmetic(self, node: Node) -> Op:
        """Read a sum, difference or product of two tensors, or of one with constants."""
        constants = {k: v for k in (0, 1) if (v := self.source.value(node, k)) is not None}
        if constants:
            return self._by_constant(node, constants)
        # Simplification has made an Add of a Sub where it can.
        require(
            node.op_type != "Sub",
            node,
            "is supported only if a convolution writes its second tensor, which nothing else reads",
        )
        kind = Add if node.op_type == "Add" else Mul
        return kind(node.name, (node.inputs[0], node.inputs[1]), node.outputs[0])

    def _by_constant(self, node: Node, constants: dict[int, np.ndarray]) -> Op:
        """Read arithmetic with one number a channel as a depthwise convolution of one pixel."""
        (place, value), *others = constants.items()
        flat = None if others else per_channel(value)
        if flat is None:
            raise unsupported(
                f"{node} must have a constant of one number for each channel, got "
                f"{times(value.shape)}."
            )
        require(
            node.op_type != "Sub" or place == 1, node, "must subtract the constant, not the tensor"
        )
        source = node.inputs[1 - place]
        channels = self._channels_of(source)
        require(
            value.size in (1, channels),
            node,
            f"must have a constant of {channels} numbers, got {value.size}",
        )
        values = np.broadcast_to(flat.astype(np.float32), (channels,))
        one = np.ones(channels, np.float32)
        zero = np.zeros(channels, np.float32)
        operators = {"Add": (one, values), "Sub": (one, -values), "Mul": (values, zero)}
        factor, offset = operators[node.op_type]
        return Conv(
            node.name, source, node.outputs[0], factor[:, None, None, None], offset, groups=channels
        )

    def _activation(self, node: Node) -> None:
        """Fuse an activation into the operation before it, or append it by itself."""
        activation = read_activation(node, self.source)
        # HardSigmoid and HardSwish are functions of a rounded value, the others of the exact sums.
        on_sums = activation not in (Activation.hard_sigmoid, Activation.hard_swish)
        source = node.inputs[0]
        place = self._places.get(source, -1)
        producer = self.ops[place] if place >= 0 else None
        if (
            on_sums
            and isinstance(producer, Conv | Add)
            and producer.activation is Activation.none
            and self.source.n_reads(source) == 1
            and _fuses(producer, activation)
        ):
            (output,) = node.outputs
            self.ops[place] = replace(producer, output=output, activation=activation)
            self._places[output] = self._places.pop(source)
            if source in self._widths:
                self._widths[output] = self._widths[source]
        else:
            self._append(Pointwise(node.name, source, node.outputs[0], activation))


def _fuses(producer: Conv | Add, activation: Activation) -> bool:
    """Return True if a DPU computes an activation on the sums of an operation."""
    # A DPU computes no activation but ReLU behind a sum of two tensors.
    if isinstance(producer, Add):
        return activation is Activation.relu
    # The host computes LeakyReLU on a convolution's own sums, which a transposed one has in phases.
    return not (producer.transposed and activation is Activation.leaky_relu)
