"""Short lists of numbers that a file computes from constants alone, such as the sizes for Pad or Resize.

Exporters leave a dozen nodes to state four sizes. They are computed by onnx's reference in Python, before a runtime
has the file: so the sizes that follow are known, and looked at like those that a file states.
"""

from collections.abc import Sequence

import numpy as np
import onnx

LIST_VALUES = 4096
"""Of one list; a runtime that computes with such ones is done in a moment."""

OPERATORS = {
    "Add", "Cast", "Concat", "ConstantOfShape", "Div", "Gather", "Identity", "Mul", "Neg", "Reshape", "Shape",
    "Slice", "Sqrt", "Squeeze", "Sub", "Transpose", "Unsqueeze",
}  # fmt: skip


def computed(node: onnx.NodeProto, values: Sequence[np.ndarray | None], opset: int) -> np.ndarray | None:
    """What a node computes of short lists, None where that is no short list of numbers or not computed here.

    Args:
        node: an operator of ONNX's own.
        values: its inputs, None for one that is not known; the caller has bounded what ConstantOfShape makes.
        opset: the version of the operators.
    """
    short = all(value is not None and value.size <= LIST_VALUES for value in values)
    if node.op_type not in OPERATORS or not short:
        return None
    from onnx.reference import ReferenceEvaluator  # half a second, of files alone that compute

    try:
        with np.errstate(all="ignore"):
            feeds = dict(zip(node.input, values, strict=True))
            result = next(iter(ReferenceEvaluator(node, opsets={"": opset}).run(None, feeds)))
    except Exception:  # noqa: BLE001 - whatever the reference raises of a node that is none means: not known
        return None
    array = np.asarray(result)
    return array if array.dtype.kind in "biuf" and array.size <= LIST_VALUES else None
