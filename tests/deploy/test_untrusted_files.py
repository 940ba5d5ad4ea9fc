"""Tests of documents, weights and folders of others that once crashed a run. Now each is refused in
one sentence or ignored.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from beers_deploy.model.convbeers import arrays, load_network
from beers_deploy.model.io.lock import part_folder
from beers_deploy.model.io.tensors import read_tensors as read_weights
from beers_deploy.model.io.tensors import write_tensors
from beers_deploy.model.manifest import matching_lines
from beers_deploy.model.metrics.perceptual import read_tensors
from beers_deploy.model.raster.images import read_pixels
from beers_deploy.model.training.run import Log
from beers_deploy.profiles.errors import BeersError, ModelError, OptionError
from beers_deploy.profiles.toml import read_toml_text
from beers_deploy.profiles.user_files.json_text import read_json
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.restoration.checkpoint import Checkpoint, FinishedRow, journal_text
from beers_deploy.restoration.outcome import Tally
from tests.deploy.command_line import refused
from tests.fuzz.networks import checkpoint_seeds, go_on
from tests.fuzz.parsers import JOB, SHAPE


@pytest.mark.parametrize(("reader", "suffix"), [(load_onnx, ".onnx"), (read_pixels, ".tif")])
def test_a_name_too_long_for_the_disk_is_a_sentence(
    reader: Callable[[Path], object], suffix: str, tmp_path: Path
) -> None:
    with pytest.raises(BeersError, match="too long"):
        reader(tmp_path / f"{'a' * 5000}{suffix}")


Corrupt = Callable[[dict[str, torch.Tensor]], object]


@pytest.mark.parametrize(
    "corrupt",
    [
        lambda t: t.pop("average.tail.bias"),
        lambda t: t.update({"average.other": torch.zeros(1)}),
        lambda t: t.update({"average.tail.bias": torch.zeros(7)}),
        lambda t: t.update({"moment.tail.bias.exp_avg": torch.zeros(3, 1)}),
        lambda t: t.pop("moment.tail.bias.exp_avg"),
        lambda t: t.update({"moment.tail.bias.step": torch.tensor(0.0)}),
        lambda t: t.update({"moment.tail.bias.step": torch.tensor(11.0)}),
        lambda t: t.update({"moment.tail.bias.exp_avg_sq": torch.full((1,), -1.0)}),
        lambda t: t.update({"moment.nobody.step": torch.zeros(())}),
        lambda t: t.update({"network.tail.bias": torch.full((1,), float("nan"))}),
    ],
)
def test_a_corrupted_checkpoint_is_refused(corrupt: Corrupt, tmp_path: Path) -> None:
    path = tmp_path / "c.safetensors"
    path.write_bytes(checkpoint_seeds(tmp_path)[1])
    go_on(path)
    by_name, header = read_weights(path)
    tensors = {name: torch.from_numpy(array) for name, array in by_name.items()}
    corrupt(tensors)
    write_tensors(path, arrays(tensors), header)
    with pytest.raises(ModelError, match="checkpoint of this network"):
        go_on(path)


def test_a_header_that_is_nested_too_deep_is_refused(tmp_path: Path) -> None:
    content = json.dumps({"__metadata__": {"variant": "[" * 50_000}}).encode()
    (tmp_path / "w.safetensors").write_bytes(len(content).to_bytes(8, "little") + content)
    with pytest.raises(ModelError, match="nesting"):
        load_network(tmp_path / "w.safetensors")


def archive(path: Path, content: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("a.npy", content)
    return path


def test_an_array_larger_than_its_archive_is_refused(tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.save(stream, np.ones((2, 3), np.float32))
    assert read_tensors(archive(tmp_path / "a.npz", stream.getvalue()), ["a"])["a"].shape == (2, 3)
    header = io.BytesIO()
    about: dict[str, object] = {"descr": "<f4", "fortran_order": False, "shape": (1 << 40,)}
    np.lib.format.write_array_header_1_0(header, about)
    with pytest.raises(ModelError, match="arrays"):
        read_tensors(archive(tmp_path / "b.npz", header.getvalue() + bytes(24)), ["a"])


def stored_rows(rows_px: int = 4, **counts: int) -> tuple[bytes, FinishedRow]:
    """Return rows of pixels as a checkpoint stores them, and their line in its journal."""
    pixels = np.arange(rows_px * SHAPE[2], dtype=np.uint16).tobytes()
    return pixels, FinishedRow(rows_px, hashlib.sha256(pixels).hexdigest(), Tally(**counts))


ENDS = (4, SHAPE[1])
"""Rows of pixels at which the rows of tiles of a plan end."""


@pytest.mark.parametrize(
    "journal",
    [
        json.dumps({"job": JOB, "rows": 4, "valid_results": 32}),
        journal_text({"job": 1}, [stored_rows()[1]]),
        journal_text(JOB, [stored_rows(valid_results=-5)[1]]),
        journal_text(JOB, [replace(stored_rows()[1], rows_px=10**9 // SHAPE[2])]),
        journal_text(JOB, [replace(stored_rows()[1], rows_px=0)]),
        journal_text(JOB, [replace(stored_rows()[1], rows_px=4.0)]),  # type: ignore[arg-type]
        journal_text(JOB, [stored_rows(valid_results=1.5)[1]]),  # type: ignore[arg-type]
        journal_text(JOB, [stored_rows(2)[1]]),
        journal_text(JOB, [stored_rows()[1]])[:-40],
        journal_text(JOB, [stored_rows()[1]]).replace('"valid_results": 0', '"valid_results": 1'),
    ],
)
def test_a_journal_that_counts_rows_that_are_not_there_is_refused(
    journal: str, tmp_path: Path
) -> None:
    out = tmp_path / "out.tif"
    part_folder(out).mkdir()
    pixels, row = stored_rows()
    (part_folder(out) / "rows.raw").write_bytes(pixels)
    path = part_folder(out) / "journal.json"
    path.write_text(journal)
    with pytest.raises(OptionError, match="resume"):
        Checkpoint(out, SHAPE, np.dtype(np.uint16), JOB, resume=True, row_ends=ENDS)
    path.write_text(journal_text(JOB, [row]))
    assert Checkpoint(out, SHAPE, np.dtype(np.uint16), JOB, resume=True, row_ends=ENDS).rows == 4


@pytest.mark.parametrize(
    "line", ["", "{}", "[]", "3", "[" * 5000, '{"degraded": {"rejected_snr_pairs": "x"}}']
)
def test_no_pair_is_read_from_an_invalid_manifest(line: str, tmp_path: Path) -> None:
    (tmp_path / "manifest.jsonl").write_text(line + "\n")
    assert matching_lines(tmp_path, [tmp_path / "manifest.jsonl"]) == {}


def test_a_log_with_strange_lines_is_continued(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(
        "step,loss\n20,0.5\n²,1\n12abc\n30,2\n".encode() + b"\xff\xfe\n" + b"9" * 5000 + b",1\n"
    )
    Log(path, 20).write(21, {"loss": 0.25})
    lines = path.read_text().splitlines()
    assert lines[:2] == ["step,loss", "20,0.5"]
    assert "30,2" not in lines
    assert lines[-1] == "21,0.25"
    Log(path, 0)
    assert path.read_text() == ""


POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"


@pytest.mark.parametrize(
    ("command", "name"),
    [
        (["check", "{}"], "network.onnx"),
        (["gate", "{}", "{}"], "network.onnx"),
        (["export", "--out", "out.onnx", "--network", "{}"], "weights.safetensors"),
        (["gate", "--limits", "{}"], "limits.toml"),
        (["gate", "--baseline", "{}"], "gate.json"),
        (["profiles", "{}"], "sensor.toml"),
    ],
)
@pytest.mark.parametrize("kind", ["pointer", "folder"])
def test_a_pointer_or_folder_in_place_of_a_file_is_named(
    command: list[str], name: str, kind: str, working_folder: Path
) -> None:
    path = working_folder / name
    path.mkdir() if kind == "folder" else path.write_text(POINTER)
    message = refused(*(word.format(path) for word in command))
    assert name in message
    assert ("it is a folder" if kind == "folder" else "'git lfs pull'") in message


def test_a_byte_order_mark_is_no_part_of_a_text(tmp_path: Path) -> None:
    (tmp_path / "limits.toml").write_bytes(b"\xef\xbb\xbfmae = 0.5\n")
    (tmp_path / "one.json").write_bytes(b"\xef\xbb\xbf[1]")
    assert read_toml_text(tmp_path / "limits.toml") == {"mae": 0.5}
    assert read_json(tmp_path / "one.json") == [1]
