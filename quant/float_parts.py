"""Find the layers that an INT8 file computes in float.

Such a file may contain a whole float network before or behind its integer core. Both networks then
agree, and the gate would pass a file that no DPU computes. Its metadata is no evidence, because the
judged file wrote it.
"""

from onnx import ModelProto

from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.figures import Check
from beers_deploy.quant.encodings import read_core
from beers_deploy.quant.graph.quantized import Integers
from beers_deploy.quant.onnx.graph import Node, OnnxGraph

LAYERS = {
    "Attention",
    "Conv",
    "ConvTranspose",
    "DeformConv",
    "Einsum",
    "FusedConv",
    "FusedGemm",
    "FusedMatMul",
    "GRU",
    "Gemm",
    "If",
    "LSTM",
    "Loop",
    "MatMul",
    "MultiHeadAttention",
    "NhwcFusedConv",
    "RNN",
    "Scan",
}
"""Operators with weights, and those that contain a graph of their own."""


def float_nodes(model: ModelProto) -> list[Node]:
    """List the nodes of an INT8 file that compute in float.

    All nodes count except those that compute on integers, and those that only define how integers
    are read (QuantizeLinear and DequantizeLinear).
    """
    graph = OnnxGraph(model)
    integers = Integers(graph)
    return [
        node
        for node in graph.nodes
        if not integers.is_integer(node) and not integers.is_notation(node)
    ]


def float_layers_check(model: ModelProto) -> Check:
    """Return the check that an INT8 file computes no layer in float.

    The check's value is the number of float nodes that have weights or contain a graph of their
    own, and its limit is 0.
    """
    layers = [str(node) for node in float_nodes(model) if node.op_type in LAYERS]
    return Check("layers computed in float", len(layers), 0, "layer", detail=", ".join(layers[:3]))


def float_note(model: ModelProto) -> list[str]:
    """Return a note for the user that names the operators which another quantiser's file computes
    in float.

    A file of this project gets none, because its float operators are the host part, which
    `encoding_faults` compares node by node.

    Args:
        model: an INT8 network.

    Returns:
        A list of one sentence, or an empty list.
    """
    try:
        read_core(model)
    except ModelError:
        kinds = sorted(
            {node.op_type for node in float_nodes(model)} - {"QuantizeLinear", "DequantizeLinear"}
        )
        if kinds:
            names = ", ".join(kinds)
            note = (
                f"the INT8 file computes {names} in float, which the board's processor has to "
                "compute alike"
            )
            return [note]
    return []
