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
from beers_deploy.quant.graph import CORRECTION
from beers_deploy.quant.host_part import IMAGE_SLICES, DualRange
from beers_deploy.quant.integer.reference import INT32_BITS, correction, run_core
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.quantize import Quantized
from beers_deploy.quant.session import open_session, run


def images(seed: int, shape: tuple[int, int], binary: bool) -> np.ndarray:
    noise = np.random.default_rng(seed).random((1, 1, *shape))
    return np.rint(noise) if binary else noise


def test_no_image_leaves_the_integer_bounds(quantized: Quantized) -> None:
    bounds = {bound.name: bound for bound in layer_bounds(quantized.core)}
    for seed in range(6):
        planes = IMAGE_SLICES.encode(images(seed, (17, 23), seed % 2 == 0).astype(np.float32))
        for report in run_core(quantized.core, planes)[1]:
            bound = bounds[report.name]
            assert report.peak_bits <= bound.bits < INT32_BITS
            assert bound.saturates or report.saturated == 0


def test_an_accumulator_that_overflows_is_found(quantized: Quantized) -> None:
    op = quantized.core.convolutions[0]
    huge = replace(
        op, bias=np.full(len(op.bias), 2**31, np.int64), bias_frac_bits=op.weight_frac_bits + 7
    )
    core = replace(quantized.core, ops=(huge, *quantized.core.ops[1:]))
    assert layer_bounds(core)[0].bits >= INT32_BITS


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*-int8.onnx")), ids=lambda path: path.stem)
def test_shipped_accumulators_cannot_overflow(path: Path) -> None:
    core = read_core(load_onnx(path))
    assert max(bound.bits for bound in layer_bounds(core)) < INT32_BITS


def test_a_core_is_read_back_from_its_file(quantized: Quantized) -> None:
    core = read_core(quantized.host)
    image = images(3, (19, 26), False).astype(np.float32)
    merged = DualRange().decode(
        correction(core, IMAGE_SLICES.encode(image), half_even=True), core.scale(CORRECTION)
    )
    np.testing.assert_array_equal(
        np.clip(image + merged, 0, 1), run(open_session(quantized.host), image)
    )


def test_models_in_other_encodings_have_no_core(
    quantized: Quantized, float_onnx: onnx.ModelProto
) -> None:
    for model in (float_onnx, board_model(quantized.core, {})):
        with pytest.raises(ModelError, match="does not describe its integers"):
            read_core(model)
