"""Whether an ONNX file may be run: what a runtime would do for a stranger's file, looked for before it has it.

A runtime takes the memory that sizes ask for, some of it while loading, to fold constants; it repeats what a loop
says, and calls the library that a foreign operator names. So a file to be run keeps to ONNX's own operators, each run
once, and to the one of onnxruntime's that `quant.host_file` writes; nothing in it is made by a size that is absurd.

Who runs somebody's network runs somebody's program all the same: what it takes for an image is not bounded here.
"""

import onnx
from onnx import AttributeProto, NodeProto, TensorProto, numpy_helper

from quant.untrusted import RANK, check_size, refused, times

WINDOW_PX = 1024
"""Kernel, stride, dilation or padding of a window, or a factor of enlargement."""

STANDARD = ("", "ai.onnx")
ONNXRUNTIMES = {("com.microsoft", "QLinearAdd")}

WINDOWS = {"kernel_shape", "strides", "dilations", "pads", "output_padding", "blocksize"}
SIZES = {"CenterCropPad": (1,), "Expand": (1,), "MaxUnpool": (2,), "OneHot": (1,), "Resize": (3,)}
"""Operators with an input that says how large the result is, and which."""
FACTORS = {"Pad": (1,), "Resize": (2,), "Tile": (1,), "Upsample": (1,)}
"""The same, of an input that says by how much larger."""
KEEPING = {
    "Cast", "Constant", "DequantizeLinear", "Identity", "Neg", "QuantizeLinear", "Reshape", "Sqrt", "Squeeze",
    "Transpose", "Unsqueeze",
}  # fmt: skip
"""What may be computed of constants alone: no result of these is larger than what they read."""


def check_runnable(model: onnx.ModelProto, where: str) -> None:
    """Refuse a model that no runtime of ours should open.

    Raises:
        ModelError: foreign operators, functions, loops, sparse weights, or results of absurd sizes.
    """
    if model.functions or model.graph.sparse_initializer:
        raise refused(where, "plain operators and weights", "functions or sparse weights", "export it without them")
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    of_image = {value.name for value in model.graph.input} - set(constants)
    for node in model.graph.node:
        _check_operator(node, where)
        _check_windows(node, where)
        _check_growth(node, constants, of_image, where)
        if of_image.intersection(node.input):
            of_image.update(node.output)
        elif node.op_type not in KEEPING:
            got, remedy = f"{node.op_type} of constants alone", "fold its constants"
            raise refused(where, "operators that work on the image", got, remedy)
        values = [a.t for a in node.attribute if a.name == "value"]
        if node.op_type == "Constant" and values:
            constants[node.output[0]] = values[0]


def _check_operator(node: NodeProto, where: str) -> None:
    if node.domain not in STANDARD and (node.domain, node.op_type) not in ONNXRUNTIMES:
        got = f"{node.op_type} of {node.domain!r}"
        raise refused(where, "operators of ONNX itself", got, "export it without operators of others")
    if any(a.HasField("g") or a.graphs or a.HasField("sparse_tensor") for a in node.attribute):
        raise refused(where, "nodes that run once", f"{node.op_type} with a graph within", "unroll it")


def _check_windows(node: NodeProto, where: str) -> None:
    for attribute in node.attribute:
        if attribute.name in WINDOWS and attribute.type in (AttributeProto.INT, AttributeProto.INTS):
            largest = max(map(abs, (attribute.i, *attribute.ints)))
            if largest > WINDOW_PX:
                got = f"{attribute.name} of {largest} in {node.op_type}"
                raise refused(where, f"windows of at most {WINDOW_PX} pixels", got, "export the network again")
        elif attribute.name in ("shape", "output_shape"):
            check_size(node.op_type, attribute.ints, where)


def _check_growth(node: NodeProto, constants: dict[str, TensorProto], of_image: set[str], where: str) -> None:
    """A size that the file holds is looked at; one of the image's own is its matter; any other could be anything."""
    for places, absolute in ((SIZES, True), (FACTORS, False)):
        for name in (node.input[i] for i in places.get(node.op_type, ()) if i < len(node.input)):
            if not name or name in of_image:
                continue
            if name not in constants:
                raise refused(where, "sizes that the file states", f"a computed one in {node.op_type}", "fold it")
            if absolute:
                check_size(node.op_type, _values(constants[name]), where)
            else:
                _check_factor(node.op_type, _values(constants[name]), where)


def _check_factor(name: str, values: list[float], where: str) -> None:
    if not max(map(abs, values), default=0) <= WINDOW_PX:
        remedy = "export the network again"
        raise refused(where, f"enlargements of at most {WINDOW_PX}", f"{name} by {times(values)}", remedy)


def _values(tensor: TensorProto) -> list[float]:
    """At most one more than any list of sizes has."""
    return [float(value) for value in numpy_helper.to_array(tensor).ravel()[: 2 * RANK + 1]]
