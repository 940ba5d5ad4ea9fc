"""`gate` on the shipped pairs: passed as they are, failed once a weight is another."""

from pathlib import Path

import pytest
from onnx import numpy_helper
from typer.testing import CliRunner

from deploy.cli import app
from deploy.networks import shipped_pair
from quant.onnx_file import load_onnx, save_onnx


def gate(scenes: Path, *pair: str) -> tuple[int, str]:
    """The command's exit code and words on one patch of 128 x 128: emulated float networks take seconds for each."""
    done = CliRunner().invoke(app, ["gate", *pair, "--images", str(scenes), "--patches", "1"])
    return done.exit_code, done.output


@pytest.mark.parametrize("name", ["convbeers-xs", "convbeers-s"])
def test_a_shipped_pair_passes(name: str, scenes: Path) -> None:
    code, said = gate(scenes, "--variant", name)
    assert code == 0, said
    assert "gate passed" in said


def test_a_broken_one_fails(scenes: Path, tmp_path: Path) -> None:
    float_path, int8_path = shipped_pair("convbeers-xs")
    model = load_onnx(int8_path)
    weight = next(t for t in model.graph.initializer if t.name == "tail.weight")
    weight.CopyFrom(numpy_helper.from_array(-numpy_helper.to_array(weight), weight.name))
    save_onnx(model, tmp_path / "broken.onnx")
    code, said = gate(scenes, str(float_path), str(tmp_path / "broken.onnx"))
    assert code == 1, said
    assert "FAILED MAE" in said
