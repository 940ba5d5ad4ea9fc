"""Tests that `gate` passes the shipped pairs and fails a pair with changed weights."""

from pathlib import Path

import pytest
from onnx import numpy_helper

from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from tests.deploy.command_line import done
from tests.shipped import shipped_pair


def gate(scenes: Path, *pair: object, code: int = 0) -> str:
    """Return the output for one patch of 128 x 128, since an emulated float network is slow."""
    return done(f"gate --images {scenes} --patches 1", *pair, code=code)


@pytest.mark.parametrize("name", ["convbeers-xs", "convbeers-s"])
def test_a_shipped_pair_passes(name: str, scenes: Path) -> None:
    assert "gate passed" in gate(scenes, name)


def test_a_broken_pair_fails(scenes: Path, tmp_path: Path) -> None:
    float_path, int8_path = shipped_pair("convbeers-xs")
    model = load_onnx(int8_path)
    weight = next(t for t in model.graph.initializer if t.name == "tail.weight")
    weight.CopyFrom(numpy_helper.from_array(-numpy_helper.to_array(weight), weight.name))
    save_onnx(model, tmp_path / "broken.onnx")
    assert "FAILED MAE" in gate(scenes, float_path, tmp_path / "broken.onnx", code=1)
