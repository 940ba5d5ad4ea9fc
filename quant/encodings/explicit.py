"""Make files explicit: nothing is left to a default, as the draft of ONNX's safety-related profile
requires.

The profile (SONNX, working group of ONNX) forbids default values of attributes (REQ-OP-070) and
shape inference (REQ-GR-000), and requires descriptions of inputs and outputs (REQ-FO-040). Its
requirements are in onnx/working-groups, safety-related-profile/deliverables/reqs, read at commit
1598dbc.
"""

from collections.abc import Iterator
from importlib.metadata import version

import onnx
from onnx import AttributeProto, ModelProto, NodeProto, helper, shape_inference

from beers_deploy.profiles.errors import OptionError
from beers_deploy.quant.domains import STANDARD, opset_of

WINDOW_DEFAULTS = {
    "strides": [1, 1],
    "dilations": [1, 1],
    "pads": [0, 0, 0, 0],
    "output_padding": [0, 0],
}
"""Defaults of windows over rows and columns, which ONNX states in prose only."""
OPERATORS = frozenset(
    """Abs Add Cast Clip Concat Constant ConstantOfShape Conv ConvTranspose Div Equal Erf Exp
    Expand Flatten Gather Gemm GlobalAveragePool GRU HardSwish Identity LeakyRelu Less Log LSTM
    MatMul Max MaxPool Min Mod Mul Neg Not Pad Pow Range ReduceMean ReduceSum Relu Reshape Resize
    ScatterND Shape Sigmoid Slice Softmax Softplus Split Sqrt Squeeze Sub Tanh Transpose Unsqueeze
    Where""".split()  # noqa: SIM905 - it reads as the list that it was copied from
)
"""ONNX's operators in the profile's first list (REQ-OP-000)."""


def made_explicit(model: ModelProto, texts: dict[str, str]) -> ModelProto:
    """Return a model that computes the same and leaves nothing to defaults: attributes, shapes and
    producer are stated.

    Args:
        model: a model of ONNX's own operators. Its attributes and descriptions are changed in
            place.
        texts: the descriptions of the graph, its inputs and its outputs, by their names.

    Returns:
        A model with the shape of every tensor that ONNX can infer.

    Raises:
        OptionError: the shapes contradict each other, as in a tile of another size than that for
            which the network was exported.
    """
    opset = opset_of(model)
    for node in model.graph.node:
        node.attribute.extend(_defaults(node, opset))
    for part in (model.graph, *model.graph.input, *model.graph.output):
        part.doc_string = texts[part.name]
    model.producer_version = version("beers-deploy")
    try:
        return shape_inference.infer_shapes(model, strict_mode=True)
    except shape_inference.InferenceError as error:
        raise OptionError(
            "The network does not fit this `tile`, because its layers would have sizes that do not "
            "match. Give a multiple of its strides, or the size that it was exported for."
        ) from error


def implicit_parts(model: ModelProto) -> dict[str, list[str]]:
    """List the parts of a model that the safety-related profile of ONNX does not allow to be
    implicit.

    Args:
        model: any ONNX model.

    Returns:
        A dict from a description of each rule to the names of the nodes, tensors or operators that
        do not comply; an empty list if all comply.
    """
    graph = model.graph
    opset = opset_of(model)
    ends = [*graph.input, *graph.output]
    types = {value.name: value.type.tensor_type for value in (*graph.value_info, *ends)}
    sized = {
        name
        for name, tensor in types.items()
        if tensor.elem_type and all(dim.dim_value for dim in tensor.shape.dim)
    }
    tensors = [value.name for value in graph.input]
    for node in graph.node:
        tensors += node.output
    producer = {"name": model.producer_name, "version": model.producer_version}
    unset = []
    for node in graph.node:
        unset += [f"{node.name}: {attribute.name}" for attribute in _defaults(node, opset)]
    return {
        "attributes left to a default (REQ-OP-070)": unset,
        "tensors without a stated size (REQ-GR-000)": [t for t in tensors if t not in sized],
        "inputs and outputs without a description (REQ-FO-040)": [
            value.name for value in ends if not value.doc_string
        ],
        "name or version of the producer missing": [k for k, text in producer.items() if not text],
        "operators outside the profile's list (REQ-OP-000)": sorted(
            {node.op_type for node in graph.node} - OPERATORS
        ),
    }


def _defaults(node: NodeProto, opset: int) -> Iterator[AttributeProto]:
    """Yield the attributes that a node leaves to their defaults.

    Args:
        node: any node. One that is no operator of ONNX itself has no known defaults.
        opset: the opset of the model, because defaults depend on it.
    """
    stated = {attribute.name for attribute in node.attribute}
    if node.domain not in STANDARD or not onnx.defs.has(node.op_type):
        return
    for name, attribute in onnx.defs.get_schema(node.op_type, opset).attributes.items():
        if name in stated:
            continue
        if attribute.default_value.name:
            yield attribute.default_value
        elif name in WINDOW_DEFAULTS:
            yield helper.make_attribute(name, WINDOW_DEFAULTS[name])
