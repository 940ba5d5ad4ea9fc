"""A float ONNX network as a graph: what comes in from outside is looked at once, here.

Only what ConvBEERS is made of is accepted (convolution, ReLU, add), and the graph must end with the global add. That
add is left out here: the network keeps only the correction, and the host adds it to the 12-bit image.
"""

from dataclasses import replace

import numpy as np
import onnx
from onnx import numpy_helper

from profiles.errors import ModelError
from quant.accepted import check_graph, refused_graph
from quant.graph import CORRECTION, IMAGE, Add, Conv, Graph, Op
from quant.untrusted import contradictions


def correction_graph(model: onnx.ModelProto) -> Graph:
    """The operations from `image` to `correction`, in order, the global add taken off.

    Raises:
        ModelError: an operation of another kind, no global add at the end, or as `quant.accepted` says.
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
