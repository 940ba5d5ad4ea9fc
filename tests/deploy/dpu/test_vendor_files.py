"""Tests of files from other quantisers: they are read without a crash, and refused only for what
the DPU cannot compute.
"""

import numpy as np
import onnx
import pytest
from onnxruntime.quantization import QuantFormat, QuantType

from tests.deploy.dpu.draws import placed, rules_of
from tests.deploy.dpu.graphs import Sketch
from tests.quant.quick import quantized_freely

TILE_PX = 34


class RandomSketch(Sketch):
    """A sketch whose weights calibrate to sensible scales."""

    def weight(self, *shape: int) -> str:
        return self.constant(
            np.random.default_rng(len(self.constants)).normal(0, 0.1, shape).astype(np.float32)
        )

    def biased(self, source: str, *shape: int) -> str:
        return self.node("Conv", source, self.weight(*shape), self.weight(shape[0]), pads=[1] * 4)


def float_network() -> onnx.ModelProto:
    """Build convolutions with bias, a residual add, a pool and a transposed convolution."""
    s = RandomSketch(1)
    head = s.biased("image", 8, 1, 3, 3)
    stream = s.node("Add", head, s.biased(s.node("Relu", s.biased(head, 8, 8, 3, 3)), 8, 8, 3, 3))
    pooled = s.node("MaxPool", stream, kernel_shape=[2, 2], strides=[2, 2])
    up = s.node("ConvTranspose", pooled, s.weight(8, 8, 4, 4), strides=[2, 2], pads=[1] * 4)
    return s.model(s.biased(s.node("LeakyRelu", up, alpha=26 / 256), 1, 8, 3, 3))


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
