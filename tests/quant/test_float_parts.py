"""A file that hides a float network around an integer core does not pass as INT8."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnxruntime.quantization import quantize_static

from beers_deploy.quant.float_parts import float_layers_check, float_note
from beers_deploy.quant.onnx_file import GraphWriter, image_info, load_onnx, make_model, save_onnx
from beers_deploy.quant.structure import structure_checks
from tests.quant.quick import Calibration
from tests.shipped import shipped_pair


def decoy(hidden: str) -> onnx.ModelProto:
    """A float layer; and beside it a quantised one whose result counts for nothing."""
    w = GraphWriter()
    unit = w.constant("unit", np.array(2.0**-7, np.float32))
    zero = w.constant("zero", np.array(0, np.int8))
    w.node("QuantizeLinear", "q", ["x", unit, zero])
    w.node("DequantizeLinear", "dq", ["q", unit, zero])
    weight = w.constant("w", np.full((1, 1, 1, 1), 0.5, np.float32))
    if hidden == "conv":
        w.node("Conv", "y", ["x", weight])
    elif hidden == "behind":
        w.node("Conv", "y", ["dq", weight])
    else:
        w.node("MatMul", "y", ["x", w.constant("m", np.eye(8, dtype=np.float32))])
    w.node("Mul", "nothing", ["dq", w.constant("none", np.array(0, np.float32))])
    w.node("Add", "z", ["y", "nothing"])
    return make_model(w.graph("g", [image_info("x", 1, 8)], [image_info("z", 1, 8)]), {})


@pytest.mark.parametrize("hidden", ["conv", "behind", "matmul"])
def test_a_float_layer_is_counted(hidden: str) -> None:
    check = float_layers_check(decoy(hidden))
    assert (check.value, check.passed) == (1, False)
    (note,) = float_note(decoy(hidden))
    assert "Add" in note


@pytest.mark.parametrize("name", ["convbeers-xs", "convbeers-half-xs"])
def test_a_file_of_ours_has_none(name: str) -> None:
    model = load_onnx(shipped_pair(name)[1])
    assert float_layers_check(model).passed
    assert float_note(model) == []


def written(path: Path) -> Path:
    """A small float network."""
    w = GraphWriter()
    generator = np.random.default_rng(0)
    first = w.constant("first", generator.normal(0, 0.2, (4, 1, 3, 3)).astype(np.float32))
    second = w.constant("second", generator.normal(0, 0.2, (1, 4, 3, 3)).astype(np.float32))
    w.node("Conv", "a", ["image", first], pads=[1, 1, 1, 1])
    w.node("Relu", "b", ["a"])
    w.node("Conv", "y", ["b", second], pads=[1, 1, 1, 1])
    save_onnx(
        make_model(w.graph("g", [image_info("image", 1, None)], [image_info("y", 1, None)]), {}),
        path,
    )
    return path


@pytest.mark.parametrize("per_channel", [False, True])
def test_a_file_of_another_quantizer_has_none(per_channel: bool, tmp_path: Path) -> None:
    model = written(tmp_path / "float.onnx")
    noise = list(np.random.default_rng(0).random((2, 1, 1, 32, 32), np.float32))
    quantize_static(model, tmp_path / "free.onnx", Calibration(noise), per_channel=per_channel)
    assert float_layers_check(load_onnx(tmp_path / "free.onnx")).passed


def test_one_layer_left_in_float_is_told(tmp_path: Path) -> None:
    model = written(tmp_path / "float.onnx")
    noise = list(np.random.default_rng(0).random((2, 1, 1, 32, 32), np.float32))
    first = next(node.name for node in load_onnx(model).graph.node if node.op_type == "Conv")
    path = tmp_path / "partly.onnx"
    quantize_static(model, path, Calibration(noise), nodes_to_exclude=[first])
    checks = {check.name: check for check in structure_checks(load_onnx(model), load_onnx(path))}
    assert not checks["layers computed in float"].passed
