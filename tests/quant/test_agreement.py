"""Tests of the layer-by-layer comparison of the integer reference with onnxruntime."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from beers_deploy.model.shipped import SHIPPED
from beers_deploy.quant.encodings import read_core
from beers_deploy.quant.host_part import IMAGE_SLICES
from beers_deploy.quant.integer.agreement import agreement
from beers_deploy.quant.integer.reference import merged_correction, run_core
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.quantize import Quantized
from tests.quant.quick import changed, uniform

IMAGE = uniform(2, 1, 35, 41, seed=4)


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*-int8.onnx")), ids=lambda path: path.stem)
def test_every_layer_of_a_shipped_file_is_equal(path: Path) -> None:
    model = load_onnx(path)
    core = read_core(model)
    height, width = (size - size % core.host_part.place_px for size in IMAGE.shape[2:])
    layers = agreement(core, model, IMAGE[:1, :, :height, :width])
    assert [layer.report.name for layer in layers.layers] == [op.name for op in core.ops]
    assert {layer.unequal for layer in layers.layers} == {0.0}
    assert (layers.up != layers.even).any()


def test_a_layer_that_computes_something_else_is_found(quantized: Quantized) -> None:
    corrupted = changed(quantized.host, "body.0.second.bias", lambda bias: bias * 2 + 900)
    layers = agreement(quantized.core, corrupted, IMAGE).layers
    unequal = {layer.report.name: layer.unequal > 0 for layer in layers}
    assert not unequal["body.0.first"]
    assert unequal["body.0.second"]
    assert unequal["tail"]


def test_changes_by_the_rounding_rule_are_counted(quantized: Quantized) -> None:
    layers = agreement(quantized.core, quantized.host, IMAGE)
    assert {layer.unequal for layer in layers.layers} == {0.0}
    up, even = (
        run_core(quantized.core, IMAGE_SLICES.encode(IMAGE), half_even=rule)[0]
        for rule in (False, True)
    )
    for layer, op in zip(layers.layers, quantized.core.ops, strict=True):
        difference = up[op.output] - even[op.output]
        assert layer.moved == pytest.approx(np.count_nonzero(difference) / difference.size)
        assert layer.moved_by == np.abs(difference).max()
    assert_array_equal(layers.up, merged_correction(quantized.core, up))
    assert_array_equal(layers.even, merged_correction(quantized.core, even))
    assert max(layer.moved for layer in layers.layers) > 0
