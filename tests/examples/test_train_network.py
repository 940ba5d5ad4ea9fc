"""Tests that a few training steps help, and that both files contain the trained network."""

from itertools import islice
from pathlib import Path

import onnx
import pytest
import torch

from beers_deploy.model.io.tensors import read_tensors
from beers_deploy.model.simulator.sampling import Scene
from examples.networks import build, to_onnx
from examples.samples import batches
from examples.train_network import judge, main, train


@pytest.mark.parametrize("name", ["espcn", "segment"])
def test_a_few_steps_help_on_other_patches(name: str, scenes: list[Scene]) -> None:
    drawn_batches = list(islice(batches(name, scenes, 0), 10))
    untrained = judge(name, build(name, torch.Generator().manual_seed(0)), iter(drawn_batches[6:]))
    trained = judge(name, train(name, iter(drawn_batches[:6]), 6, seed=0), iter(drawn_batches[6:]))
    assert trained[0] > untrained[0]
    assert trained[1:] == untrained[1:]


@pytest.mark.slow
def test_both_files_hold_the_trained_network(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "segment.onnx"
    assert main(["segment", "--steps", "3", "--out", str(out)]) == 0
    assert "(measured)" in capsys.readouterr().out
    tensors, header = read_tensors(out.with_suffix(".safetensors"))
    assert header == {"network": "segment", "steps": 3, "seed": 0}
    network = build("segment", torch.Generator().manual_seed(1))
    network.load_state_dict({name: torch.from_numpy(value) for name, value in tensors.items()})
    assert to_onnx("segment", network) == onnx.load(out)
