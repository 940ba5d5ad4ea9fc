"""Read one node of a float network as an operation of the short list.

Each function raises ModelError with the rule that a node breaks. The graph provides the constants.
"""

from collections.abc import Callable, Sequence

import numpy as np

from beers_deploy.quant.graph.operations import (
    LEAKY_SLOPE,
    PLANES,
    Activation,
    AveragePool,
    Concat,
    Conv,
    MaxPool,
    Op,
    Resize,
    Shuffle,
)
from beers_deploy.quant.graph.pixel_shuffle import MOVES, ORDERS
from beers_deploy.quant.graph.split_network import ADAPT, ADAPT_EXACTLY, REMEDY, unsupported
from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.onnx.resize import Resizing, alone_enlarges_image
from beers_deploy.quant.onnx.window import Sides, Window
from beers_deploy.quant.simplify.convolutions import leaves_pads
from beers_deploy.quant.simplify.spelled_activations import has_slope_of_dpu, slope_and_offset

PAD_STRIDES = (
    "Pad strided convolutions and pools, so that their result has a half or a quarter of the size, "
    "enlarge it by 2 or 4, and train again; attention such as RFDN's can also be left out."
)
OF_ONE_SENSOR = (
    "'export' wrote this file for one sensor, from weights whose filter bank 'quantize' computes "
    "itself. Quantise the shipped name or the .safetensors file instead."
)
SHRINK = "Shrink by a pool or a strided convolution, or cut the network in front of it."


def require(condition: bool, node: Node, rule: str, remedy: str = REMEDY) -> None:
    """Raise ModelError unless a node meets a rule of the operations that a DPU computes.

    Args:
        condition: True if the node meets the rule.
        node: the node that the message names.
        rule: a verb phrase for the message on what is wrong or required: "must ..." or "has ...".
        remedy: a sentence on what to do.
    """
    if not condition:
        raise unsupported(f"{node} {rule}.", remedy)


def _read_conv(graph: OnnxGraph, node: Node) -> Op:
    """Read a convolution of one group or of one for each channel, or a transposed one."""
    weight = graph.value(node, 1)
    bias = graph.value(node, 2)
    if weight is None:
        raise unsupported(f"{node} must have constant weights, but they are computed.")
    require(
        weight.ndim == 4,
        node,
        f"must be a convolution over rows and columns, but its weights have {weight.ndim} "
        "dimensions",
    )
    groups = node.groups
    transposed = node.op_type == "ConvTranspose"
    if transposed:
        weight = np.ascontiguousarray(weight.swapaxes(0, 1))
        # Simplification has made one group of several.
        groups = 1
        _check_transposed(node)
    # A DPU has one group, or one for each channel. Its tools leave other numbers to the processor.
    depthwise = groups == len(weight) and weight.shape[1] == 1
    require(
        groups == 1 or depthwise,
        node,
        f"must have one group, or one for each channel (depthwise), got {groups} groups",
    )
    _, window = _window(node, weight.shape[2:])
    bias = np.zeros(len(weight)) if bias is None else bias
    return Conv(
        node.name,
        node.source,
        node.result,
        weight.astype(np.float32),
        bias.astype(np.float32),
        window=window,
        groups=groups,
        transposed=transposed,
    )


def _check_transposed(node: Node) -> None:
    """Raise ModelError unless a transposed convolution enlarges rows and columns by one factor."""
    attribute = node.attribute
    strides = list(attribute("strides", [1, 1]))
    rule = f"must have one stride for rows and columns, got strides {strides}"
    require(len(set(strides)) == 1, node, rule, "Use a square stride.")
    dilations = list(attribute("dilations", [1]))
    rule = f"must have no dilation, got dilations {dilations}"
    require(
        set(dilations) == {1}, node, rule, "Use a larger kernel, with zeros between its values."
    )
    padding = list(node.output_padding)
    # Simplification has made it a part of the kernel where pads are stated.
    require(not any(padding), node, f"must have no output padding, got {padding}")
    for name in ("output_shape", "auto_pad"):
        value = attribute(name, "NOTSET")
        rule = f"must have pads instead of {name} {value}"
        require(value == "NOTSET", node, rule, "State its pads.")


def _window(node: Node, kernel: Sequence[int] = ()) -> tuple[Sides, Window]:
    kernel_and_window = node.window(kernel)
    if kernel_and_window is None:
        raise unsupported(f"{node} must have a window over rows and columns.")
    rule = f"must state its pads instead of auto_pad {node.attribute('auto_pad')} with strides"
    require(not leaves_pads(node), node, rule)
    return kernel_and_window


def _read_concat(graph: OnnxGraph, node: Node) -> Op:
    axis = node.attribute("axis")
    rule = f"must concatenate along the channels, got axis {axis}"
    require(axis in (1, -3), node, rule, "Compute maps whole, not in parts.")
    computed = graph.constants.keys().isdisjoint(node.inputs)
    require(computed, node, "must concatenate computed tensors, got a constant")
    return Concat(node.name, node.inputs, node.result)


def _read_max_pool(_: OnnxGraph, node: Node) -> Op:
    is_plain = len(node.outputs) == 1 and not node.attribute("ceil_mode")
    require(is_plain, node, "must have one output and ceil_mode 0")
    return MaxPool(node.name, node.source, node.result, *_window(node))


def _read_average_pool(_: OnnxGraph, node: Node) -> Op:
    kernel, window = _window(node)
    counts_zeros = bool(node.attribute("count_include_pad")) or not any(window.pads)
    is_plain = counts_zeros and not node.attribute("ceil_mode")
    require(is_plain, node, "must have count_include_pad 1 and ceil_mode 0")
    return AveragePool(node.name, node.source, node.result, kernel, window)


def _read_resize(graph: OnnxGraph, node: Node) -> Op:
    resizing = Resizing.of(graph, node)
    is_uniform = resizing.factors[:2] == (1, 1) and resizing.factors[2] == resizing.factors[3]
    rule = "must enlarge rows and columns by one factor for images of all sizes"
    require(is_uniform, node, rule, PAD_STRIDES)
    factor = int(resizing.factors[2])
    where = resizing.where
    require(
        resizing.factors[2] == factor >= 1,
        node,
        f"must enlarge by an integer factor, got {resizing.factors[2]:g}",
        SHRINK if resizing.factors[2] < 1 else PAD_STRIDES,
    )
    # A DPU enlarges bilinearly only by 2 and 4 with half-pixel centres.
    if resizing.mode == "linear":
        require(
            resizing.is_half_pixel and factor in (2, 4),
            node,
            f"must enlarge bilinearly by 2 or 4 with half-pixel centres, got {where} by {factor}",
            ADAPT if resizing.is_nearly_bilinear else REMEDY,
        )
    else:
        blocks = resizing.mode == "nearest" and resizing.makes_blocks(factor)
        require(
            blocks,
            node,
            "must make a block of each pixel, or be bilinear by 2 or 4, got "
            f"{resizing.mode}, {where}, {resizing.rounding} by {factor}",
            ADAPT if alone_enlarges_image(graph, node) else REMEDY,
        )
    return Resize(node.name, node.source, node.result, factor, resizing.mode == "linear")


def _read_shuffle(_: OnnxGraph, node: Node) -> Op:
    """Read a pixel shuffle; Reshape and Transpose that make one are one already."""
    mode = node.attribute("mode", "DCR") if node.op_type not in MOVES else ""
    require(
        mode in ORDERS,
        node,
        "must be a pixel shuffle, or part of a Reshape and Transpose that make one",
    )
    up = node.op_type == "DepthToSpace"
    block = int(node.attributes["blocksize"])
    # If several nodes express one shuffle, it is named after the last one.
    name = node.proto.name or node.name
    return Shuffle(name, node.source, node.result, block, up, ORDERS[mode])


READERS: dict[str, Callable[[OnnxGraph, Node], Op]] = {
    "AveragePool": _read_average_pool,
    "Concat": _read_concat,
    "Conv": _read_conv,
    "ConvTranspose": _read_conv,
    "DepthToSpace": _read_shuffle,
    "GlobalAveragePool": lambda _, node: AveragePool(node.name, node.source, node.result, None),
    "MaxPool": _read_max_pool,
    "Resize": _read_resize,
    "SpaceToDepth": _read_shuffle,
    **dict.fromkeys(MOVES, _read_shuffle),
}
"""Operators that are one operation, independent of the nodes before them."""

ACTIVATIONS = {
    "Relu": Activation.relu,
    "Clip": Activation.relu6,
    "LeakyRelu": Activation.leaky_relu,
    "HardSigmoid": Activation.hard_sigmoid,
    "HardSwish": Activation.hard_swish,
}


def read_activation(graph: OnnxGraph, node: Node) -> Activation:
    """Return the activation that a node computes.

    Args:
        graph: the graph that the node belongs to.
        node: a node whose operator is one of `ACTIVATIONS`.

    Raises:
        ModelError: the node has a slope or limits that no DPU computes.
    """
    activation = ACTIVATIONS[node.op_type]
    if node.op_type == "LeakyRelu":
        slope = float(node.attribute("alpha", 0.01))
        require(
            slope == np.float32(LEAKY_SLOPE),
            node,
            f"must have a slope of 26/256 (0.1015625), got {slope:g}",
            ADAPT,
        )
    if node.op_type == "Clip":
        low, high = (graph.value(node, k) for k in (1, 2))
        six = low is not None and high is not None and float(low) == 0 and float(high) == 6
        # The name is that of our own export, whose bank clips to 12 bits.
        remedy = OF_ONE_SENSOR if node.result == PLANES else REMEDY
        require(six, node, "must clip from 0 to 6 (ReLU6)", remedy)
    if node.op_type == "HardSigmoid":
        alpha, beta = slope_and_offset(node)
        rule = f"must have alpha 1/6 and beta 0.5, got {alpha:g} and {beta:g}"
        require(has_slope_of_dpu(node), node, rule, ADAPT_EXACTLY)
    return activation
