"""Read a float ONNX network as the short list of operations, split into host and DPU part.

A file from outside is checked once, here; later code does not check it again.
"""

from contextlib import suppress
from copy import deepcopy
from dataclasses import replace

import numpy as np
from onnx import ModelProto

from beers_deploy.profiles.errors import ModelError, counted
from beers_deploy.quant.graph.attention import aligned, shrinking
from beers_deploy.quant.graph.host_end import host_end
from beers_deploy.quant.graph.mirror import image_mirror, pads_of
from beers_deploy.quant.graph.node_operations import ACTIVATIONS, READERS, read_activation, require
from beers_deploy.quant.graph.normalization import Normalization, lone_deviation
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
    Resize,
)
from beers_deploy.quant.graph.pixel_shuffle import with_shuffles
from beers_deploy.quant.graph.split_network import (
    ADAPT,
    REMEDY,
    AdaptableError,
    SplitNetwork,
    channels_of,
    check_result_size,
    check_split,
    cut,
    named_apart,
    require_one_image,
    sized,
    unsupported,
)
from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.onnx.resize import Resizing
from beers_deploy.quant.onnx.runnable import check_runnable
from beers_deploy.quant.simplify.fold_affine import affine_of
from beers_deploy.quant.simplify.simplify import simplify
from beers_deploy.quant.untrusted import contradictions, times

NO_IMAGE = (
    "'quantize' accepts networks that make an image of an image: cut the network in front of it. "
    "'check' and 'bench' read any network."
)
NORMALISES = (
    "It normalizes each image, or each pixel, by its own statistics. Train the network with batch "
    "normalization, which becomes part of the convolutions, or without normalization."
)
STATISTICS = (
    "It is a statistic of all channels or of the whole image, as layer normalization and some "
    "attention have it. Train the network with batch normalization, which becomes part of the "
    "convolutions, and with global average pooling."
)
NO_ATTENTION = (
    "A DPU has only convolutions of constant weights. Train a network without self-attention and "
    "computed kernels, such as NAFNet."
)
FIX_SIZE = (
    "Export it with fixed height and width, or give the file some: python -m "
    "onnxruntime.tools.make_dynamic_shape_fixed."
)
OF_ONE_SIZE = f"The network computes with the size of its image. {FIX_SIZE}"
REMEDIES = {
    **dict.fromkeys(("Flatten", "Gemm", "MatMul", "NonMaxSuppression"), NO_IMAGE),
    **dict.fromkeys(
        ("GroupNormalization", "InstanceNormalization", "LayerNormalization", "ReduceL2"),
        NORMALISES,
    ),
    **dict.fromkeys(("ReduceMax", "ReduceMean", "ReduceSum"), STATISTICS),
    **dict.fromkeys(("PRelu", "Sigmoid", "Tanh", "Gelu", "Erf", "Mish"), ADAPT),
    **dict.fromkeys(
        ("ConstantOfShape", "Expand", "GlobalMaxPool", "Shape", "Size", "Tile"), OF_ONE_SIZE
    ),
    "Pad": "Let convolutions pad by zeros, and train the network again.",
    "Softmax": "Leave it out at the end of a network; within one, train with Sigmoid.",
}
"""Advice for each operator that no DPU computes."""
NEVER = (NORMALISES, STATISTICS)
"""Advice for operators that are refused at any size of the image."""
OTHER_REMEDY = "Replace it by one that the DPU computes, or cut the network in front of it."


def read_network(model: ModelProto) -> SplitNetwork:
    """Read a float ONNX network as the short list of operations, split into host and DPU part.

    Args:
        model: a float network that was simplified (`quant.simplify`).

    Raises:
        ModelError: an operation that no DPU computes, or a form that is not supported.
    """
    with contradictions("the float network"):
        reader = _Reader(model)
        network = cut(reader.graph(), reader.channels(), not reader.end.adds_in_core)
        network = replace(
            network,
            border_px=reader.border_px,
            crop_px=reader.end.crop_px,
            limits=reader.end.limits,
            activation=reader.end.activation,
            base=reader.end.base or network.base,
            adds_image=network.adds_image or reader.end.base is not None,
        )
        check_split(network)
    # Last, because any other error would remain after adapting.
    if reader.adaptable is not None:
        raise reader.adaptable
    return network


def refusal(model: ModelProto) -> str:
    """Return a sentence for a user on why a float network cannot be quantised; "" if it can."""
    try:
        check_runnable(model, "the float network")
        # A file that cannot be simplified is inspected as it is, and would be quantised by nobody.
        simplify(model, "the float network")
        read_network(model)
    except ModelError as error:
        # `check` calls this too, and need not be recommended to its own user.
        return str(error).removesuffix(f" {REMEDY}")
    return ""


class _Reader:
    """Reads the nodes once, in order."""

    def __init__(self, model: ModelProto) -> None:
        self.adaptable: AdaptableError | None = None  # the first
        self.source = with_shuffles(self._adapted(model))
        self.image, *_ = self.source.inputs
        self.ops: list[Op] = []
        self.border_px = 0
        # The host mirrors the image.
        if mirror := image_mirror(self.source):
            pad, self.border_px = mirror
            for node in self.source.readers[pad.result]:
                node.read_instead(pad.result, self.image)
            self.source.set_nodes([node for node in self.source.nodes if node is not pad])
        self.end = host_end(self.source)

    def _adapted(self, model: ModelProto) -> ModelProto:
        """Return the model with attention and normalisations as `quant.adapt` replaces them, and
        note that.
        """
        network = deepcopy(model)
        graph = OnnxGraph(network)
        graph.infer_shapes()
        plan: dict[Node, list[Node]] = {}
        for node in graph.nodes:
            if shrinking(graph, node):
                fault = f"{node} enlarges to the size of another map, by no whole factor."
                plan.update(aligned(graph, node))
            elif normalization := Normalization.of(graph, node):
                fault = f"The DPU does not compute the normalization {node}."
                plan[node] = normalization.nodes(graph)
            elif deviation := lone_deviation(graph, node):
                fault = f"The DPU does not compute the standard deviation over the image, {node}."
                plan[node] = deviation.nodes(graph)
        if not plan:
            return model
        graph.rewrite(lambda _, node: plan.get(node))
        graph.save()
        self.adaptable = AdaptableError(str(unsupported(fault, ADAPT)))
        return network

    def channels(self) -> int:
        """Return the channels of the image."""
        sizes = self.source.inputs[self.image]
        if len(sizes) != 4:
            raise unsupported(
                "The network's input must be (N, C, H, W), but it has "
                f"{counted(len(sizes), 'dimension')}."
            )
        return sizes[1] or 1

    def graph(self) -> Graph:
        """Return the operations from `IMAGE` to `CORRECTION`; global pooling needs a fixed size."""
        self._check_whole()
        (result,) = self.source.outputs
        result = self.end.in_core(result)
        for node in self.source.nodes:
            if node.result in self.end.replaced:
                continue
            node.inputs = tuple(map(self.end.in_core, node.inputs))
            try:
                self._read(node)
            except AdaptableError as error:
                self.adaptable = self.adaptable or error
                # An enlargement stands in, so that the rest is read: by the same factor, or by 1.
                is_resize = node.op_type == "Resize"
                factor = Resizing.of(self.source, node).factors[2] if is_resize else 1
                self.ops.append(Resize(node.name, node.source, node.result, int(factor), True))
        if not self.ops or self.ops[-1].output != result:
            raise unsupported("No operation writes the network's output.")
        graph = named_apart(self.ops, {self.image: IMAGE, result: CORRECTION})
        pools = [op for op in graph if isinstance(op, AveragePool) and op.kernel is None]
        rows, columns = self.source.inputs[self.image][2:]
        if pools and not (rows and columns):
            raise unsupported(
                f"The network accepts images of any size, but {pools[0].name} pools over the whole "
                "image, whose size must be known.",
                FIX_SIZE,
            )
        if not (rows and columns):
            check_result_size(graph, self.border_px, self.end.crop_px)
        border_px = 2 * self.border_px
        return sized(graph, (rows + border_px, columns + border_px)) if pools else graph

    def _check_whole(self) -> None:
        """Raise ModelError for faults of the whole network, and for those that no image size would
        avoid.
        """
        require_one_image(self.source.inputs, self.source.outputs)
        (result,) = self.source.outputs
        dims = self.source.result_sizes[result]
        if dims and len(dims) != 4:
            raise unsupported(
                f"The network's result must be an image or a map (N, C, H, W), but {result} has "
                f"{counted(len(dims), 'dimension')}.",
                NO_IMAGE,
            )
        self._check_tensors()
        # Last what can be adapted, because other faults would remain.
        for node in sorted(self.source.nodes, key=lambda node: bool(pads_of(self.source, node))):
            if node.op_type == "Concat" and node.attribute("axis") in (2, 3, -2, -1):
                READERS[node.op_type](self.source, node)
            if node.op_type == "Pad" or REMEDIES.get(node.op_type) in NEVER:
                raise _refused(self.source, node)
            if node.op_type == "Resize" and node.result not in self.end.replaced:
                with suppress(AdaptableError):
                    READERS[node.op_type](self.source, node)

    def _check_tensors(self) -> None:
        """Raise ModelError for what only another network avoids: products of computed tensors, and
        tensors that are no maps.
        """
        for node in self.source.nodes:
            if node.op_type in ("DFT", "Softmax"):
                raise _refused(self.source, node)
            is_product = node.op_type in ("Conv", "Einsum", "MatMul")
            if is_product and self.source.constants.keys().isdisjoint(node.inputs[:2]):
                raise unsupported(f"{node} multiplies computed tensors.", NO_ATTENTION)
        self.source.infer_shapes()
        for node in self.source.nodes:
            if len(self.source.shapes.get(node.result, ())) > 4:
                fault = f"{node} makes a tensor of more than four dimensions."
                raise unsupported(fault, "Stack maps along the channels.")

    def _read(self, node: Node) -> None:
        if node.op_type in ACTIVATIONS:
            self._activation(node)
        elif node.op_type in ("Add", "Div", "Mul", "Sub"):
            self._arithmetic(node)
        elif node.op_type in READERS:
            self.ops.append(READERS[node.op_type](self.source, node))
        else:
            raise _refused(self.source, node)

    def _arithmetic(self, node: Node) -> None:
        """Append a sum or product of two tensors; or, for arithmetic with one number a channel, a
        depthwise convolution of one pixel.
        """
        constants = self.source.constants
        shapes = [constants[name].shape for name in node.inputs if name in constants]
        if not shapes:
            rule = "must divide by a constant, not by a computed tensor"
            require(node.op_type != "Div", node, rule)
            # Simplification has made an Add of a Sub whose channels are known.
            require(node.op_type != "Sub", node, "subtracts a map of unknown channels")
            kind = Mul if node.op_type == "Mul" else Add
            self.ops.append(kind(node.name, node.inputs, node.result))
            return
        match = affine_of(self.source, node)
        if match is None:
            size = times(shapes[0])
            raise unsupported(
                f"{node} must have a constant of one number for each channel, got {size}."
            )
        source, affine = match
        channels = channels_of(self.ops, {self.image: self.channels()})[source]
        require(
            affine.channels in (1, channels),
            node,
            f"must have a constant of {channels} numbers, got {affine.channels}",
        )
        scale, shift = (
            np.broadcast_to(values.astype(np.float32), channels)
            for values in (affine.scale, affine.shift)
        )
        weight = scale[:, None, None, None]
        self.ops.append(Conv(node.name, source, node.result, weight, shift, groups=channels))

    def _activation(self, node: Node) -> None:
        """Fuse an activation into the operation before it, or append it as a separate operation."""
        activation = read_activation(self.source, node)
        source = node.source
        places = {op.output: place for place, op in enumerate(self.ops)}
        producer = self.ops[places[source]] if source in places else None
        # HardSigmoid and HardSwish are functions of a rounded value, the others of the exact sums.
        excluded = {Activation.hard_sigmoid, Activation.hard_swish}
        if isinstance(producer, Add):
            # A DPU computes no activation but ReLU behind a sum of two tensors.
            excluded = set(Activation) - {Activation.relu}
        elif isinstance(producer, Conv) and producer.transposed:
            # The host's file computes LeakyReLU on the sums of a convolution. A transposed one has
            # them in phases.
            excluded.add(Activation.leaky_relu)
        if (
            isinstance(producer, Conv | Add)
            and producer.activation is Activation.none
            and self.source.n_reads(source) == 1
            and activation not in excluded
        ):
            fused = replace(producer, output=node.result, activation=activation)
            self.ops[places[source]] = fused
        else:
            self.ops.append(Pointwise(node.name, source, node.result, activation))


def _refused(graph: OnnxGraph, node: Node) -> ModelError:
    """Return the error of an operator that no DPU computes."""
    remedy = REMEDIES.get(node.op_type, OTHER_REMEDY)
    is_mean = node.op_type == "ReduceMean" and graph.numbers(node, 1, "axes") == [1]
    if is_mean and any(other.op_type == "Sqrt" for other in graph.nodes):
        remedy = f"It begins a layer normalization. {NORMALISES}"
    if node.op_type == "Softplus" and all(
        reader.op_type == "Tanh" for reader in graph.readers[node.result]
    ):
        # A part of Mish.
        remedy = ADAPT
    if node.op_type == "Pad" and graph.numbers(node, 1, "pads") is None:
        remedy = OF_ONE_SIZE
    if pads_of(graph, node):
        remedy = ADAPT
    return unsupported(f"The DPU does not compute the operation {node}.", remedy)
