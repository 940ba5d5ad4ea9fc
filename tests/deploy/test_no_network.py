"""The main commands where no socket can be opened: nothing is fetched, asked or told at run time."""

import json
import socket
from pathlib import Path

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from deploy.cli import app
from model.convbeers import ConvBEERS, Variant, initialise
from model.weights_file import save_network

runner = CliRunner()


@pytest.fixture
def no_sockets(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """Every attempt raises, and is counted: a library might swallow the error."""
    attempts: list[tuple[object, ...]] = []

    def refuse(*arguments: object, **_: object) -> None:
        attempts.append(arguments)
        raise OSError("no network here")

    for name in ("socket", "create_connection", "getaddrinfo", "gethostbyname", "socketpair"):
        monkeypatch.setattr(socket, name, refuse)
    return attempts


def done(*arguments: object) -> None:
    result = runner.invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code in (0, 1), result.output  # 1: a gate of so small a network


def test_the_chain_opens_no_socket(tmp_path: Path, no_sockets: list[tuple[object, ...]]) -> None:
    import torch

    network = ConvBEERS(Variant(1, 4))
    initialise(network, torch.Generator().manual_seed(0))
    weights, scenes = tmp_path / "w.safetensors", tmp_path / "scenes"
    save_network(weights, network, {"degraded": "pleiades-degraded"})
    scenes.mkdir()
    rng = np.random.default_rng(0)
    tifffile.imwrite(scenes / "a.tif", rng.integers(200, 1800, (700, 700)).astype(np.uint16))
    tifffile.imwrite(tmp_path / "raw.tif", rng.integers(200, 1800, (37, 61)).astype(np.uint16))
    flt, int8, figures = tmp_path / "f.onnx", tmp_path / "i.onnx", tmp_path / "gate.json"
    done("profiles")
    done("export", "--checkpoint", weights, "--out", flt)
    done("quantize", flt, "--out", int8, "--images", scenes, "--patches", 2, "--patch", 32)
    done("gate", flt, int8, "--images", scenes, "--patches", 2, "--json", figures)
    done("check", int8, "--tile", 64)
    done("bench", int8, "--size", "300x200", "--tile", 64)
    done("restore", tmp_path / "raw.tif", tmp_path / "out.tif", "--model", int8)
    done("compare", figures, figures)
    assert json.loads(figures.read_text())["command"] == "gate"
    assert tifffile.imread(tmp_path / "out.tif").shape == (37, 61)
    assert no_sockets == []


def test_an_attempt_would_be_seen(no_sockets: list[tuple[object, ...]]) -> None:
    with pytest.raises(OSError, match="no network"):
        socket.create_connection(("localhost", 1))
    assert no_sockets
