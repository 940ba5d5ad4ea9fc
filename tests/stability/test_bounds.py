"""Tests of proven bounds: no image leaves the integer intervals, and no accumulator overflows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

from beers_deploy.model.shipped import SHIPPED
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.bounds import layer_bounds
from beers_deploy.quant.encodings import board_model, read_core
from beers_deploy.quant.integer.reference import INT32_BITS
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.quantize import Quantized
from beers_deploy.studies.stress.faults import with_ops


def test_an_accumulator_that_overflows_is_found(quantized: Quantized) -> None:
    op = quantized.core.convolutions[0]
    huge = replace(
        op, bias=np.full(len(op.bias), 2**31, np.int64), bias_frac_bits=op.weight_frac_bits + 7
    )
    assert layer_bounds(with_ops(quantized.core, [huge]))[0].bits >= INT32_BITS


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*-int8.onnx")), ids=lambda path: path.stem)
def test_shipped_accumulators_cannot_overflow(path: Path) -> None:
    core = read_core(load_onnx(path))
    assert max(bound.bits for bound in layer_bounds(core)) < INT32_BITS


def test_models_in_other_encodings_have_no_core(
    quantized: Quantized, float_onnx: onnx.ModelProto
) -> None:
    for model in (float_onnx, board_model(quantized.core, {})):
        with pytest.raises(ModelError, match="does not describe its integers"):
            read_core(model)
