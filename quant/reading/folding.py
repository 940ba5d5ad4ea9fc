"""A float ONNX file as exporters leave it, turned into its simplest equal: `simplest(model, where)
-> model`.

`quant.onnx_file.load_onnx` calls it for whoever reads a file, once; behind it these hold of a float
network:

- constants are initializers, each float32 where it was float16 too, and no initializer is an input;
- no Identity, Constant, Dropout, needless Cast, no arithmetic on constants;
- no BatchNormalization, and no Mul, Add, Sub or Div by one constant a channel, behind a convolution
  that only it reads, nor in front of convolutions where they are exact; a BatchNormalization of
  images that is left is a depthwise 1 x 1 convolution; zeros that Pad adds are the convolution's
  own;
- Sub of a convolution's result is Add, Sum is Add, a mean over the image is GlobalAveragePool,
  HardSwish is itself, ReLU6 is Clip from 0 to 6;
- operators of opset 17, unless one has no form there; inputs, outputs, metadata and nodes that stay
  keep their names, each node has one, and no two convolutions share what was folded into one of
  them.

A network that needs none of it is returned as it is: its results stay the same to the bit. The same
file gives the same bytes. INT8 files do not come here.

Constants, normalisation behind convolutions, padding and what does nothing are folded by
onnxruntime's basic optimisation, which every installation has: it keeps to standard operators, and
its own tests run on every release. (onnxsim or onnxscript's optimizer would be further packages for
the same.) What it leaves is rewritten by `quant.reading.equivalents`; onnx's own converter changes
the opset. Only what `quant.untrusted` has let through may come here: a runtime opens it.
"""

from copy import deepcopy
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, numpy_helper, version_converter
from onnx.shape_inference import InferenceError

from beers_deploy.profiles.errors import ModelError, reason_of
from beers_deploy.quant.reading.equivalents import rewrite
from beers_deploy.quant.reading.nodes import fresh
from beers_deploy.quant.untrusted import contradictions, held_tensors, opset_of

OPSET = 17
IR_VERSION = 8

PLAIN = {
    "Add",
    "AveragePool",
    "Concat",
    "Conv",
    "ConvTranspose",
    "DepthToSpace",
    "GlobalAveragePool",
    "LeakyRelu",
    "MaxPool",
    "Relu",
}
"""Operators behind which nothing is to be folded, where they read no constants but weights."""

ALTERING = ["CommonSubexpressionElimination", "TransposeOptimizer"]
"""Optimisers of the runtime's that make other networks: layers of equal weights would be one, pixel
shuffles that are spelled out would not be recognised.
"""

HALVES = (TensorProto.FLOAT16, TensorProto.BFLOAT16)


def simplest(model: onnx.ModelProto, where: str) -> onnx.ModelProto:
    """The float network's simplest equal, as the module says.

    Args:
        model: what `check_content` and `check_runnable` let through; not changed.
        where: its file, for the sentence.
    """
    with contradictions(where):
        return model if _is_plain(model) else _simplest(model, where)


def _simplest(model: onnx.ModelProto, where: str) -> onnx.ModelProto:
    network = deepcopy(model)
    _widen(network)
    weights = {tensor.name for tensor in network.graph.initializer}
    inputs = [value for value in network.graph.input if value.name not in weights]
    outputs = list(network.graph.output)
    # An initializer that is an input too could be replaced when the network runs, so that the
    # runtime would fold nothing that reads it.
    _replace(network.graph.input, inputs)
    network.ir_version = IR_VERSION
    # Sizes that an older operator holds itself become constants first, which are then folded.
    if opset_of(model) < OPSET:
        network = _of_our_opset(network)
    network = _of_our_opset(_folded(network, where))
    rewrite(network)
    # Inputs and outputs stay as the file states them.
    _replace(network.graph.input, inputs)
    _replace(network.graph.output, outputs)
    _tidy(network, model)
    return network


def _is_plain(model: onnx.ModelProto) -> bool:
    weights = {tensor.name for tensor in model.graph.initializer}
    return (
        opset_of(model) == OPSET
        and not any(tensor.data_type in HALVES for tensor in model.graph.initializer)
        and not any(value.name in weights for value in model.graph.input)
        and all(
            node.op_type in PLAIN
            and node.name
            and (weights.isdisjoint(node.input) or "Conv" in node.op_type)
            for node in model.graph.node
        )
    )


def _widen(model: onnx.ModelProto) -> None:
    """16-bit floats become float32, where they are weights and wherever they are computed."""
    graph = model.graph
    for value in (*graph.input, *graph.output, *graph.value_info):
        if value.type.tensor_type.elem_type in HALVES:
            value.type.tensor_type.elem_type = TensorProto.FLOAT
    for tensor in held_tensors(graph):
        if tensor.data_type in HALVES:
            values = numpy_helper.to_array(tensor).astype(np.float32)
            tensor.CopyFrom(numpy_helper.from_array(values, tensor.name))
    for attribute in chain.from_iterable(node.attribute for node in graph.node):
        if attribute.name in ("to", "dtype"):
            attribute.i = TensorProto.FLOAT if attribute.i in HALVES else attribute.i


def _folded(model: onnx.ModelProto, where: str) -> onnx.ModelProto:
    """The network as the runtime's basic optimisation leaves it."""
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.intra_op_num_threads = 1
    # What fails is raised, so that a message of the runtime would say it twice.
    options.log_severity_level = 4
    network = onnx.ModelProto()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "folded.onnx"
        options.optimized_model_filepath = str(path)
        try:
            ort.InferenceSession(
                model.SerializeToString(),
                options,
                ["CPUExecutionProvider"],
                disabled_optimizers=ALTERING,
            )
        # onnxruntime raises a class of its own for each status code.
        except Exception as error:
            reason = reason_of(error)
            raise ModelError(
                f"onnxruntime cannot run {where}: {reason}. Check the file with onnx.checker, and "
                "export it again."
            ) from error
        network.ParseFromString(path.read_bytes())
    return network


def _of_our_opset(model: onnx.ModelProto) -> onnx.ModelProto:
    """With operators of our opset; as it is where the converter knows no way, or ours has no such
    operator.
    """
    version = opset_of(model)
    _replace(model.opset_import, [onnx.helper.make_opsetid("", version)])
    if version == OPSET:
        return model
    try:
        converted = version_converter.convert_version(model, OPSET)
    except (InferenceError, RuntimeError, ValueError):
        return model
    if version < RESIZE_HAS_MODES:
        _place_corners(converted)
    return converted


RESIZE_HAS_MODES = 11


def _place_corners(model: onnx.ModelProto) -> None:
    """What older operators enlarge starts at the corner; the converter leaves the default, half a
    pixel off.
    """
    for node in model.graph.node:
        if node.op_type == "Resize":
            modes = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
            attributes = [a for a in node.attribute if a.name not in modes]
            attributes += [onnx.helper.make_attribute(*mode) for mode in modes.items()]
            _replace(node.attribute, attributes)


def _tidy(network: onnx.ModelProto, model: onnx.ModelProto) -> None:
    """What is said beside the graph is the file's own; constants that nothing reads are dropped."""
    network.ir_version = IR_VERSION
    network.producer_name = model.producer_name
    network.producer_version = model.producer_version
    _replace(network.metadata_props, model.metadata_props)
    graph = network.graph
    graph.name = model.graph.name
    graph.ClearField("value_info")
    reads = set(chain.from_iterable(node.input for node in graph.node))
    reads.update(value.name for value in graph.output)
    constants = [tensor for tensor in graph.initializer if tensor.name in reads]
    # In the order of their names, so that the same file gives the same bytes.
    _replace(graph.initializer, sorted(constants, key=lambda tensor: str(tensor.name)))
    name_counts = dict.fromkeys((node.name for node in graph.node), 0)
    for node in graph.node:
        if not node.name:
            node.name = fresh(node.output[0] or node.op_type, name_counts)


def _replace(field: object, values: object) -> None:
    """Put other messages in the place of a repeated field's own."""
    messages = list(values)  # type: ignore[call-overload]
    del field[:]  # type: ignore[attr-defined]
    field.extend(messages)  # type: ignore[attr-defined]
