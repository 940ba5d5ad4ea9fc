"""Fold operations that scale and shift each channel into the convolutions next to them.

1. A Sub of two maps becomes a product by -1 and an Add.
2. A BatchNormalization, a Neg, or arithmetic with one constant per channel, is folded into the
   convolution that it follows, if nothing else reads that convolution's result.
3. Operations in front of convolutions are folded into all of them, if that is exact: the zeros that
   a convolution pads with are not shifted.
4. A remaining BatchNormalization, Div or Neg of maps becomes a depthwise convolution of one pixel,
   and arithmetic of one channel with several constants one that writes several channels.

All of it is exact except for the rounding of float32, borders included.
"""

from dataclasses import dataclass

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement

NORMALISATION = "BatchNormalization"
LACKING = {NORMALISATION, "Div", "Neg"}
"""Operators that a DPU does not compute."""
PARTS = {"Erf", "Sigmoid"}


@dataclass(frozen=True)
class Affine:
    """The function scale * x + shift of each channel of a map.

    Attributes:
        scale: (C,) float64, or (1,) for all channels.
        shift: (C,) float64, or (1,) for all channels.
    """

    scale: np.ndarray
    shift: np.ndarray

    @property
    def channels(self) -> int:
        """The number of channels; 1 if scale and shift apply to all channels."""
        return max(len(self.scale), len(self.shift))


IDENTITY = Affine(np.ones(1), np.zeros(1))
NEGATION = Affine(-np.ones(1), np.zeros(1))


def add_negated(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a - b by a + (-b), where the convolution that computes b is negated, or a product by
    -1 is new (point 1 of the module).

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The Add, behind a product where that is new; None if the node is no Sub of two float maps.
    """
    is_of_maps = graph.constants.keys().isdisjoint(node.inputs)
    if node.op_type != "Sub" or not is_of_maps or node.inputs[1] not in graph.shapes:
        return None
    result = node.result
    before = graph.sole_writer(node.inputs[1])
    if is_convolution(graph, before):
        # This is done at once, so that the tensor keeps its name.
        _fold(graph, before, NEGATION, into_results=True)
        return [Node.new("Add", node.inputs, result, node.proto.name)]
    name = f"{result}.negated"
    factor = graph.add_constant(f"{name}.factor", -1)
    return [
        Node.new("Mul", [node.inputs[1], factor], name),
        Node.new("Add", [node.source, name], result, node.proto.name),
    ]


def fold_behind(graph: OnnxGraph, node: Node) -> Replacement:
    """Fold a node that scales and shifts channels into the convolution in front of it (point 2 of
    the module).

    Args:
        graph: the graph that the node belongs to; the convolution gets other weights.
        node: any node.

    Returns:
        An empty list, because the convolution then computes the node's result. None if the node
        does something else, or if it follows no convolution whose result only it reads.
    """
    match = affine_of(graph, node)
    if match is None:
        return None
    source, affine = match
    before = graph.sole_writer(source)
    if not is_convolution(graph, before) or affine.channels not in (1, _width(graph, before)):
        return None
    _fold(graph, before, affine, into_results=True)
    graph.rename(source, node.result)
    return []


def fold_in_front(graph: OnnxGraph) -> None:
    """Fold nodes that scale and shift channels into the convolutions behind them, where that is
    exact (point 3 of the module).

    Args:
        graph: the graph, which is changed in place; it knows the sizes of its tensors.
    """
    folded = set()
    for node in graph.nodes[::-1]:
        result = node.result
        match = affine_of(graph, node)
        behind = list(dict.fromkeys(graph.readers.get(result, [])))
        if match is None or not behind or result in graph.outputs:
            continue
        source, affine = match
        # One channel times many constants would be many channels.
        if affine.channels not in (1, graph.channels(source)):
            continue
        if all(_may_take_in(graph, reader, result, affine) for reader in behind):
            for reader in behind:
                _fold(graph, reader, affine, into_results=False)
                reader.inputs = (source, *reader.inputs[1:])
            # The map's readers change with each fold, and the loop goes on with what writes it.
            others = [reader for reader in graph.readers[source] if reader is not node]
            graph.readers[source] = others + behind
            folded.add(node)
    graph.set_nodes([node for node in graph.nodes if node not in folded])


def convolve_affine(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a node that scales and shifts channels by a convolution of one pixel (point 4 of the
    module), if it could not be folded and is more than a DPU's product or sum.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The convolution, or an empty list if the node can now be folded into the convolution in
        front of it. None if the node stays.
    """
    # The operator in front may just have become a convolution, which this one can be folded into.
    replacement = fold_behind(graph, node)
    match = affine_of(graph, node)
    channels = graph.channels(match[0]) if match is not None else 0
    if replacement is not None or match is None or not channels:
        return replacement
    source, affine = match
    width = max(channels, affine.channels)
    # A GELU or Swish is recognised by its parts.
    is_part = any(reader.op_type in PARTS for reader in graph.readers[node.result])
    is_lacking = node.op_type in LACKING and not (is_part and node.op_type == "Div")
    if channels not in (1, width) or not (is_lacking or width > channels):
        return None
    weight, shift = (np.broadcast_to(values, width) for values in (affine.scale, affine.shift))
    weight = weight.reshape(-1, 1, 1, 1)
    return [graph.convolution(source, node.result, node.name, weight, shift, group=channels)]


def affine_of(graph: OnnxGraph, node: Node) -> tuple[str, Affine] | None:
    """Return the scale and shift of a node that multiplies channels by constants, and adds
    constants.

    That is a BatchNormalization, a Neg, or an Add, Sub, Mul or Div by one constant per channel.

    Args:
        graph: the graph that the node belongs to.
        node: any node.

    Returns:
        The name of the tensor that is scaled, and scale and shift; None if the node does something
        else.
    """
    if node.op_type == NORMALISATION:
        values = [_float64(graph, node, place) for place in range(1, 5)]
        is_trained = node.attribute("training_mode", 0) or len(node.outputs) > 1
        if is_trained or any(value is None for value in values):
            return None
        gain, offset, mean, variance = values
        scale = gain / np.sqrt(variance + node.attribute("epsilon", 1e-5))
        return node.source, Affine(scale, offset - mean * scale)
    if node.op_type == "Neg":
        return node.source, NEGATION
    if node.op_type not in ("Add", "Div", "Mul", "Sub"):
        return None
    for place, source in enumerate(node.inputs):
        value = per_channel(_float64(graph, node, 1 - place))
        if value is not None and source not in graph.constants:
            affine = _arithmetic(node.op_type, value, place)
            return None if affine is None else (source, affine)
    return None


def affine_chain(graph: OnnxGraph, name: str, is_sole: bool = True) -> tuple[str, Affine]:
    """Follow scalings and shifts by constants upwards from a tensor.

    Args:
        graph: the graph.
        name: the tensor to start from.
        is_sole: True to follow only tensors that nothing else reads.

    Returns:
        The tensor in front of the first of them, and their joint scaling and shift.
    """
    total = IDENTITY
    while match := affine_of(graph, graph.sole_writer(name) if is_sole else graph.writer(name)):
        name, affine = match
        total = Affine(total.scale * affine.scale, total.scale * affine.shift + total.shift)
    return name, total


def _arithmetic(kind: str, value: np.ndarray, place: int) -> Affine | None:
    """Return scale and shift of arithmetic with one constant per channel on the operand at this
    place.
    """
    one = np.ones_like(value)
    zero = np.zeros_like(value)
    if kind == "Add":
        return Affine(one, value)
    if kind == "Mul":
        return Affine(value, zero)
    if kind == "Sub":
        return Affine(one, -value) if place == 0 else Affine(-one, value)
    return Affine(1 / value, zero) if place == 0 and value.all() else None


def per_channel(value: np.ndarray | None) -> np.ndarray | None:
    """Return a constant as one number per channel, if it has that effect on a map (N, C, H, W).

    Args:
        value: a constant that is combined with a map, or None.

    Returns:
        (C,), or (1,) for all channels; None for any other constant.
    """
    if value is None or value.ndim > 4:
        return None
    shape = (1,) * (4 - value.ndim) + value.shape
    return value.reshape(-1) if shape[0] == shape[2] == shape[3] == 1 else None


def _float64(graph: OnnxGraph, node: Node, place: int) -> np.ndarray | None:
    """Return a constant of float32 that a node reads, in float64; None for any other."""
    value = graph.value(node, place)
    return value.astype(np.float64) if value is not None and value.dtype == np.float32 else None


def is_convolution(graph: OnnxGraph, node: Node) -> bool:
    """Return True if a node is a convolution, transposed or not, with constant weights and bias."""
    if node.op_type not in ("Conv", "ConvTranspose"):
        return False
    numbers = [graph.constants.get(name) for name in node.inputs[1:] if name]
    if not all(value is not None and value.dtype == np.float32 for value in numbers):
        return False
    weight = graph.value(node, 1)
    return weight is not None and weight.ndim == 4


def _width(graph: OnnxGraph, node: Node) -> int:
    """Return the channels that a convolution writes."""
    shape = graph.constants[node.inputs[1]].shape
    # A transposed convolution has weights (I, O / groups, kh, kw).
    return int(shape[0] if node.op_type == "Conv" else shape[1] * node.groups)


def _fold(graph: OnnxGraph, node: Node, affine: Affine, into_results: bool) -> None:
    """Fold scale and shift of a convolution's results, or of its input map, into the
    convolution.
    """
    weight = graph.constants[node.inputs[1]].astype(np.float64)
    stated_bias = _float64(graph, node, 2)
    bias = np.zeros(_width(graph, node)) if stated_bias is None else stated_bias
    groups = node.groups
    split = weight.reshape(groups, -1, *weight.shape[1:])
    # A convolution has its weights as (O, I / groups, kh, kw), a transposed one as
    # (I, O / groups, kh, kw): the channels in question stand along the first axis of a group, or
    # along the second.
    stands_first = into_results == (node.op_type == "Conv")
    channels = groups * split.shape[1 if stands_first else 2]
    shape = (groups, -1, 1, 1, 1) if stands_first else (groups, 1, -1, 1, 1)
    scale, shift = (
        np.broadcast_to(v, channels).reshape(shape) for v in (affine.scale, affine.shift)
    )
    if into_results:
        bias = bias * scale.ravel() + shift.ravel()
    elif node.op_type == "Conv":  # `_may_take_in` lets no shift reach a transposed one
        bias = bias + (split * shift).sum(axis=(2, 3, 4)).ravel()
    # Of its own, because the old ones may serve others too.
    name = node.proto.name or node.result
    numbers = {"weight": (split * scale).reshape(weight.shape), "bias": bias}
    names = [graph.add_constant(f"{name}.{role}", value) for role, value in numbers.items()]
    node.inputs = (node.source, *names)


def _may_take_in(graph: OnnxGraph, node: Node, name: str, affine: Affine) -> bool:
    """Return True if scale and shift of the tensor `name` can be folded into a convolution that
    reads it.
    """
    states_pads = node.attribute("auto_pad", "NOTSET") in ("NOTSET", "VALID")
    unpadded = node.op_type == "Conv" and states_pads and not any(node.attribute("pads", []))
    # The zeros of a padding are not shifted, so a shift passes only a convolution without padding.
    exact = unpadded or not affine.shift.any()
    return is_convolution(graph, node) and node.inputs.count(name) == 1 and exact
