from dataclasses import replace

import numpy as np
import onnx
import pytest

from beers_deploy.quant.core import build_core, shift_faults
from beers_deploy.quant.encodings import board_model
from beers_deploy.quant.gate import compare
from beers_deploy.quant.graph import PLANES, Graph
from beers_deploy.quant.onnx.messages import constants
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.quant.quantize import Quantized, quantize_model
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_session
from beers_deploy.quant.tiling.receptive_field import tiling_of


def test_scales_are_powers_of_two_and_weights_are_int8(quantized: Quantized) -> None:
    for model in (quantized.host, board_model(quantized.core, {})):
        for name, value in constants(model).items():
            if name.startswith("scale_"):
                assert np.log2(value) == np.rint(np.log2(value))
    for op in quantized.core.convolutions:
        assert op.weight.dtype == op.bias.dtype == np.int8


def test_every_shift_is_within_its_window_and_one_that_is_not_is_named(
    quantized: Quantized,
) -> None:
    assert shift_faults(quantized.core) == []
    bits = quantized.core.frac_bits
    faults = shift_faults(replace(quantized.core, frac_bits={**bits, "head": 40}))
    assert any(fault.startswith("head: shift_cut") for fault in faults)


def test_unreachable_scales_are_moved_to_legal_ones(graph: Graph, quantized: Quantized) -> None:
    bits = {name: n + 20 * (name != PLANES) for name, n in quantized.core.frac_bits.items()}
    assert shift_faults(build_core(graph, bits)) == []


def test_every_convolution_is_an_integer_kernel(quantized: Quantized) -> None:
    kinds = [node.op_type for node in quantized.host.graph.node]
    # These are the head, two in each of two blocks, the end and the tail.
    assert kinds.count("QLinearConv") == 7
    assert "Conv" not in kinds


def test_int8_stays_close_to_float(
    float_onnx: onnx.ModelProto, quantized: Quantized, patches: Patches
) -> None:
    assert compare(open_session(float_onnx), open_session(quantized.host), patches).mae < 0.002


def test_the_same_patches_give_the_same_bytes(
    float_onnx: onnx.ModelProto, quantized: Quantized, patches: Patches
) -> None:
    repeated = quantize_model(float_onnx, patches, {"seed": "5"})
    assert repeated.host.SerializeToString() == quantized.host.SerializeToString()


def test_the_file_records_its_calibration(quantized: Quantized, patches: Patches) -> None:
    about = metadata(quantized.host)
    assert about["calibration_sha256"] == patches.digest
    assert about["precision"] == "int8 legal"


@pytest.mark.parametrize("encoding", ["float", "host", "board"])
def test_the_halo_is_read_from_the_graph(
    encoding: str, float_onnx: onnx.ModelProto, quantized: Quantized
) -> None:
    board = board_model(quantized.core, {})
    models = {"float": float_onnx, "host": quantized.host, "board": board}
    assert tiling_of(models[encoding]).halo_px == 7
