"""Reject networks that were exported in training mode, in which Dropout draws and
BatchNormalization adapts.

Such a network returns another result for each run or for each tile. It is rejected before these
nodes are folded.
"""

import numpy as np
import onnx
from onnx import NodeProto

from beers_deploy.profiles.errors import ModelError, printable
from beers_deploy.quant.domains import STANDARD, opset_of
from beers_deploy.quant.onnx.graph import attributes_of, constants

IS_TEST_UNTIL = 6
"""The last opset whose operators state by `is_test` whether they are in inference mode; without it
they are in training mode.
"""
DROPOUT_MODE_INPUT = 2


def require_inference(model: onnx.ModelProto, where: str) -> None:
    """Raise ModelError if a network has a node in training mode.

    Args:
        model: accepted by `check_content`.
        where: name of the network for the message, such as "a.onnx" or "the float network".

    Raises:
        ModelError: a Dropout or a BatchNormalization in training mode, or in a mode that the file
            leaves open.
    """
    opset = opset_of(model)
    values = constants(model)
    for node in model.graph.node:
        if (
            node.domain in STANDARD
            and node.op_type in TRAINED
            and TRAINED[node.op_type](node, opset, values)
        ):
            name = printable(repr(node.name or node.output[0]))
            raise ModelError(
                f"{node.op_type} {name} in {where} is in training mode, so that the result is not "
                "a function of the image alone. Call model.eval() before you export the network, "
                "or give the exporter its mode for inference."
            )


def _drops(node: NodeProto, opset: int, values: dict[str, np.ndarray]) -> bool:
    """Return True if a Dropout draws: its mode is a third input, and a mode that is computed may be
    any.
    """
    if opset <= IS_TEST_UNTIL:
        return not attributes_of(node).get("is_test", 0)
    if len(node.input) <= DROPOUT_MODE_INPUT or not node.input[DROPOUT_MODE_INPUT]:
        return False
    # A mode that is computed could be anything when the network runs.
    mode = values.get(node.input[DROPOUT_MODE_INPUT])
    return mode is None or bool(mode.any())


def _adapts(node: NodeProto, opset: int, _: dict[str, np.ndarray]) -> bool:
    """Return True if a BatchNormalization computes mean and variance from the image, and returns
    them as further results.

    From opset 14 on an attribute states it as well.
    """
    attributes = attributes_of(node)
    if opset <= IS_TEST_UNTIL:
        return not attributes.get("is_test", 0)
    # Further results are the running mean and variance, which only training computes.
    return bool(attributes.get("training_mode", 0)) or any(node.output[1:])


TRAINED = {"Dropout": _drops, "BatchNormalization": _adapts}
