"""Write the operations as float ONNX, for calibration and as the operations of a board's file
between its roundings.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from onnx import ModelProto, TensorProto, helper

from beers_deploy.quant.graph.base import Base
from beers_deploy.quant.graph.operations import (
    LEAKY_SLOPE,
    PLANES,
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
)
from beers_deploy.quant.onnx.image_input import image_info
from beers_deploy.quant.onnx.window import Window
from beers_deploy.quant.onnx_file import GraphWriter, make_model


def graph_to_onnx(graph: Graph, outputs: list[str], channels: int = 3) -> ModelProto:
    """Write a float graph as an ONNX model that reads the int8 planes that an image is split into.

    Its input is the tensor `planes` (N, channels, H, W) float32.

    Args:
        graph: the operations.
        outputs: the names of the tensors that the model returns.
        channels: the number of planes; 3 is that of an image of one channel.
    """
    writer = GraphWriter()
    for op in graph:
        feeds = list(op.inputs)
        if isinstance(op, Conv):
            feeds += [
                writer.constant(f"{op.name}.weight", onnx_weight(op.weight, op.transposed)),
                writer.constant(f"{op.name}.bias", op.bias),
            ]
        write_float(writer, op, feeds, op.output)
    results = [
        helper.make_tensor_value_info(n, TensorProto.FLOAT, ["N", "C", None, None]) for n in outputs
    ]
    return make_model(writer.graph("core", [image_info(PLANES, channels, None)], results), {})


def onnx_weight(weight: np.ndarray, transposed: bool) -> np.ndarray:
    """Return the weights of a convolution in the order of axes that ONNX requires.

    Args:
        weight: (O, I, kh, kw), with O the channels that are written.
        transposed: True for a transposed convolution.

    Returns:
        (O, I, kh, kw), or (I, O, kh, kw) for a transposed convolution.
    """
    return np.ascontiguousarray(weight.swapaxes(0, 1)) if transposed else weight


def write_float(w: GraphWriter, op: Op, feeds: Sequence[str], output: str) -> None:
    """Write an operation with ONNX's own operators.

    Args:
        w: the writer that receives the nodes.
        op: the operation.
        feeds: the names of the tensors that the nodes read; for a convolution also those of its
            weights and bias.
        output: the name of the result.
    """
    # The operator of a Pointwise is its activation, so that none follows.
    activation = Activation.none
    if not isinstance(op, Pointwise):
        activation = getattr(op, "activation", Activation.none)
    result = output if activation is Activation.none else f"{op.output}.linear"
    _WRITERS[type(op)](w, op, list(feeds), result)
    if isinstance(op, Conv) and op.ceiling is not None:
        w.node("Relu", f"{output}.above_0", [result])
        # ONNX's Clip has one limit for all channels, and here each has its own.
        limits = np.asarray(op.ceiling, np.float32)[:, None, None]
        ceiling = w.constant(f"{op.name}.ceiling", limits)
        w.node("Min", output, [f"{output}.above_0", ceiling], f"{op.name}.{activation.name}")
    elif activation is not Activation.none:
        _activation(w, activation, result, output, f"{op.name}.{activation.name}")


def _conv(w: GraphWriter, op: Conv, feeds: list[str], output: str) -> None:
    kind = "ConvTranspose" if op.transposed else "Conv"
    window = {"kernel_shape": list(op.weight.shape[2:]), **window_attributes(op.window, op.groups)}
    w.node(kind, output, feeds, op.name, **window)


def window_attributes(window: Window, groups: int = 1) -> dict[str, Any]:
    """Return a window as ONNX attributes of a convolution or pool: the pads, and others that differ
    from ONNX's defaults.

    Args:
        window: strides, pads and dilations.
        groups: the number of groups of a convolution.
    """
    attributes: dict[str, Any] = {"pads": list(window.pads)}
    if window.strides != (1, 1):
        attributes["strides"] = list(window.strides)
    if window.dilations != (1, 1):
        attributes["dilations"] = list(window.dilations)
    if groups != 1:
        attributes["group"] = groups
    return attributes


ATTRIBUTES: dict[Activation, dict[str, Any]] = {
    Activation.leaky_relu: {"alpha": LEAKY_SLOPE},
    # ONNX's own default is an alpha of 0.2.
    Activation.hard_sigmoid: {"alpha": 1 / 6, "beta": 0.5},
}
"""The attributes of an activation, if they are not ONNX's defaults."""


def _activation(
    w: GraphWriter, activation: Activation, source: str, output: str, name: str
) -> None:
    if activation is Activation.relu6:
        limits = [w.constant(f"limit_{value}", np.array(value, np.float32)) for value in (0, 6)]
        w.node("Clip", output, [source, *limits], name)
    else:
        w.node(activation.value, output, [source], name, **ATTRIBUTES.get(activation, {}))


def _pool(w: GraphWriter, op: MaxPool | AveragePool, feeds: list[str], output: str) -> None:
    if op.kernel is None:
        w.node("GlobalAveragePool", output, feeds, op.name)
        return
    counted: dict[str, Any] = {} if isinstance(op, MaxPool) else {"count_include_pad": 1}
    window = {"kernel_shape": list(op.kernel), **window_attributes(op.window)}
    w.node(type(op).__name__, output, feeds, op.name, **counted, **window)


def _resize(w: GraphWriter, factor: int, mode: str, source: str, output: str, name: str) -> None:
    scales = w.constant(f"resize_by_{factor}", np.array([1, 1, factor, factor], np.float32))
    where = {"coordinate_transformation_mode": "half_pixel"}
    if mode == "nearest":
        where = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
    w.node("Resize", output, [source, "", scales], name, mode=mode, **where)


def write_base(w: GraphWriter, base: Base, image: str) -> str:
    """Write the base to which a network adds its result, and return its name.

    Args:
        w: the writer that receives the nodes.
        base: the part of the image that is added.
        image: the name of the image.
    """
    if base.channels:
        numbers = w.constant("added_channels", np.array(base.channels))
        image = w.node("Gather", "host_back.channels", [image, numbers], axis=1)
    if base.factor > 1:
        _resize(w, base.factor, base.mode, image, "host_back.enlarged", "host_back.enlarge")
        image = "host_back.enlarged"
    return image


def write_shuffle(w: GraphWriter, op: Shuffle, source: str, output: str, channels: int = 1) -> None:
    """Write a pixel shuffle, or its inverse, of a tensor of any type.

    Args:
        w: the writer that receives the nodes.
        op: the shuffle.
        source: the name of the tensor that is read.
        output: the name of the result.
        channels: the number of channels that an unshuffle reads. For several, torch's order of the
            channels needs a further node.
    """
    if op.up:
        mode = "CRD" if op.columns_first else "DCR"
        w.node("DepthToSpace", output, [source], op.name, blocksize=op.block, mode=mode)
    elif not op.columns_first or channels == 1:
        w.node("SpaceToDepth", output, [source], op.name, blocksize=op.block)
    else:
        # ONNX's SpaceToDepth has its own order only, the blocks' places before the channels.
        taps = op.block**2
        places = np.arange(taps * channels).reshape(taps, channels)
        order = w.constant(f"{op.name}.order", places.T.ravel())
        blocks = w.node("SpaceToDepth", f"{output}.blocks", [source], op.name, blocksize=op.block)
        w.node("Gather", output, [blocks, order], f"{op.name}.channels", axis=1)


_WRITERS: dict[type, Callable[..., None]] = {
    Conv: _conv,
    **dict.fromkeys(
        (Add, Mul), lambda w, op, feeds, output: w.node(type(op).__name__, output, feeds, op.name)
    ),
    Concat: lambda w, op, feeds, output: w.node("Concat", output, feeds, op.name, axis=1),
    MaxPool: _pool,
    AveragePool: _pool,
    Resize: lambda w, op, feeds, output: _resize(
        w, op.factor, "linear" if op.bilinear else "nearest", feeds[0], output, op.name
    ),
    Shuffle: lambda w, op, feeds, output: write_shuffle(w, op, feeds[0], output),
    Pointwise: lambda w, op, feeds, output: _activation(
        w, op.activation, feeds[0], output, op.name
    ),
}
