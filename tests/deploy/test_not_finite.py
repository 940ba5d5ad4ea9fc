"""Test that a network with weights or results that are not finite leads to one sentence."""

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
from beers_deploy.quant.gate import compare
from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from beers_deploy.quant.session import open_session
from tests.deploy.command_line import done
from tests.quant.quick import patches_of
from tests.quant.simplify.networks import parsed

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
Corrupt = Callable[[ConvBEERS], None]


def one(value: float) -> Corrupt:
    """Return a function that sets one weight of the body to `value`."""

    def corrupt(network: ConvBEERS) -> None:
        dict(network.named_parameters())["body.1.first.weight"].view(-1)[5] = value

    return corrupt


def overflowing(network: ConvBEERS) -> None:
    """Make all weights so large that every sum overflows, though each weight is finite."""
    for name, weight in network.named_parameters():
        if name.endswith("weight"):
            weight.fill_(1e30)


def write_network(folder: Path, corrupt: Corrupt, suffix: str) -> Path:
    path = folder / f"net{suffix}"
    network = ConvBEERS(VARIANTS[VARIANT]).eval()
    with torch.no_grad():
        corrupt(network)
    if suffix == ".onnx":
        save_onnx(to_onnx(network, {}), path)
    else:
        save_network(path, network, {})
    tifffile.imwrite(folder / "raw.tif", np.full((40, 44), 700, np.uint16))
    return path


def output_of(command: str, path: Path, exit_code: int = 2) -> str:
    """Run a command on a network, check that it leaves no file behind, and return its output."""
    before = {p for p in path.parent.rglob("*") if p.is_file()}
    output = done(*command.format(path, path.parent).split(), code=exit_code)
    assert {p for p in path.parent.rglob("*") if p.is_file()} == before
    return " ".join(output.split())


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_file_with_such_a_weight_is_not_read(tmp_path: Path, value: float) -> None:
    with pytest.raises(
        ModelError, match=r"must be finite, but body\.1\.first\.weight has 1 NaN or infinite"
    ):
        load_onnx(write_network(tmp_path, one(value), ".onnx"), to_run=False)


@pytest.mark.parametrize("command", READERS)
def test_no_command_accepts_such_a_network(tmp_path: Path, command: str) -> None:
    path = write_network(tmp_path, one(np.nan), ".onnx")
    assert "must be finite, but body.1.first.weight has 1 NaN" in output_of(command, path)


@pytest.mark.parametrize("command", OF_WEIGHTS)
def test_no_command_accepts_such_weights(tmp_path: Path, command: str) -> None:
    path = write_network(tmp_path, one(np.inf), ".safetensors")
    assert "its weights are not finite" in output_of(command, path)


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
    message = output_of(
        command.replace("{2}", str(scenes)), write_network(tmp_path, overflowing, ".onnx")
    )
    assert "NaN or infinit" in message


def test_the_gate_fails_a_network_whose_sums_overflow(tmp_path: Path, scenes: Path) -> None:
    output = output_of(
        f"gate {{0}} {INT8} --images {scenes} --patches 1",
        write_network(tmp_path, overflowing, ".onnx"),
        exit_code=1,
    )
    assert "gate FAILED" in output
    assert "MAE nan" in output


def test_the_gate_does_not_clip_an_infinite_pixel_to_full_scale() -> None:
    """If both sides were clipped to 1, infinity in both networks would agree."""
    session = open_session(
        parsed(
            "a = Mul(image, s) restored = Mul(a, s)",
            "float[N,1,H,W] image => float[N,1,H,W] restored",
            constants={"s": 3e38},
        )
    )
    image = np.full((1, 1, 8, 8), 0.5, np.float32)
    assert np.isnan(compare(session, session, patches_of([image])).mae)
