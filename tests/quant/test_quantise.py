from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from quant.calibration import Patches
from quant.core import IntConv, build_core, shift_faults
from quant.encodings import host_model
from quant.ends import Ends
from quant.gate import Limits, compare, judge
from quant.graph import CORRECTION, PLANES_FRAC_BITS, correction_graph, read_planes, split
from quant.onnx_file import metadata, save_onnx
from quant.quantise import Quantised, quantise_model
from quant.session import open_session, run
from quant.tiling.walk import receptive_radius_px


def image(height: int = 37, width: int = 53, seed: int = 0) -> np.ndarray:
    dn = np.random.default_rng(seed).integers(0, 4096, (1, 1, height, width))
    return dn.astype(np.float32) / np.float32(4095)


def test_scales_are_powers_of_two_and_numbers_are_int8(quantised: Quantised) -> None:
    for model in (quantised.host, quantised.board):
        for tensor in model.graph.initializer:
            value = numpy_helper.to_array(tensor)
            if tensor.name.startswith("scale_"):
                assert np.log2(value) == np.rint(np.log2(value))
    for op in quantised.core.ops:
        if isinstance(op, IntConv):
            assert op.weight.dtype == op.bias.dtype == np.int8


def test_every_shift_is_within_its_window(quantised: Quantised) -> None:
    assert shift_faults(quantised.core) == []


def test_a_shift_outside_its_window_is_named(quantised: Quantised) -> None:
    frac_bits = dict(quantised.core.frac_bits)
    frac_bits["head"] = 40
    faults = shift_faults(replace(quantised.core, frac_bits=frac_bits))
    assert any(fault.startswith("head: shift_cut") for fault in faults)


def test_unreachable_positions_are_moved_to_legal_ones(float_onnx: onnx.ModelProto, quantised: Quantised) -> None:
    graph = read_planes(correction_graph(float_onnx))
    wild = {name: (p if name == "planes" else p + 20) for name, p in quantised.core.frac_bits.items()}
    assert shift_faults(build_core(graph, wild)) == []


@pytest.mark.parametrize("size", [(37, 53), (1, 7), (419, 643)])
def test_host_and_board_files_compute_the_same(size: tuple[int, int], quantised: Quantised) -> None:
    host, board = open_session(quantised.host), open_session(quantised.board)
    for seed in range(3):
        dn = image(*size, seed=seed)
        planes = split(dn).astype(np.float32) * np.float32(2.0**-PLANES_FRAC_BITS)
        correction = Ends(gains=2).merge(board.run(None, {"planes": planes})[0], quantised.core.scale(CORRECTION))
        restored = np.clip(dn + correction, 0, 1)
        np.testing.assert_array_equal(run(host, dn), restored)


def test_optimised_equals_unoptimised(quantised: Quantised) -> None:
    plain = open_session(quantised.host, optimise=False)
    np.testing.assert_array_equal(run(open_session(quantised.host), image()), run(plain, image()))


def test_the_exact_kernels_compute_the_same(quantised: Quantised) -> None:
    default, exact = (open_session(quantised.host, exact=e) for e in (None, True))
    np.testing.assert_array_equal(run(default, image()), run(exact, image()))


def test_every_convolution_is_an_integer_kernel(quantised: Quantised) -> None:
    kinds = [node.op_type for node in quantised.host.graph.node]
    assert (
        kinds.count("QLinearConv") == 8
    )  # head, two of each of two blocks, head and end for the half-LSB pair, tail
    assert "Conv" not in kinds


def test_int8_stays_close_to_float(float_onnx: onnx.ModelProto, quantised: Quantised, patches: Patches) -> None:
    result = compare(open_session(float_onnx), open_session(quantised.host), patches.pairs)
    assert result.mae < 0.002
    assert judge(result, Limits(mae=0.002))[0].passed
    assert not judge(result, Limits(mae=result.mae / 2))[0].passed


def test_the_gate_sees_a_broken_weight(float_onnx: onnx.ModelProto, quantised: Quantised, patches: Patches) -> None:
    sound = compare(open_session(float_onnx), open_session(quantised.host), patches.pairs)
    ops = list(quantised.core.ops)
    assert isinstance(ops[-1], IntConv)
    ops[-1] = replace(ops[-1], weight=-ops[-1].weight)
    broken = host_model(replace(quantised.core, ops=tuple(ops)), {})
    assert compare(open_session(float_onnx), open_session(broken), patches.pairs).mae > 2 * sound.mae


def test_a_nan_never_passes_the_gate(float_onnx: onnx.ModelProto, quantised: Quantised, patches: Patches) -> None:
    result = compare(open_session(float_onnx), open_session(quantised.host), patches.pairs)
    assert not judge(replace(result, mae=float("nan")), Limits(mae=1.0))[0].passed


def test_the_same_patches_give_the_same_bytes(
    float_onnx: onnx.ModelProto, quantised: Quantised, patches: Patches, tmp_path: Path
) -> None:
    again = quantise_model(float_onnx, patches, {"seed": "5"})
    save_onnx(again.host, tmp_path / "again.onnx")
    save_onnx(quantised.host, tmp_path / "once.onnx")
    assert (tmp_path / "again.onnx").read_bytes() == (tmp_path / "once.onnx").read_bytes()


def test_the_file_says_what_it_was_calibrated_on(quantised: Quantised, patches: Patches) -> None:
    about = metadata(quantised.host)
    assert about["calibration_sha256"] == patches.digest
    assert about["precision"] == "int8 legal"


@pytest.mark.parametrize("encoding", ["float", "host", "board"])
def test_the_radius_is_read_from_the_graph(encoding: str, float_onnx: onnx.ModelProto, quantised: Quantised) -> None:
    model = {"float": float_onnx, "host": quantised.host, "board": quantised.board}[encoding]
    assert receptive_radius_px(model) == 7
