"""Tests of files from other quantisers: they are read without a crash, and refused only for what
the DPU cannot compute.
"""

import numpy as np
import onnx
import pytest
from onnxruntime.quantization import QuantFormat, QuantType

from tests.deploy.dpu.draws import placed, rules_of
from tests.deploy.dpu.graphs import SAME
from tests.quant.quick import quantized_freely
from tests.quant.simplify.networks import parsed

TILE_PX = 34


SHAPES = {
    "head": (8, 1, 3, 3),
    "inner": (8, 8, 3, 3),
    "outer": (8, 8, 3, 3),
    "up": (8, 8, 4, 4),
    "last": (1, 8, 3, 3),
}


def float_network() -> onnx.ModelProto:
    """Build convolutions with bias, a residual add, a pool and a transposed convolution."""
    generator = np.random.default_rng(0)
    constants = {f"{name}_w": generator.normal(0, 0.1, shape) for name, shape in SHAPES.items()}
    constants |= {f"{name}_b": generator.normal(0, 0.1, shape[0]) for name, shape in SHAPES.items()}
    nodes = f"""
        a = {SAME}(image, head_w, head_b)
        b = {SAME}(a, inner_w, inner_b) c = Relu(b) d = {SAME}(c, outer_w, outer_b)
        e = Add(a, d) f = MaxPool<kernel_shape=[2,2], strides=[2,2]>(e)
        g = ConvTranspose<strides=[2,2], pads=[1,1,1,1]>(f, up_w)
        h = LeakyRelu<alpha=0.1015625>(g) y = {SAME}(h, last_w, last_b)
    """
    return parsed(nodes, "float[N,1,H,W] image => float[N,1,P,Q] y", constants=constants)


@pytest.mark.parametrize(
    ("form", "kind", "per_channel"),
    [
        (QuantFormat.QDQ, QuantType.QInt8, True),
        (QuantFormat.QDQ, QuantType.QUInt8, False),
        (QuantFormat.QOperator, QuantType.QInt8, False),
        (QuantFormat.QOperator, QuantType.QUInt8, True),
    ],
)
def test_onnxruntimes_files_are_refused_only_for_their_scales_and_types(
    form: QuantFormat, kind: QuantType, per_channel: bool
) -> None:
    signed = kind == QuantType.QInt8
    theirs = quantized_freely(
        float_network(),
        quant_format=form,
        per_channel=per_channel,
        activation_type=kind,
        weight_type=QuantType.QInt8,
        extra_options={"ActivationSymmetric": signed},
    )
    nodes = placed(theirs, TILE_PX).nodes
    expected = (
        {"power of two"}
        | ({"per tensor"} if per_channel else set())
        | (set() if signed else {"symmetric"})
    )
    # Its QDQ files hold int32 biases, its QOperator files the transposed convolution's weights in
    # float.
    expected |= {"int8 bias"} if form == QuantFormat.QDQ else {"int8 constants"}
    assert set(rules_of(nodes)) == expected
    core = [node.op for node in nodes if node.part == "dpu-core"]
    assert {op.kind for op in core} >= {"conv", "add", "pool", "transposed", "activation"}
    assert all(op.out_shape is not None and op.integer for op in core)
