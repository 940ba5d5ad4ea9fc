"""Shipped networks by name wherever a network is taken."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from deploy.cli import app
from deploy.gate import files_or_shipped
from deploy.networks import float_file, int8_file, network_file, shipped_pair, weights_file
from model.shipped import SENSOR, VARIANT, shipped_weights
from profiles import load_sensor
from quant.onnx_file import load_onnx, metadata

KNOWN = load_sensor(SENSOR)


@pytest.mark.parametrize("name", ["convbeers-xs", "convbeers-s"])
def test_a_name_is_the_shipped_network(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    floating, int8 = shipped_pair(name)
    assert int8_file(Path(name), KNOWN) == int8_file(Path(f"{name}-int8"), KNOWN) == int8
    assert network_file(Path(name), KNOWN) == float_file(Path(f"{name}-int8"), KNOWN) == floating
    assert network_file(Path(f"{name}-int8"), KNOWN) == int8
    assert weights_file(Path(name)) == shipped_weights(name)
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(b"mine")  # a file of that name is what was meant
    assert int8_file(Path(name), KNOWN) == float_file(Path(name), KNOWN) == weights_file(Path(name)) == Path(name)


@pytest.mark.parametrize("given", ["none", "none.onnx", "folder/convbeers-s"])
def test_anything_else_stays_a_path(given: str) -> None:
    assert int8_file(Path(given), KNOWN) == float_file(Path(given), KNOWN) == weights_file(Path(given)) == Path(given)


def test_nothing_given_is_the_default() -> None:
    assert network_file(None, KNOWN) == int8_file(None, KNOWN) == int8_file(Path(VARIANT), KNOWN)


def test_commands_take_the_name(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", np.random.default_rng(0).integers(200, 1800, (37, 41)).astype(np.uint16))
    for model in ("convbeers-xs-int8", str(shipped_pair("convbeers-xs", "blind")[1])):
        out = tmp_path / f"{len(model)}.tif"
        result = CliRunner().invoke(app, ["restore", str(tmp_path / "in.tif"), str(out), "--model", model])
        assert result.exit_code == 0, result.output
        assert ("network: convbeers-xs-int8, told no sensor" in result.output) == (model == "convbeers-xs-int8")
    first, second = (tifffile.imread(path) for path in tmp_path.glob("*.tif") if path.name != "in.tif")
    np.testing.assert_array_equal(first, second)
    result = CliRunner().invoke(
        app, ["restore", str(tmp_path / "in.tif"), str(tmp_path / "x.tif"), "--model", "huge"]
    )
    assert result.exit_code == 2
    assert "a shipped network (convbeers, convbeers-half" in " ".join(result.output.split())


@pytest.mark.parametrize(
    "command",
    [
        ["check", "convbeers-xs", "--tile", "64"],
        ["stress", "convbeers-xs", "convbeers-xs-int8", "--cases", "1 x 1", "--stages", "INT8"],
    ],
)
def test_judges_take_the_name(command: list[str]) -> None:
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert f"{command[0]} passed" in result.output


def test_the_gate_takes_the_names() -> None:
    for int8 in ("convbeers-xs", "convbeers-xs-int8"):
        assert files_or_shipped(Path("convbeers-xs"), Path(int8), None) == shipped_pair("convbeers-xs")


def test_export_takes_the_name(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["export", "--checkpoint", "convbeers-xs", "--out", str(tmp_path / "net.onnx")])
    assert result.exit_code == 0, result.output
    assert metadata(load_onnx(tmp_path / "net.onnx"))["variant"] == "convbeers-xs"


def test_export_writes_a_shipped_networks_integers_for_the_host_and_the_board(tmp_path: Path) -> None:
    host, board = str(tmp_path / "int8.onnx"), str(tmp_path / "core.onnx")
    words = ["export", "--checkpoint", "convbeers-half-xs-int8", "--sensor", "blind", "--tile", "64", "--out", host]
    assert CliRunner().invoke(app, [*words, "--board", board]).exit_code == 0
    assert metadata(load_onnx(Path(host)))["sensor"] == "blind"
    for path in (host, board):
        result = CliRunner().invoke(app, ["check", path])
        assert result.exit_code == 0, result.output


def test_a_tile_that_a_network_cannot_rearrange_is_refused(tmp_path: Path) -> None:
    words = ["export", "--checkpoint", "convbeers-half-xs-int8", "--tile", "65", "--out", str(tmp_path / "x.onnx")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert "--tile: expected a multiple of 2 px, got 65 px" in " ".join(result.output.split())
    assert not (tmp_path / "x.onnx").exists()
