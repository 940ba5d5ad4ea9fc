"""The script that a board's owner runs, here with onnxruntime's CPU provider."""

import json
import sys
from pathlib import Path

import pytest

from beers_deploy.kit import measure
from tests.deploy.dpu.graphs import board_convbeers


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["measure.py", *map(str, arguments)])
    return measure.main()


def test_runs_are_added_to_the_list(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    model, out, rail = (tmp_path / name for name in ("core.onnx", "board.json", "power1_input"))
    board_convbeers(model, 1, 8)
    rail.write_text("22500000\n")
    provider = ("--provider", "CPUExecutionProvider")
    common = (model, *provider, "--tile", 37, "--frames", 7, "--out", out)
    assert run(monkeypatch, *common, "--configuration", "C32B1") == 0
    more = ("--threads", 3, "--batch", 2, "--power-file", rail, "--power-file", rail)
    assert run(monkeypatch, *common, *more) == 0
    first, second = json.loads(out.read_text())
    settings = {
        "model": "core.onnx",
        "configuration": "C32B1",
        "tile_px": 37,
        "provider": "CPUExecutionProvider",
    }
    assert first == {**settings, "fps": first["fps"]}
    assert set(second) == {*first, "power_w"}
    assert second["power_w"] == 45
    assert min(first["fps"], second["fps"]) > 0


def test_the_same_provider_gives_the_same_numbers(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = board_convbeers(tmp_path / "core.onnx", 1, 8)
    provider = ("--provider", "CPUExecutionProvider")
    options = (*provider, "--tile", 24, "--frames", 3, "--out", tmp_path / "b.json")
    assert run(monkeypatch, model, *options) == 0
    assert "0.0 % of values differ" in capsys.readouterr().out


def test_throughput_leaves_the_first_calls_latency_out() -> None:
    assert measure.throughput([5.0, 5.5, 6.0], batch=3) == pytest.approx(6)
    with pytest.raises(ValueError, match="frames"):
        measure.throughput([5.0], batch=3)


def test_calls_in_flight_end_as_often_as_asked(tmp_path: Path) -> None:
    session = measure.open_session(
        board_convbeers(tmp_path / "core.onnx", 1, 8), "CPUExecutionProvider", {}
    )
    stamps, _ = measure.run_threads(session, measure.make_feed(session, 1, 16), 11, 4, [])
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
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    word: str,
) -> None:
    board_convbeers(tmp_path / "core.onnx", 1, 8)
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *arguments, "--tile", "16") == 2
    assert word in capsys.readouterr().err
    assert not (tmp_path / "board.json").exists()
