"""Tests that other formats of networks are named with a remedy, and ONNX files are not."""

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from beers_deploy.model.io.formats import HEAD_BYTES, other_format
from beers_deploy.model.io.tensors import read_tensors
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.onnx_file import load_onnx
from tests.deploy.command_line import refused
from tests.quant.simplify.networks import CASES, network_from

LAYER = torch.nn.Conv2d(1, 1, 3)
STATE = LAYER.state_dict()
Write = Callable[[Path], object]


def saved_bytes(save: Callable[..., object]) -> bytes:
    stream = io.BytesIO()
    save(stream, np.ones(3))
    return stream.getvalue()


OTHERS: dict[str, tuple[Write, str]] = {
    "weights of PyTorch": (lambda path: torch.save(STATE, path), "torch.onnx.export"),
    "a whole module of PyTorch": (lambda path: torch.save(LAYER, path), "torch.onnx.export"),
    "an old file of PyTorch": (
        lambda path: torch.save(STATE, path, _use_new_zipfile_serialization=False),
        "torch.onnx.export",
    ),
    "weights as safetensors": (lambda path: save_file(STATE, path), "beers-deploy export"),
    "arrays of NumPy": (lambda path: path.write_bytes(saved_bytes(np.savez)), "unpack it"),
    "an array of NumPy": (lambda path: path.write_bytes(saved_bytes(np.save)), "as ONNX"),
    "Keras": (lambda path: path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(64)), "tf2onnx"),
    "TensorFlow Lite": (lambda path: path.write_bytes(b"\x1c\0\0\0TFL3" + bytes(64)), "--tflite"),
    "onnxruntime's own format": (
        lambda path: path.write_bytes(b"\x1c\0\0\0ORTM" + bytes(64)),
        "made from",
    ),
    "OpenVINO": (lambda path: path.write_text('<?xml version="1.0"?><net name="a"/>'), "made from"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_another_format_is_named_with_its_remedy(name: str, tmp_path: Path) -> None:
    write, remedy = OTHERS[name]
    path = tmp_path / "network.onnx"
    write(path)
    with pytest.raises(ModelError, match="not an ONNX file") as caught:
        load_onnx(path)
    assert remedy in str(caught.value)
    assert "parsing" not in str(caught.value)


@pytest.mark.parametrize(
    "words", [("check",), ("quantize", "--out", "out.onnx"), ("export", "--out", "o.onnx")]
)
def test_commands_state_what_to_do_with_a_file_of_pytorch(
    words: tuple[str, ...], tmp_path: Path
) -> None:
    path = tmp_path / "network.pth"
    torch.save(STATE, path)
    command, *options = words
    arguments = ("--network", path) if command == "export" else (path,)
    message = refused(command, *arguments, *options)
    assert "a file of PyTorch" in message
    assert "torch.onnx.export" in message


def test_weights_in_another_format_are_named(tmp_path: Path) -> None:
    torch.save(STATE, tmp_path / "w.safetensors")
    with pytest.raises(ModelError, match=r"it is a file of PyTorch.*beers-deploy train"):
        read_tensors(tmp_path / "w.safetensors")


@pytest.mark.parametrize("case", CASES)
def test_no_exporters_file_is_another_format(case: str) -> None:
    assert other_format(network_from(CASES[case][0]).SerializeToString()[:HEAD_BYTES]) is None
