"""Test that the main commands send and fetch nothing: they run where no socket can be opened.

Most run in this process, where Python's sockets are replaced. Some run in a process of their own,
where the kernel also stops sockets of native libraries (tests/deploy/sealed.py).
"""

import os
import platform
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from beers_deploy.cli.commands import app
from beers_deploy.model.convbeers import save_network
from tests.deploy.documents import valid
from tests.deploy.sealed import SOCKET_CALL
from tests.model.networks import plain
from tests.project_files import ROOT

pytestmark = pytest.mark.slow

needs_filters = pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() not in SOCKET_CALL,
    reason="only Linux on x86-64 and AArch64 has these system calls",
)


@pytest.fixture
def no_sockets(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """Let every attempt raise, and collect the attempts: a library might catch the error."""
    attempts: list[tuple[object, ...]] = []

    def refuse(*arguments: object, **_: object) -> None:
        attempts.append(arguments)
        raise OSError("no network here")

    for name in ("socket", "create_connection", "getaddrinfo", "gethostbyname", "socketpair"):
        monkeypatch.setattr(socket, name, refuse)
    return attempts


COMMANDS = """
profiles
export --network w.safetensors --out f.onnx
quantize f.onnx --out i.onnx --images scenes --patches 2 --patch 32
gate f.onnx i.onnx --images scenes --patches 2 --json gate.json
check i.onnx --tile 64
bench i.onnx --size 300x200 --tile 64 --no-traditional
restore raw.tif out.tif --network i.onnx
evaluate --images scenes --methods degraded,i.onnx
simulate --scene haze-over-sea --explain
simulate --patch 256 --workers 1 --out pairs
train --variant convbeers-xs --drawn 1 --steps 2 --batch 1 --patch 32 --validate-every 0 --lpips-weight 0 --out run
"""  # noqa: E501 - commands, one a line


def test_the_chain_opens_no_socket(
    working_folder: Path, no_sockets: list[tuple[object, ...]]
) -> None:
    weights = working_folder / "w.safetensors"
    scenes = working_folder / "scenes"
    save_network(weights, plain(), {"degraded": "pleiades-degraded"})
    scenes.mkdir()
    rng = np.random.default_rng(0)
    tifffile.imwrite(scenes / "a.tif", rng.integers(200, 1800, (700, 700)).astype(np.uint16))
    tifffile.imwrite(
        working_folder / "raw.tif", rng.integers(200, 1800, (37, 61)).astype(np.uint16)
    )
    for command in COMMANDS.strip().splitlines():
        result = CliRunner().invoke(app, command.split())
        # The gate ends with 1 for so small a network.
        assert result.exit_code in (0, 1), result.output
    assert Path("run/convbeers-xs.safetensors").is_file()
    assert valid(Path("gate.json"))["command"] == "gate"
    assert tifffile.imread("out.tif").shape == (37, 61)
    assert no_sockets == []


def alone(home: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run Python as a user would, without the variables that turn off telemetry in CI."""
    inherited = {name: os.environ[name] for name in ("PATH", "SYSTEMROOT") if name in os.environ}
    environment = {**inherited, "HOME": str(home), "TMPDIR": str(home)}
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300
    )


def files_below(home: Path) -> list[str]:
    return sorted(str(path.relative_to(home)) for path in home.rglob("*") if path.is_file())


@needs_filters
@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
def test_no_native_library_opens_a_socket_or_stores_an_identifier(
    tmp_path: Path, runtime: str
) -> None:
    if runtime == "openvino":
        pytest.importorskip("openvino", reason="the extra 'openvino' is not installed")
    home = tmp_path / "home"
    raw = tmp_path / "raw.tif"
    out = tmp_path / "out.tif"
    home.mkdir()
    tifffile.imwrite(raw, np.random.default_rng(0).integers(200, 1800, (37, 61)).astype(np.uint16))
    result = alone(home, "-m", "tests.deploy.sealed", "restore", raw, out, "--runtime", runtime)
    assert result.returncode == 0, result.stderr
    assert tifffile.imread(out).shape == (37, 61)
    assert files_below(home) == []


@needs_filters
def test_a_native_attempt_would_end_the_process(tmp_path: Path) -> None:
    begin = "from tests.deploy.sealed import seal; seal(); import socket; "
    assert alone(tmp_path, "-c", begin + "socket.socketpair()").returncode == 0
    for family in ("AF_INET", "AF_INET6"):
        assert (
            alone(tmp_path, "-c", begin + f"socket.socket(socket.{family})").returncode
            == -signal.SIGSYS
        )
