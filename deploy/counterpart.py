"""The other precision of a network: float32 for an INT8 file of ours, INT8 for a float one."""

import onnx

from deploy.defaults import float_model
from model.shipped import SHIPPED, shipped_names, shipped_weights
from quant.onnx_file import load_onnx, metadata


def counterpart(model: onnx.ModelProto) -> onnx.ModelProto | None:
    """A shipped network of the same variant in the other precision, or None; its weights may be others.

    Time depends on the shapes, not on the weights: for a comparison of time any weights will do.
    """
    variant = metadata(model).get("variant", "")
    if is_quantised(model):
        return float_model(shipped_weights(variant)) if variant in shipped_names() else None
    int8 = SHIPPED / f"{variant}-int8.onnx"
    return load_onnx(int8) if variant and int8.is_file() else None


def is_quantised(model: onnx.ModelProto) -> bool:
    """Whether any node computes on, makes or reads quantised numbers."""
    return any("QLinear" in n.op_type or n.op_type.endswith("quantizeLinear") for n in model.graph.node)
