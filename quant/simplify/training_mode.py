"""Reject networks that were exported in training mode, in which Dropout draws and
BatchNormalization adapts. Stochastic depth (DropPath) draws by nodes of its own.

Such a network returns another result for each run or for each tile. It is rejected before these
nodes are folded.
"""

from onnx import ModelProto

from beers_deploy.profiles.errors import ModelError, printable
from beers_deploy.quant.domains import opset_of
from beers_deploy.quant.onnx.graph import Node, OnnxGraph

IS_TEST_UNTIL = 6
"""The last opset whose operators state by `is_test` whether they are in inference mode; without it
they are in training mode.
"""
DROPOUT_MODE_INPUT = 2
DRAWING = {"Bernoulli", "RandomNormal", "RandomNormalLike", "RandomUniform", "RandomUniformLike"}


def require_inference(model: ModelProto, where: str) -> None:
    """Raise ModelError if a network has a node in training mode.

    Args:
        model: a model that `check_content` accepted.
        where: name of the network for the message, such as "a.onnx" or "the float network".

    Raises:
        ModelError: a Dropout or a BatchNormalization in training mode, or in a mode that the file
            leaves open.
    """
    graph = OnnxGraph(model)
    opset = opset_of(model)
    for node in graph.nodes:
        if _is_in_training(graph, node, opset):
            raise ModelError(
                f"{node.op_type} {printable(repr(node.name))} in {where} is in training mode, so "
                "that the result is not a function of the image alone. Call model.eval() before "
                "you export the network, or give the exporter its mode for inference."
            )


def _is_in_training(graph: OnnxGraph, node: Node, opset: int) -> bool:
    """Return True if a node draws at random, or a BatchNormalization adapts to the image."""
    if node.op_type in DRAWING:
        return True
    if node.op_type not in ("BatchNormalization", "Dropout"):
        return False
    if opset <= IS_TEST_UNTIL:
        return not node.attribute("is_test", 0)
    if node.op_type == "BatchNormalization":
        # Further results are the running mean and variance, which only training computes. From
        # opset 14 on an attribute states it as well.
        return bool(node.attribute("training_mode", 0)) or any(node.outputs[1:])
    if not any(node.inputs[DROPOUT_MODE_INPUT:]):
        return False
    # A mode that is computed could be anything when the network runs.
    mode = graph.value(node, DROPOUT_MODE_INPUT)
    return mode is None or bool(mode.any())
