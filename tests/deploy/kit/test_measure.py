"""Tests of the script that a board's owner runs, here with onnxruntime's CPU provider."""

import json
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest

import beers_deploy as bd
from beers_deploy.kit import measure
from tests.deploy.dpu.graphs import board_convbeers
from tests.quant.simplify.networks import parsed

OF_EIGHT = parsed(
    "line = Flatten(x) y = Gemm(line, w)",
    "float[1,1,H,W] x => float[1,4] y",
    constants={"w": np.zeros((64, 4))},
)
"""A network of images of 8 x 8 pixels, whose file does not state their size."""


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object, configuration: str = "C32B1") -> int:
    named = ["--configuration", configuration]
    monkeypatch.setattr(sys, "argv", ["measure.py", *named, *map(str, arguments)])
    return measure.main()


def test_a_run_without_the_name_of_its_dpu_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It would be recorded as that of another DPU, or of one that the board does not have."""
    monkeypatch.setattr(sys, "argv", ["measure.py", "core.onnx"])
    with pytest.raises(SystemExit, match="2"):
        measure.main()
    assert "--configuration" in capsys.readouterr().err.splitlines()[-1]


def test_runs_are_added_to_the_list(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, out, rail = (tmp_path / name for name in ("core.onnx", "board.json", "power1_input"))
    board_convbeers(model, 1, 8)
    rail.write_text("22500000\n")
    provider = ("--provider", "CPUExecutionProvider")
    common = (model, *provider, "--tile", 37, "--frames", 7, "--out", out)
    assert run(monkeypatch, *common, configuration="C32B5") == 0
    more = ("--threads", 3, "--batch", 2, "--power-file", rail, "--power-file", rail)
    assert run(monkeypatch, *common, *more) == 0
    assert capsys.readouterr().out.count("0.0 % of values differ") == 2
    first, second = json.loads(out.read_text())
    settings = {
        "model": "core.onnx",
        "configuration": "C32B5",
        "tile_px": 37,
        "provider": "CPUExecutionProvider",
    }
    assert first == {**settings, "fps": first["fps"]}
    assert set(second) == {*first, "power_w"}
    assert second["power_w"] == 45
    assert min(first["fps"], second["fps"]) > 0


@pytest.mark.slow
def test_the_core_of_a_kit_is_measured_at_its_own_size(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The core reads a border, at half the resolution. The entry has the tile of the image."""
    kit = bd.Board.load("vck190").kit("convbeers-half-xs-int8", tmp_path / "kit", tile=64)
    out = kit / "board.json"
    provider = ("--provider", "CPUExecutionProvider", "--frames", 4, "--out", out)
    assert run(monkeypatch, kit / "core.onnx", *provider) == 0
    (entry,) = json.loads(out.read_text())
    assert entry["tile_px"] == 64
    # The entry now looks as if the board had run it.
    out.write_text(json.dumps([{**entry, "provider": "VitisAIExecutionProvider", "fps": 900.0}]))
    table = bd.bench("convbeers-half-xs-int8", tile=64, measured=out, size="700x600")
    assert any("your runs" in row.figures for row in table.rows)
    assert "No board was used" not in table.notes[-1]
    assert run(monkeypatch, kit / "core.onnx", *provider, "--batch", 2) == 2
    # The rate of tiles of 64 px must not be recorded as that of 128 px.
    assert run(monkeypatch, kit / "core.onnx", *provider, "--tile", 128) == 2


def test_a_power_that_cannot_be_read_is_refused_before_the_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = board_convbeers(tmp_path / "core.onnx", 1, 8)
    options = ("--provider", "CPUExecutionProvider", "--out", tmp_path / "board.json")
    assert run(monkeypatch, model, *options, "--power-file", tmp_path / "none") == 2
    output = capsys.readouterr()
    assert "No such file" in output.err
    assert output.out == ""


def test_throughput_leaves_the_first_calls_latency_out() -> None:
    assert measure.throughput([5.0, 5.5, 6.0], batch=3) == pytest.approx(6)
    with pytest.raises(ValueError, match="frames"):
        measure.throughput([5.0], batch=3)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("core.onnx",), "VitisAIExecutionProvider"),
        (("none.onnx", "--provider", "CPUExecutionProvider"), "no such file"),
        (("text.onnx", "--provider", "CPUExecutionProvider"), "cannot open text.onnx"),
        (("line.onnx", "--provider", "CPUExecutionProvider"), "line.onnx on tiles of 16 px: "),
        (("core.onnx", "--option", "level"), "--option must be KEY=VALUE, got level"),
        (("core.onnx", "--out", "none/board.json"), "none is not a folder"),
        (("core.onnx", "--out", "text.onnx"), "must be a JSON list of runs"),
        (("core.onnx", "--provider", "CPUExecutionProvider", "--frames", "1"), "--frames"),
    ],
)
def test_what_the_owner_can_correct_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    word: str,
) -> None:
    board_convbeers(tmp_path / "core.onnx", 1, 8)
    (tmp_path / "text.onnx").write_text("no network", encoding="utf-8")
    onnx.save_model(OF_EIGHT, tmp_path / "line.onnx")
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *arguments, "--tile", "16") == 2
    assert word in capsys.readouterr().err
    assert not (tmp_path / "board.json").exists()
