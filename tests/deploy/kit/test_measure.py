"""The script that a board's owner runs, here with onnxruntime's CPU provider."""

import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

from beers_deploy.kit import measure
from tests.deploy.dpu.graphs import board_convbeers


@pytest.fixture
def script() -> ModuleType:
    return measure


def run(script: ModuleType, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["measure.py", *arguments])
    return int(script.main())


def test_runs_are_added_to_the_list(script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    model, out, rail = (
        board_convbeers(tmp_path / "core.onnx", 1, 8),
        tmp_path / "board.json",
        tmp_path / "power1_input",
    )
    rail.write_text("22500000\n")
    common = (str(model), "--provider", "CPUExecutionProvider", "--tile", "37", "--frames", "7", "--out", str(out))
    assert run(script, monkeypatch, *common, "--configuration", "C32B1") == 0
    more = ("--threads", "3", "--batch", "2", "--power-file", str(rail), "--power-file", str(rail))
    assert run(script, monkeypatch, *common, *more) == 0
    first, second = json.loads(out.read_text())
    assert first == {"model": "core.onnx", "configuration": "C32B1", "tile_px": 37, "fps": first["fps"]}
    assert set(second) == {"model", "configuration", "tile_px", "fps", "power_w"}
    assert second["power_w"] == 45
    assert min(first["fps"], second["fps"]) > 0


def test_the_same_provider_gives_the_same_numbers(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = board_convbeers(tmp_path / "core.onnx", 1, 8)
    options = (
        "--provider",
        "CPUExecutionProvider",
        "--tile",
        "24",
        "--frames",
        "3",
        "--out",
        str(tmp_path / "b.json"),
    )
    assert run(script, monkeypatch, str(model), *options) == 0
    assert "0.0 % of values differ" in capsys.readouterr().out


def test_throughput_leaves_the_first_calls_latency_out(script: ModuleType) -> None:
    assert script.throughput([5.0, 5.5, 6.0], batch=3) == pytest.approx(6)
    with pytest.raises(ValueError, match="frames"):
        script.throughput([5.0], batch=3)


def test_calls_in_flight_end_as_often_as_asked(script: ModuleType, tmp_path: Path) -> None:
    session = script.open_session(board_convbeers(tmp_path / "core.onnx", 1, 8), "CPUExecutionProvider", {})
    stamps, _ = script.run_threads(session, script.make_feed(session, 1, 16), 11, 4, [])
    assert len(stamps) == 11
    assert stamps == sorted(stamps)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("core.onnx",), "VitisAIExecutionProvider"),
        (("none.onnx", "--provider", "CPUExecutionProvider"), "no such file"),
        (("core.onnx", "--provider", "CPUExecutionProvider", "--frames", "1"), "--frames"),
    ],
)
def test_what_the_owner_can_correct_is_one_sentence(
    script: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    word: str,
) -> None:
    board_convbeers(tmp_path / "core.onnx", 1, 8)
    monkeypatch.chdir(tmp_path)
    assert run(script, monkeypatch, *arguments, "--tile", "16") == 2
    assert word in capsys.readouterr().err
    assert not (tmp_path / "board.json").exists()
