"""Determine the domain of a node's operator, because ONNX identifies an operator by domain and
name.

A `Relu` of another domain, or of a function that the file itself defines, may compute anything.
Nodes are therefore always distinguished by `operator_name`: ONNX's own operators have their bare
names, and all others are prefixed with their domain, so that they match no table of this project.
"""

from collections.abc import Collection

from onnx import ModelProto, NodeProto

OPSET = 17
IR_VERSION = 8
"""The versions of ONNX's operators (OPSET) and file format (IR_VERSION) that this
project writes.
"""
STANDARD = ("", "ai.onnx")
MICROSOFT = "com.microsoft"
SEPARATOR = "::"

INTEGER_OPERATORS = {
    "DequantizeLinear",
    "QLinearAdd",
    "QLinearAveragePool",
    "QLinearConcat",
    "QLinearGlobalAveragePool",
    "QLinearLeakyRelu",
    "QLinearMul",
    "QLinearReduceMean",
    "QLinearSigmoid",
    "QLinearSoftmax",
    "QLinearWhere",
    "QuantizeLinear",
}
"""Operators of onnxruntime's domain: those that ONNX lacks, and the pair that ONNX also has with
the same meaning for int8 and uint8. QLinearConv is not among them, because it may read (N, H, W,
C).
"""

INLINE = "inline its functions first: onnx.inliner.inline_local_functions(model)"
QDQ = "write the file with QuantizeLinear and DequantizeLinear (QDQ format)"
FLOAT = "give the float file, because this one was quantised dynamically"
UNOPTIMISED = (
    "give the file that onnxruntime read, because what it saves after its optimisation has "
    "operators of its own "
    "(ORT_ENABLE_BASIC adds none)"
)
OTHERS = "export the network with operators of ONNX itself"


Functions = Collection[tuple[str, str]]
"""Domain and name of each function that a file defines."""


def opset_of(model: ModelProto) -> int:
    """Return the version of ONNX's standard operators that a model imports; 1 if it states none."""
    versions = [opset.version for opset in model.opset_import if opset.domain in STANDARD]
    return max(versions, default=1)


def functions_of(model: ModelProto) -> Functions:
    """Return domain and name of each function that a file itself defines from ONNX's operators."""
    return {(function.domain, function.name) for function in model.functions}


def operator_name(node: NodeProto, functions: Functions = ()) -> str:
    """Return the name by which this project looks a node's operator up in its tables.

    Operators of ONNX, and onnxruntime's operators on integers, have their bare names, such as
    "Conv". Any other has its domain in front, such as "my.domain::Conv", so that it matches no
    table.

    Args:
        node: the node of a file.
        functions: domain and name of each function that the file defines, as `functions_of` returns
            them. A function may have the name of an operator of ONNX.
    """
    if (node.domain, node.op_type) in functions:
        return f"{node.domain}{SEPARATOR}{node.op_type}"
    # With `channels_last` onnxruntime's operators read (N, H, W, C), which ONNX's never do.
    transposed = any(
        attribute.name == "channels_last" and attribute.i for attribute in node.attribute
    )
    integer = node.domain == MICROSOFT and node.op_type in INTEGER_OPERATORS and not transposed
    if node.domain in STANDARD or integer:
        return str(node.op_type)
    return f"{node.domain}{SEPARATOR}{node.op_type}"


def is_foreign(name: str) -> bool:
    """Return True if an operator is neither ONNX's nor one of onnxruntime's on integers.

    Args:
        name: the name of the operator, as `operator_name` returns it.
    """
    return SEPARATOR in name


def foreign_remedy(domain: str, op_type: str) -> str:
    """Return advice for a user whose file has an operator that is not ONNX's own.

    Args:
        domain: the domain of the operator.
        op_type: the name of the operator without its domain.

    Returns:
        A clause for a message, such as on how to write the file again.
    """
    if op_type.startswith("Dynamic"):
        return FLOAT
    if "QuantizeLinear" in op_type or op_type == "FixNeuron":
        return QDQ
    return UNOPTIMISED if domain.startswith(MICROSOFT) else OTHERS
