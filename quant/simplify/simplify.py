"""Simplify a float ONNX file as exporters write it, without changing its function.

`quant.onnx_file.load_onnx` does it once for all readers of a file. Afterwards a float network has
these properties:

1. Constants are initializers, each float32 even if it was float16 or float64, and no initializer is
   an input. An image of integers that is cast first is float32, too.
2. There is no Identity, Constant, Dropout, needless Cast, and no arithmetic on constants.
3. There is no BatchNormalization, and no Mul, Add, Sub or Div by one constant per channel, behind a
   convolution that only it reads, nor in front of convolutions where folding is exact. A remaining
   BatchNormalization of images is a depthwise 1 x 1 convolution. Zeros that Pad adds are the
   convolution's own.
4. Sub of two maps is Add, Max, Min and Abs of maps are Adds with ReLU, and so is the maximum over
   channels; Sum is Add, a square is a product, a mean over the image is GlobalAveragePool, a
   maximum over an image of known size MaxPool. HardSwish is one operator, ReLU6 is Clip
   from 0 to 6, and a Clip at 0 alone is ReLU. Activations precede what only moves values. Nothing
   splits or crops a map: each part is computed separately, from the image itself where it mixes
   its channels. Kernels have at most 64 positions. Nothing is computed from the size of the image,
   unless the size has an effect. The channels of the image come first.
5. Operators are those of opset 17, unless one has no form there.
6. The result of a network without padding has the image's size, or a multiple of it: the image is
   mirrored beyond its borders.
7. Inputs, outputs, metadata and remaining nodes have their original names, and each node has one.
   No two convolutions share weights into which something was folded.

A network that needs none of it is returned unchanged, so that its results are the same to the bit.
The same file gives the same bytes. INT8 files are not simplified.

Constants, normalisation behind convolutions, padding and nodes without effect are folded by
onnxruntime's basic optimisation, which every installation has. It uses standard operators only, and
its own tests run on every release. (onnxsim or onnxscript's optimizer would be further packages for
the same.) The passes of this package do the rest, and onnx's own converter changes the opset. Only
models that `quant.onnx.runnable` accepted are simplified, because a runtime opens them.
"""

from copy import deepcopy
from functools import partial
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import onnxruntime as ort
from onnx import (
    GraphProto,
    ModelProto,
    TensorProto,
    defs,
    helper,
    numpy_helper,
    version_converter,
)
from onnx.shape_inference import InferenceError

from beers_deploy.profiles.errors import ModelError, reason_of
from beers_deploy.quant.domains import IR_VERSION, OPSET, opset_of
from beers_deploy.quant.onnx.graph import OnnxGraph, Rewriting
from beers_deploy.quant.onnx.messages import free_name, replace_all
from beers_deploy.quant.simplify.activations_first import (
    activations_first,
    behind_convolutions,
)
from beers_deploy.quant.simplify.branches import JoinBranches
from beers_deploy.quant.simplify.channels import (
    join_written,
    read_unselected,
    repeat_channels,
    split_channels,
)
from beers_deploy.quant.simplify.channels_first import channels_first
from beers_deploy.quant.simplify.convolutions import (
    crop_by_pads,
    split_large_kernel,
    without_groups,
)
from beers_deploy.quant.simplify.fold_affine import (
    add_negated,
    convolve_affine,
    fold_behind,
    fold_in_front,
)
from beers_deploy.quant.simplify.free_sizes import free_rectangle, free_sizes
from beers_deploy.quant.simplify.fully_connected import ConnectByConvolutions, connect_neighbours
from beers_deploy.quant.simplify.image_mixtures import ReadImage
from beers_deploy.quant.simplify.image_residual import add_to_image, clip_last
from beers_deploy.quant.simplify.missing_border import with_missing_border
from beers_deploy.quant.simplify.slices import convolve_slice, slice_by_pads, unshuffle_slices
from beers_deploy.quant.simplify.spelled_activations import (
    halve_before_gelu,
    join_clips,
    join_hard_swish,
    join_sigmoid,
)
from beers_deploy.quant.simplify.standard_operators import (
    choose_by_relu,
    divide_by_reciprocal,
    drop_cast_or_reshape,
    drop_where,
    pool_maximum,
    pool_mean,
    pool_sums,
    replace_powers,
    shrink_by_convolution,
    split_soft_threshold,
    split_sums,
)
from beers_deploy.quant.untrusted import contradictions, held_tensors

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
"""Operators behind which nothing can be folded if they read no constants but weights."""

ALTERING = [
    "CommonSubexpressionElimination",
    "SliceConcatToSpaceToDepthFusion",
    "TransposeOptimizer",
]
"""Optimisers of onnxruntime that change the network: they merge layers of equal weights, turn
slices into a Gather, and prevent pixel shuffles from being recognised.
"""

INTEGERS = (TensorProto.UINT8, TensorProto.UINT16)
OTHER_FLOATS = (TensorProto.FLOAT16, TensorProto.BFLOAT16, TensorProto.DOUBLE)


def simplify(model: ModelProto, where: str) -> ModelProto:
    """Rewrite a float network as exporters write it to the form that the rest of this project
    reads.

    Its function does not change. The description of the module lists what holds afterwards.

    Args:
        model: a model that `check_content` and `check_runnable` accepted; not changed.
        where: name of the network for messages, such as "a.onnx".

    Returns:
        The network; `model` itself if nothing has to be changed.
    """
    with contradictions(where):
        network = model if _is_plain(model) else _simplified(model, where)
        network = free_rectangle(behind_convolutions(activations_first(network)))
        return with_missing_border(network)


def _simplified(model: ModelProto, where: str) -> ModelProto:
    network = deepcopy(model)
    _to_float_image(network.graph)
    _to_float32(network)
    channels_first(network)
    weights = {tensor.name for tensor in network.graph.initializer}
    inputs = [value for value in network.graph.input if value.name not in weights]
    outputs = list(network.graph.output)
    # An initializer that is an input too could be replaced when the network runs, so that the
    # runtime would fold nothing that reads it.
    replace_all(network.graph.input, inputs)
    network.ir_version = IR_VERSION
    # Sizes that an older operator holds itself become constants first, which are then folded.
    if opset_of(model) < OPSET:
        network = _of_our_opset(network)
    network = free_sizes(_folded(network, where), partial(_folded, where=where))
    _run_passes(network)
    # Inputs and outputs stay as the file states them.
    replace_all(network.graph.input, inputs)
    replace_all(network.graph.output, outputs)
    _tidy(network, model)
    return network


def _run_passes(model: ModelProto) -> None:
    """Rewrite the nodes of a network in place, without renaming its inputs and outputs."""
    graph = OnnxGraph(model)
    graph.infer_shapes()
    for replacement in (
        JoinBranches(),
        slice_by_pads,
        clip_last,
        split_soft_threshold,
        choose_by_relu,
        replace_powers,
        divide_by_reciprocal,
        drop_where,
        join_written,
    ):
        graph.rewrite(replacement)
    # Nodes that were replaced would count as readers.
    graph.save()
    graph.infer_shapes()
    for rewriting in (
        split_sums,
        join_clips,
        join_hard_swish,
        halve_before_gelu,
        add_negated,
        add_to_image,
        join_sigmoid,
        crop_by_pads,
        fold_behind,
        without_groups,
        split_large_kernel,
    ):
        graph.rewrite(rewriting)
    graph.save()
    graph.infer_shapes()
    fold_in_front(graph)
    for with_shapes in (
        repeat_channels,
        drop_cast_or_reshape,
        pool_mean,
        pool_sums,
        pool_maximum,
        connect_neighbours,
        shrink_by_convolution,
        convolve_affine,
        unshuffle_slices,
        split_channels,
        convolve_slice,
        # A normalisation that has become a convolution absorbs the operators around it.
        fold_behind,
    ):
        graph.rewrite(with_shapes)
    fold_in_front(graph)
    for last in (read_unselected, ReadImage(graph), ConnectByConvolutions()):
        graph.rewrite(last)
    graph.save()


def _is_plain(model: ModelProto) -> bool:
    weights = {tensor.name for tensor in model.graph.initializer}
    is_of_plain_operators = (
        opset_of(model) == OPSET
        and not any(tensor.data_type in OTHER_FLOATS for tensor in model.graph.initializer)
        and not any(value.name in weights for value in model.graph.input)
        and all(
            node.op_type in PLAIN
            and node.name
            and (weights.isdisjoint(node.input) or "Conv" in node.op_type)
            for node in model.graph.node
        )
    )
    if not is_of_plain_operators:
        return False
    graph = OnnxGraph(model)
    graph.infer_shapes()
    rewritings: list[Rewriting] = [
        without_groups,
        split_large_kernel,
        ReadImage(graph),
        repeat_channels,
    ]
    return not any(
        node.attribute("ceil_mode") or any(rewriting(graph, node) for rewriting in rewritings)
        for node in graph.nodes
    )


def _to_float_image(graph: GraphProto) -> None:
    """Let an image of integers that is cast before anything is computed be float32."""
    images = {v.name for v in graph.input if v.type.tensor_type.elem_type in INTEGERS}
    for node in graph.node:
        if node.op_type == "Transpose" and images.intersection(node.input):
            images.update(node.output)
    readers = {node.op_type for node in graph.node if images.intersection(node.input)}
    if readers <= {"Cast", "Transpose"}:
        for value in (*graph.input, *graph.value_info):
            if value.name in images:
                value.type.tensor_type.elem_type = TensorProto.FLOAT


def _to_float32(model: ModelProto) -> None:
    """Convert floats of 16 and 64 bits to float32, in weights and in all computations."""
    graph = model.graph
    for value in (*graph.input, *graph.output, *graph.value_info):
        if value.type.tensor_type.elem_type in OTHER_FLOATS:
            value.type.tensor_type.elem_type = TensorProto.FLOAT
    for tensor in held_tensors(graph):
        if tensor.data_type in OTHER_FLOATS:
            # Values that overflow are infinite, and are refused as such.
            with np.errstate(over="ignore"):
                values = numpy_helper.to_array(tensor).astype(np.float32)
            tensor.CopyFrom(numpy_helper.from_array(values, tensor.name))
    for attribute in chain.from_iterable(node.attribute for node in graph.node):
        if attribute.name in ("to", "dtype"):
            attribute.i = TensorProto.FLOAT if attribute.i in OTHER_FLOATS else attribute.i


def _folded(model: ModelProto, where: str) -> ModelProto:
    """Apply onnxruntime's basic optimisation, and return the network with operators of this
    project's opset.
    """
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.intra_op_num_threads = 1
    # Failures are raised, so the runtime need not print them as well.
    options.log_severity_level = 4
    network = ModelProto()
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
    return _of_our_opset(network)


def _of_our_opset(model: ModelProto) -> ModelProto:
    """Convert a network to this project's opset; return it unchanged if that is not possible."""
    version = opset_of(model)
    replace_all(model.opset_import, [helper.make_opsetid("", version)])
    if version == OPSET:
        return model
    try:
        converted = version_converter.convert_version(model, OPSET)
    except (InferenceError, RuntimeError, ValueError):
        return model
    # Enlargements of older opsets start at the corner. The converter leaves the default, which is
    # shifted by half a pixel.
    modes = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
    resizes = (node for node in converted.graph.node if node.op_type == "Resize")
    for node in resizes if version < RESIZE_HAS_MODES else ():
        attributes = [a for a in node.attribute if a.name not in modes]
        attributes += [helper.make_attribute(*mode) for mode in modes.items()]
        replace_all(node.attribute, attributes)
    # The converter leaves attributes that the operator of our opset lacks. onnxruntime has written
    # their defaults.
    for node in converted.graph.node if version > OPSET else ():
        newer, ours = (defs.get_schema(node.op_type, v).attributes for v in (version, OPSET))
        attributes = [
            a for a in node.attribute if a.name in ours or a != newer[a.name].default_value
        ]
        replace_all(node.attribute, attributes)
    return converted


RESIZE_HAS_MODES = 11


def _tidy(network: ModelProto, model: ModelProto) -> None:
    """Restore the metadata of the original file, and remove constants that no node reads."""
    network.ir_version = IR_VERSION
    network.producer_name = model.producer_name
    network.producer_version = model.producer_version
    replace_all(network.metadata_props, model.metadata_props)
    graph = network.graph
    graph.name = model.graph.name
    graph.ClearField("value_info")
    reads = set(chain.from_iterable(node.input for node in graph.node))
    reads.update(value.name for value in graph.output)
    constants = [tensor for tensor in graph.initializer if tensor.name in reads]
    # In the order of their names, so that the same file gives the same bytes.
    replace_all(graph.initializer, sorted(constants, key=lambda tensor: str(tensor.name)))
    name_counts = dict.fromkeys((node.name for node in graph.node), 0)
    for node in graph.node:
        if not node.name:
            node.name = free_name(node.output[0] or node.op_type, name_counts)
