"""A network with weights that are not finite, or whose results are NaN, leads to one sentence."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch

from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.convbeers import ConvBEERS, save_network
from beers_deploy.model.variants import VARIANTS
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from tests.deploy.command_line import done

VARIANT = "convbeers-xs"
INT8 = f"{VARIANT}-int8"
READERS = [
    "quantize {0} --out {1}/int8.onnx --board-file {1}/board.onnx --json {1}/q.json",
    f"gate {{0}} {INT8} --json {{1}}/g.json",
    "check {0} --json {1}/c.json",
    "evaluate --methods {0} --json {1}/e.json --out {1}",
    f"stress {{0}} {INT8} --json {{1}}/s.json",
    "stress --bit-flips {0} --json {1}/s.json",
    "tradeoff --network {0} --out {1}",
    "bench {0} --json {1}/b.json",
    "bench {0} --target host --json {1}/b.json",
    "restore {1}/raw.tif {1}/out.tif --network {0}",
]
TRAINING = f"--variant {VARIANT} --drawn 1 --steps 2 --batch 1 --patch 24 --out {{1}}"
OF_WEIGHTS = [
    "export --network {0} --out {1}/float.onnx",
    f"train --start {{0}} {TRAINING}",
    "quantize {0} --out {1}/int8.onnx",
    f"gate {{0}} {INT8} --json {{1}}/g.json",
]
Spoil = Callable[[ConvBEERS], None]


def one(value: float) -> Spoil:
    """Return what sets one weight of the body to a value."""

    def spoil(network: ConvBEERS) -> None:
        dict(network.named_parameters())["body.1.first.weight"].view(-1)[5] = value

    return spoil


def overflowing(network: ConvBEERS) -> None:
    """Make all weights so large that every sum overflows, though each weight is finite."""
    for name, weight in network.named_parameters():
        if name.endswith("weight"):
            weight.fill_(1e30)


def written(folder: Path, spoil: Spoil, suffix: str) -> Path:
    path = folder / f"net{suffix}"
    network = ConvBEERS(VARIANTS[VARIANT]).eval()
    with torch.no_grad():
        spoil(network)
    if suffix == ".onnx":
        save_onnx(to_onnx(network, {}), path)
    else:
        save_network(path, network, {})
    tifffile.imwrite(folder / "raw.tif", np.full((40, 44), 700, np.uint16))
    return path


def spoken(command: str, path: Path, exit_code: int = 2) -> str:
    """Run a command on a network, and return its output; the command leaves no file behind."""
    before = {p for p in path.parent.rglob("*") if p.is_file()}
    output = done(*command.format(path, path.parent).split(), code=exit_code)
    assert {p for p in path.parent.rglob("*") if p.is_file()} == before
    return " ".join(output.split())


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_file_with_such_a_weight_is_not_read(tmp_path: Path, value: float) -> None:
    with pytest.raises(
        ModelError, match=r"must be finite, but body\.1\.first\.weight has 1 NaN or infinite"
    ):
        load_onnx(written(tmp_path, one(value), ".onnx"), to_run=False)


@pytest.mark.parametrize("command", READERS)
def test_no_command_accepts_such_a_network(tmp_path: Path, command: str) -> None:
    path = written(tmp_path, one(np.nan), ".onnx")
    assert "must be finite, but body.1.first.weight has 1 NaN" in spoken(command, path)


@pytest.mark.parametrize("command", OF_WEIGHTS)
def test_no_command_accepts_such_weights(tmp_path: Path, command: str) -> None:
    path = written(tmp_path, one(np.inf), ".safetensors")
    assert "its weights are not finite" in spoken(command, path)


@pytest.mark.parametrize(
    "command",
    [
        "quantize {0} --out {1}/int8.onnx --images {2} --patches 1",
        "bench {0} --target host --tile 64 --json {1}/b.json",
        "restore {1}/raw.tif {1}/out.tif --network {0}",
    ],
)
def test_a_network_whose_sums_overflow_is_refused_where_it_runs(
    tmp_path: Path, command: str, scenes: Path
) -> None:
    message = spoken(command.replace("{2}", str(scenes)), written(tmp_path, overflowing, ".onnx"))
    assert "NaN or infinit" in message


def test_the_gate_fails_a_network_whose_sums_overflow(tmp_path: Path, scenes: Path) -> None:
    output = spoken(
        f"gate {{0}} {INT8} --images {scenes} --patches 1",
        written(tmp_path, overflowing, ".onnx"),
        exit_code=1,
    )
    assert "gate FAILED" in output
    assert "MAE nan" in output
