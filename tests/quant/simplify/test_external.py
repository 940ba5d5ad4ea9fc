"""Tests that external weights are read from the model's own folder, and from nowhere else."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto

from beers_deploy.model.io.files import sha256
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.onnx.external_weights import network_sha256, take_in
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.session import open_session, run
from tests.deploy.dpu.graphs import float_convbeers

IMAGE = np.full((1, 1, 12, 14), 0.25, np.float32)
Damage = Callable[[onnx.ModelProto], object]


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """Write a network whose weights are in `model/weights.bin` next to it, and return its path."""
    model = onnx.load_model(float_convbeers(tmp_path / "whole.onnx", 1, 4))
    rng = np.random.default_rng(0)
    for tensor in model.graph.initializer:
        tensor.raw_data = rng.normal(0, 0.1, tuple(tensor.dims)).astype(np.float32).tobytes()
    onnx.save_model(model, tmp_path / "whole.onnx")
    (tmp_path / "model").mkdir()
    path = tmp_path / "model" / "apart.onnx"
    onnx.save_model(
        model,
        path,
        save_as_external_data=True,
        all_tensors_to_one_file=True,
        location="weights.bin",
        size_threshold=0,
    )
    return path


def rewritten(path: Path, change: Damage) -> Path:
    model = onnx.load_model(path, load_external_data=False)
    change(model)
    path.write_bytes(model.SerializeToString())
    return path


def stating(key: str, value: str) -> Damage:
    def change(model: onnx.ModelProto) -> None:
        entries = model.graph.initializer[1].external_data
        entries_left = [(e.key, e.value) for e in entries if e.key != key]
        del entries[:]
        for name, text in (*entries_left, (key, value)):
            entries.add(key=name, value=text)

    return change


def test_a_network_in_one_file_and_in_two_computes_the_same(saved: Path) -> None:
    one_file = load_onnx(saved.parents[1] / "whole.onnx")
    two_files = load_onnx(saved)
    assert two_files.graph.initializer == one_file.graph.initializer
    expected, result = (run(open_session(model, 1), IMAGE) for model in (one_file, two_files))
    np.testing.assert_array_equal(result, expected)
    assert result.std() > 0


def refused(path: Path) -> str:
    with pytest.raises(ModelError) as caught:
        load_onnx(path)
    assert str(path) in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    "place", ["../weights.bin", "/etc/passwd", "a/../../weights.bin", "C:\\weights.bin", "", "\\x"]
)
def test_no_file_outside_the_models_folder_is_opened(
    place: str, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (saved.parents[1] / "weights.bin").write_bytes((saved.parent / "weights.bin").read_bytes())
    rewritten(saved, stating("location", place))
    model = onnx.load_model(saved, load_external_data=False)
    # The tensor with the changed place comes first now, so that no other one opens a file earlier.
    model.graph.initializer.pop(0)
    monkeypatch.setattr(Path, "open", lambda *_: pytest.fail("opened"))
    with pytest.raises(ModelError, match="outside the model's folder"):
        take_in(model, saved)


def test_no_link_is_followed(saved: Path) -> None:
    weights = saved.parent / "weights.bin"
    outside = saved.parents[1] / "outside.bin"
    weights.rename(outside)
    try:
        weights.symlink_to(outside)
    except OSError:
        pytest.skip("no links here")
    assert "a link" in refused(saved)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
def test_no_pipe_is_waited_for(saved: Path) -> None:
    (saved.parent / "weights.bin").unlink()
    os.mkfifo(saved.parent / "weights.bin")
    assert "regular file" in refused(saved)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (stating("offset", "99999999"), "does not hold the"),
        (stating("offset", "-4"), "does not hold the"),
        (stating("offset", "9" * 4000), "does not hold the"),
        (stating("length", "12"), "does not hold the"),
        (stating("location", "missing.bin"), "no such file"),
        (lambda m: m.graph.initializer[1].dims.append(2**22), "values"),
        (lambda m: m.graph.initializer[1].dims.append(1000), "does not hold the"),
        (lambda m: m.graph.initializer[1].dims.append(-1), "plain numbers"),
        (
            lambda m: setattr(m.graph.initializer[1], "data_type", TensorProto.STRING),
            "plain numbers",
        ),
    ],
)
def test_what_the_model_states_about_its_weights_is_checked(
    damage: Damage, words: str, saved: Path
) -> None:
    assert words in refused(rewritten(saved, damage))


def test_external_weights_that_are_not_finite_are_refused(saved: Path) -> None:
    weights = saved.parent / "weights.bin"
    weights.write_bytes(b"\xff" * weights.stat().st_size)
    assert "NaN or infinite" in refused(saved)


def test_external_constants_of_nodes_are_refused(saved: Path) -> None:
    def change(model: onnx.ModelProto) -> None:
        tensor = TensorProto(name="apart", data_type=TensorProto.FLOAT, dims=[1])
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="weights.bin")
        model.graph.node.insert(0, onnx.helper.make_node("Constant", [], ["c"], value=tensor))

    assert "another file" in refused(rewritten(saved, change))


def test_a_digest_covers_external_weights(saved: Path) -> None:
    before = network_sha256(saved)
    own = sha256(saved)
    assert before != own
    weights_file = saved.parent / "weights.bin"
    weights_file.write_bytes(weights_file.read_bytes()[::-1])
    assert sha256(saved) == own
    assert network_sha256(saved) != before
    one_file = saved.parents[1] / "whole.onnx"
    assert network_sha256(one_file) == sha256(one_file)
