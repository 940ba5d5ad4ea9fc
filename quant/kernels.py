"""Run INT8 operators that add exactly, also on processors whose fast kernels do not.

x86 processors without VNNI multiply unsigned activations by signed weights and add neighbouring
products in saturating int16 (`vpmaddubsw`). Values beyond the range are clipped silently, which
gives other numbers than the DPU's. On such processors a session computes each operator in the
fastest way that is proven exact, chosen when the file is opened:

1. Signed: weights are not changed, because no two neighbouring products can leave int16, for any
   activations. A tensor behind a ReLU is stored as 128..255 around 128. Moved down to 0..127
   around 0, no weights saturate (a). For other tensors, all pairs of weights that a kernel may form
   are checked (b).
2. Unsigned: weights are stored as uint8, 128 higher and around 128. These kernels add in int32, at
   half the speed.
3. Converted: the same for signed activations, which are converted to uint8 before the operator, and
   back behind it.

Each is the same sum of the same integers, so the results are those of an exact processor, bit for
bit. Float operators between 8-bit tensors (QDQ), of which onnxruntime makes integer ones, are
checked as those integer operators.
"""

from copy import deepcopy
from functools import partial

import numpy as np
from onnx import ModelProto, TensorProto

from beers_deploy.profiles.errors import ModelError, printable
from beers_deploy.quant.domains import opset_of
from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement

INT16 = np.iinfo(np.int16)
MIDDLE = 128
UINT8_MAX = 255


ZERO = 2
"""The input with the zero point of the activations, of every operator in OPERATORS."""


OPERATORS = {"QLinearConv": 3, "QLinearMatMul": 3, "ConvInteger": 1, "MatMulInteger": 1}
"""ONNX's operators whose kernels multiply 8-bit numbers, and the input with the weights. Two behind
it is their zero point. Activations are the first input.
"""

FLOAT_OPERATORS = {"Conv": "QLinearConv", "MatMul": "QLinearMatMul", "Gemm": "QLinearMatMul"}
"""Operators on dequantised tensors (QDQ), and the integer operator that
onnxruntime makes of each.
"""

REQUANTISING = {"QLinearConv", "QLinearAdd"}
"""Operators whose result may be stored 128 lower if a ReLU follows."""
RESULT_ZERO = 7
"""The input of operators with an 8-bit result that holds its zero point."""


def with_exact_sums(model: ModelProto) -> ModelProto:
    """Return an INT8 model that computes the same integers on a processor whose int8 kernels
    saturate.

    `quant.session.open_session` calls it on such a processor. The description of the module says
    which operators are rewritten.

    Args:
        model: an INT8 network; not changed.

    Raises:
        ModelError: an operator has weights that other nodes compute.
    """
    exact = deepcopy(model)
    graph = OnnxGraph(exact)
    largest: dict[str, int] = {}
    graph.rewrite(partial(_move_relu_down, largest))
    graph.rewrite(partial(_add_exactly, largest))
    graph.save()
    return exact


def cannot_saturate(kind: str, weight: np.ndarray, largest: int) -> bool:
    """Return True if an int8 kernel that adds neighbouring products in int16 computes a layer
    exactly.

    That is so if no pair of neighbouring weights can leave int16, for any activations from 0 to
    `largest`.

    Args:
        kind: the ONNX operator.
        weight: int8, (O, I, kh, kw) of a convolution, (..., I, O) of a product of matrices.
        largest: the largest activation as it is stored.
    """
    # The weights of each result in the order of the sum. A convolution's kernels add over the
    # channels of a tap, then tap by tap.
    if kind == "QLinearConv":
        ordered = np.moveaxis(weight.reshape(*weight.shape[:2], -1), 1, 2)
    else:
        ordered = weight if kind == "ConvInteger" else np.moveaxis(weight, -1, 0)
    rows = ordered.reshape(len(ordered), -1).astype(np.int64)
    # Pairs begin at even places. Where an odd number of channels lets them straddle taps, all
    # neighbours count.
    step = 2 if kind == "QLinearConv" and weight.shape[1] % 2 == 0 else 1
    first = rows[:, :-1:step]
    second = rows[:, 1::step]
    highest = np.maximum(first, 0) + np.maximum(second, 0)
    lowest = np.minimum(first, 0) + np.minimum(second, 0)
    return bool((largest * highest <= INT16.max).all() and (largest * lowest >= INT16.min).all())


def _constant(graph: OnnxGraph, value: np.ndarray | np.generic) -> str:
    """Store an integer constant, and return its name."""
    return graph.add_constant("exact", np.asarray(value), value.dtype)


def _set_input(node: Node, place: int, name: str) -> None:
    """Let a node read another tensor; omitted inputs before it get empty names."""
    inputs = [*node.inputs, *[""] * (place + 1 - len(node.inputs))]
    inputs[place] = name
    node.inputs = tuple(inputs)


def _move_relu_down(largest: dict[str, int], graph: OnnxGraph, node: Node) -> Replacement:
    """Store the result of a ReLU, max(result, its zero point), around 0: the result is moved
    down, and the ReLU becomes a Min.

    Nothing is changed if another operator than those above reads the tensor.

    Args:
        largest: receives the largest value that the tensor can store.
        graph: the graph that the node belongs to.
        node: any node.
    """
    middle = graph.value(node, 1) if node.op_type == "Max" and len(node.inputs) == 2 else None
    if middle is None or middle.dtype != np.uint8 or middle.size != 1:
        return None
    result = node.result
    writer = graph.sole_writer(node.source)
    if writer.op_type not in REQUANTISING or result in graph.outputs:
        return None
    readers = graph.readers[result]
    all_hold = _holds(graph, writer, RESULT_ZERO, middle) and all(
        reader.op_type in OPERATORS
        and reader.inputs.count(result) == 1
        and _holds(graph, reader, ZERO, middle)
        for reader in readers
    )
    if not all_hold:
        return None
    # With a zero point of 0 the writer clips at 0 itself, which is the ReLU. What remains is the
    # upper end: 255 around the old zero point is 255 - middle around 0.
    zero = _constant(graph, np.uint8(0))
    largest[result] = UINT8_MAX - int(middle.item())
    _set_input(writer, RESULT_ZERO, zero)
    for reader in readers:
        _set_input(reader, ZERO, zero)
    end = _constant(graph, np.uint8(largest[result]))
    return [node.replaced_by("Min", [node.source, end])]


def _holds(graph: OnnxGraph, node: Node, place: int, value: np.ndarray) -> bool:
    """Return True if a node reads a constant of this value at a place."""
    constant = graph.value(node, place)
    return constant is not None and np.array_equal(constant.ravel(), value.ravel())


def _add_exactly(largest: dict[str, int], graph: OnnxGraph, node: Node) -> Replacement:
    """Return the node computed in an exact way, with the conversions before and behind it.

    Args:
        largest: the largest value that a tensor can store, if it is not that of uint8.
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.
    """
    if node.op_type in FLOAT_OPERATORS:
        return _add_dequantised(graph, node)
    place = OPERATORS.get(node.op_type)
    if place is None:
        return None
    weight = graph.value(node, place)
    if weight is None:
        raise ModelError(
            f"{node.op_type} {printable(repr(node.name))} in the INT8 network has computed "
            "weights, but this processor needs constant ones. Store them as constants, or run the "
            "network on a processor with VNNI."
        )
    activations_end = largest.get(node.source, UINT8_MAX)
    if weight.dtype != np.int8 or cannot_saturate(node.op_type, weight, activations_end):
        return None
    _lift(graph, node, place, place + 2)
    zero = graph.value(node, ZERO)
    if zero is None or zero.dtype != np.int8:
        return None
    # Signed activations are converted to uint8 before the node, and its result back behind it.
    _lift(graph, node, ZERO)
    source = f"{node.source}.unsigned"
    nodes = [node]
    # The activations are converted once for all their readers.
    if source not in graph.writers:
        nodes = [*_moved(graph, node.source, MIDDLE, TensorProto.UINT8, source), node]
    _set_input(node, 0, source)
    # The other operators have a result in int32.
    if node.op_type.startswith("QLinear"):
        _lift(graph, node, RESULT_ZERO)
        result = node.result
        node.outputs = (f"{result}.unsigned",)
        nodes += _moved(graph, node.result, -MIDDLE, TensorProto.INT8, result)
    return nodes


def _add_dequantised(graph: OnnxGraph, node: Node) -> Replacement:
    """Return a float operator on dequantised weights, after the node that dequantises uint8
    ones.
    """
    source = graph.writer(node.inputs[1])
    weight = graph.value(source, 0)
    if source.op_type != "DequantizeLinear" or weight is None or weight.dtype != np.int8:
        return None
    weight = weight.T if node.attribute("transB") else weight
    if cannot_saturate(FLOAT_OPERATORS[node.op_type], weight, UINT8_MAX):
        return None
    # A copy, because another node may read the same weights as int8.
    name = f"{node.result}.weight_from_uint8"
    lifted = Node.new(source.op_type, source.inputs, name, **source.attributes)
    _lift(graph, lifted, 0, 2)
    _set_input(node, 1, name)
    return [lifted, node]


def _lift(graph: OnnxGraph, node: Node, *places: int) -> None:
    """Store int8 constants as uint8, 128 higher."""
    for place in places:
        value = graph.value(node, place)
        # A missing zero point is 0.
        value = np.zeros((), np.int8) if value is None else value
        # The sum is formed in int16, because int8 wraps around above 127.
        lifted = (value.astype(np.int16) + MIDDLE).astype(np.uint8)
        _set_input(node, place, _constant(graph, lifted))


def _moved(graph: OnnxGraph, source: str, by: int, kind: int, result: str) -> list[Node]:
    """Return the nodes that add a number to an 8-bit tensor, and store it in an 8-bit type."""
    wide = f"{result}.wide"
    # ONNX's Add of 8-bit integers would wrap around, so the sum is formed in int32.
    total = f"{result}.moved"
    return [
        Node.new("Cast", [source], wide, to=TensorProto.INT32),
        Node.new("Add", [wide, _constant(graph, np.int32(by))], total),
        Node.new("Cast", [total], result, f"{result}.cast", to=kind),
    ]


# On onnxruntime's integer kernels two output channels took four times as long as sixteen.
FEWEST_OUTPUTS = 16
INPUTS_OF = 4
FIRST_OPSET = 11
"""The first opset in which Pad and Slice have their positions as inputs."""


def with_wide_convolutions(model: ModelProto) -> ModelProto:
    """Return the model with channels of zeros added to integer convolutions that have few channels.

    onnxruntime computes these faster with more channels (FEWEST_OUTPUTS). The results are the same.

    Args:
        model: any network; not changed. One without integer convolutions is returned as it is.
    """
    has_integers = any(node.op_type == "QLinearConv" for node in model.graph.node)
    if not has_integers or opset_of(model) < FIRST_OPSET:
        return model
    wide = deepcopy(model)
    graph = OnnxGraph(wide)
    graph.rewrite(_widen)
    graph.save()
    return wide


def _widen(graph: OnnxGraph, node: Node) -> Replacement:
    """Return a convolution with channels of zeros, and the nodes that widen its input and narrow
    its output.
    """
    weight = graph.value(node, 3) if node.op_type == "QLinearConv" else None
    middle = graph.value(node, 5)
    # A stored 0 must be a weight of 0, and each output read every input.
    is_plain = middle is not None and not middle.any() and node.groups == 1
    if weight is None or weight.ndim != 4 or not is_plain:
        return None
    n_outputs, n_inputs = weight.shape[:2]
    more_inputs = -n_inputs % INPUTS_OF if n_inputs < FEWEST_OUTPUTS else 0
    more_outputs = max(FEWEST_OUTPUTS - n_outputs, 0)
    nodes = [node]
    if more_inputs:
        source = node.source
        padded = f"{source}.padded"
        # Convolutions may share a widened input.
        if padded not in graph.writers:
            pads = _constant(graph, np.array([0, 0, 0, 0, 0, more_inputs, 0, 0]))
            nodes = [Node.new("Pad", [source, pads], padded), node]
        _set_input(node, 0, padded)
    if more_outputs:
        result = node.result
        node.outputs = (f"{result}.filled",)
        places = [_constant(graph, np.array([place])) for place in (0, n_outputs, 1)]
        nodes.append(Node.new("Slice", [*node.outputs, *places], result, f"{result}.cut"))
        # Scale and zero point of the weights, and the bias, may have a number for each channel,
        # which has no effect on a channel of zeros that is cut off.
        for place in (4, 5, 8):
            value = graph.value(node, place)
            if value is not None and value.shape == (n_outputs,):
                _set_input(
                    node, place, _constant(graph, np.pad(value, (0, more_outputs), mode="edge"))
                )
    if more_inputs or more_outputs:
        zeros = [(0, more_outputs), (0, more_inputs), (0, 0), (0, 0)]
        _set_input(node, 3, _constant(graph, np.pad(weight, zeros)))
    return nodes
