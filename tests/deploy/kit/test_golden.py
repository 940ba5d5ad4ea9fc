"""Tests of golden vectors, compared with simulated boards that compute wrongly in known ways."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import beers_deploy as bd
from beers_deploy.kit.golden import (
    CASES,
    INDEX,
    PICTURE,
    Golden,
    files_of,
    read_golden,
    write_golden,
)
from beers_deploy.kit.golden_results import compare_golden, where
from beers_deploy.network import Network
from beers_deploy.profiles.errors import BeersError, OptionError
from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.graph import PLANES
from beers_deploy.quant.integer.arithmetic import saturated
from beers_deploy.quant.integer.reference import layer_sums, rounded
from beers_deploy.studies.stress.faults import with_ops
from examples.networks import build, to_onnx
from tests.deploy.command_line import done, refused
from tests.quant.quick import one_guess, uniform

SHIPPED = ("convbeers-xs-int8", "convbeers-half-xs-int8")
NORMALISED = "unet, normalised"
"""A network that reads images in [-1, 1]."""
TILE_PX = 32


@cache
def network(name: str) -> bd.Network:
    if name in SHIPPED:
        return bd.Network.load(name)
    samples = uniform(4, 1, 32, 32)
    normalised = name == NORMALISED
    name = name.partition(",")[0]
    with one_guess():
        return bd.quantize(
            to_onnx(name, build(name, torch.Generator().manual_seed(0))),
            samples=2 * samples - 1 if normalised else samples,
            input_range="-1,1" if normalised else None,
            progress=False,
        )


@pytest.fixture(scope="module", params=[SHIPPED[1], "mobile", NORMALISED])
def vectors(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_golden(network(request.param), tmp_path_factory.mktemp("golden"), tile=TILE_PX)


@pytest.fixture(scope="module")
def golden(vectors: Path) -> Golden:
    return read_golden(vectors)


def middle(core: IntCore) -> IntConv:
    """Return a convolution in the middle of the core, into which tests put faults."""
    return core.convolutions[len(core.convolutions) // 2]


def with_middle(core: IntCore, **other: Any) -> IntCore:
    return with_ops(core, [replace(middle(core), **other)])


def flipped(values: np.ndarray, place: tuple[int, ...], bit: int) -> np.ndarray:
    changed = values.copy()
    changed.view(np.uint8)[place] ^= np.uint8(1 << bit)
    return changed


def board(core: IntCore, planes: np.ndarray, half_even: bool = False) -> dict[str, np.ndarray]:
    """Return every tensor as a board writes it."""
    tensors = {PLANES: planes.astype(np.int16)}
    for op in core.ops:
        sums, shift, *_ = layer_sums(core, op, tensors)
        values, _ = rounded(sums, shift, half_even)
        tensors[op.output] = saturated(values)
    return tensors


Board = Callable[[IntCore, np.ndarray], dict[str, np.ndarray]]
FAULTS: dict[str, tuple[Board, str, str]] = {
    "ties": (lambda core, planes: board(core, planes, half_even=True), "first", "everywhere"),
    "bias": (
        lambda core, planes: board(
            with_middle(core, bias=flipped(middle(core).bias, (1,), 3)), planes
        ),
        "middle",
        "everywhere, in channel 1",
    ),
    "planes": (lambda core, planes: board(core, planes ^ 1), PLANES, "everywhere"),
}
"""For each fault: the board, the first layer that differs, and where in the layer."""


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (np.s_[:0], ""),
        (np.s_[:, 1], "everywhere, in channel 1"),
        (np.s_[:, :2], "everywhere, in 2 of 4 channels"),
        (np.s_[..., -3:, :], "within 3 px of the border, in 4 of 4 channels"),
        (np.s_[..., 9:11, :], "in rows 9 to 10, in 4 of 4 channels"),
        (np.s_[..., 9], "in column 9, in 4 of 4 channels"),
    ],
)
def test_the_place_of_differences_is_named(place: Any, words: str) -> None:
    differs = np.zeros((2, 4, 32, 24), bool)
    differs[place] = True
    assert where(differs) == words


def results(
    golden: Golden, folder: Path, run: Board, wants: Callable[[str], bool] = lambda _: True
) -> Path:
    """Write the tensors that `wants` chooses into a folder, as a board does."""
    for case, tensors in golden.cases.items():
        (folder / case).mkdir(parents=True)
        outputs = run(golden.core, tensors[PLANES])
        for name, file in files_of(golden.core).items():
            if wants(name):
                np.save(folder / case / file, outputs[name].astype(np.int8))
    return folder


def test_a_correct_board_differs_nowhere(vectors: Path, golden: Golden, tmp_path: Path) -> None:
    comparison = compare_golden(vectors, results(golden, tmp_path / "r", board))
    assert comparison
    assert all(row.figures["differing"].value == 0 and not row.text["where"] for row in comparison)
    assert {"odd", "extremes", "black", "white"} < set(golden.cases)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_found_at_its_first_layer_and_place(
    fault: str, vectors: Path, golden: Golden, tmp_path: Path
) -> None:
    run, place, words = FAULTS[fault]
    comparison = compare_golden(vectors, results(golden, tmp_path / "r", run))
    layer = {"first": golden.core.ops[0].name, "middle": middle(golden.core).name}.get(place, place)
    assert not comparison
    assert comparison.checks[0].detail == f"the first to differ is {layer}"
    row = next(row for row in comparison.rows if row.name == layer)
    assert row.text["where"].startswith(words)
    assert (row.figures["differing"].value or 0) > 0
    assert (row.figures["at most by"].value or 0) >= 1
    before = comparison.rows[: comparison.rows.index(row)]
    assert all(earlier.figures["differing"].value == 0 for earlier in before)


def test_layers_without_results_are_counted(vectors: Path, golden: Golden, tmp_path: Path) -> None:
    run = FAULTS["ties"][0]
    last = golden.core.ops[-1].output
    folder = results(golden, tmp_path / "r", run, lambda name: name == last)
    unseen = len(golden.core.ops) - 1
    detail = compare_golden(vectors, folder).checks[0].detail
    assert detail.endswith(f", {unseen} layers before it not handed out")


def test_results_are_accepted_as_boards_write_them(tmp_path: Path) -> None:
    """Channels last, uint8 around 128 and floats are accepted; other values and shapes are not."""
    vectors = write_golden("convbeers-xs-int8", tmp_path / "golden", tile=TILE_PX)
    folder = tmp_path / "r" / "noise"
    golden = read_golden(vectors)
    names = list(files_of(golden.core).items())
    tensors = golden.cases["noise"]
    folder.mkdir(parents=True)
    (first, one), (second, two), (third, three) = names[1:4]
    np.save(folder / one, np.moveaxis(tensors[first], 1, -1).astype(np.int8))
    np.save(folder / two, (tensors[second] + 128).astype(np.uint8))
    np.save(folder / three, (tensors[third] * golden.core.scale(third)).astype(np.float32))
    assert compare_golden(vectors, tmp_path / "r")
    for values, message in (
        (tensors[third][:, :1], "must have the shape"),
        (tensors[third] + 0.3, "integer multiples of 2"),
    ):
        np.save(folder / three, values)
        with pytest.raises(BeersError, match=message):
            compare_golden(vectors, tmp_path / "r")
    (folder / three).rename(folder / "other.npy")
    with pytest.raises(BeersError, match=r"got noise/other.npy"):
        compare_golden(vectors, tmp_path / "r")


def test_the_command_writes_and_compares(tmp_path: Path) -> None:
    out = tmp_path / "golden"
    folder = tmp_path / "seen"
    cases = done("golden", "convbeers-xs", "--tile", TILE_PX, "--out", out)
    assert all(case in cases for case in CASES)
    for case in ("scene", "noise"):
        shutil.copytree(out / case, folder / case)
    assert "no layer differs: 20 compared" in done("golden", folder, "--compare", out)
    path = next((folder / "noise").glob("19-*"))
    np.save(path, np.load(path) + 1)
    output = " ".join(done("golden", folder, "--compare", out, code=1).split())
    assert "the first to differ is joined" in output
    assert "golden.json cannot be read" in refused("golden", folder, "--compare", folder)
    x = tmp_path / "x"
    assert "multiple of 2 px" in refused("golden", "convbeers-half-xs", "--tile", 33, "--out", x)
    np.save(out / "noise" / "00-planes.npy", np.zeros((1, 4, 38, 38), np.int8))
    assert "noise/00-planes.npy has other numbers" in refused("golden", folder, "--compare", out)


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """Write golden vectors with one case, which a test damages."""
    write_golden(SHIPPED[0], tmp_path / "golden", tile=TILE_PX)
    index = json.loads((tmp_path / "golden" / INDEX).read_text())
    index["cases"] = {"noise": index["cases"]["noise"]}
    (tmp_path / "golden" / INDEX).write_text(json.dumps(index))
    return tmp_path / "golden"


STRANGE = {
    "text": np.full((1, 4, 8, 8), "a"),
    "number": np.array(3),
    "structured": np.zeros((1, 4, 38, 38), [("a", "i1")]),
    "infinite": np.full((1, 4, 38, 38), np.inf),
    "size": np.zeros((1, 4, 7, 9), np.int8),
}


@pytest.mark.parametrize("kind", STRANGE)
def test_arrays_that_are_no_tensors_are_refused(kind: str, copied: Path, tmp_path: Path) -> None:
    planes = copied / "noise" / "00-planes.npy"
    (tmp_path / "seen" / "noise").mkdir(parents=True)
    tensor = np.load(planes)
    shape = tensor.shape if STRANGE[kind].ndim == 4 and kind != "size" else STRANGE[kind].shape
    strange = np.resize(STRANGE[kind], shape)
    np.save(tmp_path / "seen" / "noise" / planes.name, strange)
    message = refused("golden", tmp_path / "seen", "--compare", copied)
    assert f"got {shape}" in message or "the shape" not in message
    np.save(planes, strange)
    refused("golden", tmp_path / "seen", "--compare", copied)
    planes.write_bytes(b"\x93NUMPY\x01\x00\x06\x00(((((\n")
    refused("golden", tmp_path / "seen", "--compare", copied)


def test_an_index_with_outside_paths_is_refused_and_its_claims_are_ignored(
    copied: Path, tmp_path: Path
) -> None:
    shutil.copytree(copied / "noise", tmp_path / "seen" / "noise")
    index = json.loads((copied / INDEX).read_text())
    (copied / INDEX).write_text(json.dumps(index | {"network": {"name": 5, "sha256": "0" * 64}}))
    comparison = compare_golden(copied, tmp_path / "seen")
    assert comparison.to_dict()["inputs"][0] == Network.load(copied / "int8.onnx").input._asdict()  # type: ignore[index]
    shutil.copytree(copied / "noise", tmp_path / "noise")
    (copied / INDEX).write_text(
        json.dumps(index | {"cases": {"../noise": index["cases"]["noise"]}})
    )
    assert "is damaged (the case '../noise')" in refused("golden", tmp_path, "--compare", copied)


def test_damaged_vectors_of_any_layer_are_refused_and_absent_ones_are_computed(
    copied: Path, tmp_path: Path
) -> None:
    """The comparison would be right, but an engineer who uses the file elsewhere would not."""
    shutil.copytree(copied / "noise", tmp_path / "seen" / "noise")
    *_, last = sorted((copied / "noise").glob("[0-9]*.npy"))
    np.save(last, np.load(last) ^ 1)
    assert f"noise/{last.name} has other numbers" in refused(
        "golden", tmp_path / "seen", "--compare", copied
    )
    last.unlink()
    assert compare_golden(copied, tmp_path / "seen")
    # It has no digest, but its planes have one.
    picture = copied / "noise" / PICTURE
    image = np.load(picture)
    for damaged in (1 - image, image[0], np.full_like(image, np.nan)):
        np.save(picture, damaged)
        assert f"noise/{PICTURE} has other numbers" in refused(
            "golden", tmp_path / "seen", "--compare", copied
        )


def test_older_vectors_do_not_stay(copied: Path) -> None:
    stale = copied / "odd" / "99-gone.npy"
    np.save(stale, np.zeros(1))
    (copied / "odd" / "notes.txt").touch()
    write_golden(SHIPPED[0], copied, tile=TILE_PX)
    assert not stale.exists()
    assert (copied / "odd" / "notes.txt").exists()
    assert read_golden(copied)


def test_results_that_do_not_exist_are_no_folder(copied: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"none is not a folder of a board's results"):
        compare_golden(copied, tmp_path / "none")
