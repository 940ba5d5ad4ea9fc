"""The results of the verbs for some networks, images, raster layouts and wrong calls.

They are reduced to a form that is small to store and to compare.

    PYTHONPATH=. python tests/golden/outputs.py

writes `outputs.npz` and `outputs.json` again. Do that only if a change is intended, and state it in
the commit.
"""

import json
import os
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import tifffile
import torch
from onnx import numpy_helper
from typer.testing import CliRunner

from beers_deploy.cli.commands import app
from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.convbeers import ConvBEERS, initialise
from beers_deploy.model.io.files import sha256
from beers_deploy.model.shipped import shipped_names
from beers_deploy.model.variants import Variant
from beers_deploy.quant.onnx_file import save_onnx
from benchmarks.small_networks import NETWORKS
from tests.golden.layouts import CREATION, digitised, ground, restored
from tests.golden.small_networks import quantized
from tests.golden.wrong_calls import CALLS, answer, inputs

STORED = Path(__file__).resolve().parent / "outputs"
SHIPPED = "convbeers-xs"
PLAIN = "plain"
PATCHES = ("--patches", "4", "--patch", "48")


@dataclass(frozen=True)
class Outputs:
    """The outputs that must not change.

    Attributes:
        arrays: restored pixels, and the integers of INT8 files, by name.
        figures: the figures in the JSON of verbs, by verb and network.
        digests: SHA-256 of the shipped INT8 files, as `export` writes them.
        layouts: pixels and metadata that `restore` writes, by the layout of its input.
        answers: exit code and message, by wrong call.
    """

    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    layouts: dict[str, Any] = field(default_factory=dict)
    answers: dict[str, Any] = field(default_factory=dict)

    def add_network(self, name: str, files: tuple[str, str], folder: Path) -> None:
        """Restore, check and gate a network by its float and its INT8 file."""
        for precision, file in zip(("float32", "int8"), files, strict=True):
            for image, path in _images(folder).items():
                self.arrays[f"{name}, {precision}, {image}"] = _restored(file, path, folder)
            key = f"check, {name}, {precision}"
            self.figures.update(_figures(key, folder, "check", file, "--tile", "64"))
        self.add_integers(name, Path(files[1]))
        pair = files if name != SHIPPED else (name,)
        limits = ("--patches", "2", "--max-mae", "0.1")
        self.figures.update(_figures(f"gate, {name}", folder, "gate", *pair, *limits))

    def add_integers(self, name: str, int8: Path) -> None:
        """Add the integers of an INT8 file."""
        for key, value in _integers(int8).items():
            self.arrays[f"{name}, {key}"] = value


def outputs(folder: Path) -> Outputs:
    """Run everything in an empty folder."""
    current = Outputs()
    networks = _networks(folder)
    for name, files in networks.items():
        current.add_network(name, files, folder)
    for name in NETWORKS:
        current.add_integers(name, quantized(name, folder))
    for name in shipped_names():
        file = folder / f"{name}-int8.onnx"
        _run("export", "--network", f"{name}-int8", "--out", file)
        current.digests[name] = sha256(file)
    bench = (f"bench, {SHIPPED}", folder, "bench", f"{SHIPPED}-int8", "--size", "3000x2000")
    current.figures.update(_figures(*bench))
    current.figures.update(_evaluated(folder))
    for name in CREATION:
        current.layouts[name] = restored(name, networks[SHIPPED][1], folder)
    current.answers.update(_answers(folder))
    return current


def _evaluated(folder: Path) -> dict[str, Any]:
    """Return the figures of `evaluate` on one pair of 96 x 96 pixels."""
    scene = folder / "scene.tif"
    rows, columns = np.mgrid[:384, :384] / 40
    tifffile.imwrite(scene, (60 + 30 * np.sin(3 * rows) * np.cos(2 * columns)).astype(np.float32))
    _run("simulate", "--images", scene, "--out", folder / "pairs")
    methods = ("--methods", f"degraded,{SHIPPED}-int8")
    return _figures("evaluate", folder, "evaluate", "--pairs", folder / "pairs", *methods)


def _answers(folder: Path) -> dict[str, Any]:
    """Return the answers to wrong calls, which are run in a folder of their own."""
    inner = folder / "wrong"
    inner.mkdir()
    inputs(inner)
    before = Path.cwd()
    os.chdir(inner)
    try:
        return {words: answer(words) for words in CALLS}
    finally:
        os.chdir(before)


def _images(folder: Path) -> dict[str, Path]:
    """Write a textured image of 12 bits, and one of floats with a hole."""
    noisy = ground(61, 83, 4)
    holed = noisy.astype(np.float32)[:48, :70]
    holed[20:23, 30:41] = np.nan
    images = {"uint16": digitised(noisy), "float32": holed}
    for name, pixels in images.items():
        tifffile.imwrite(folder / f"{name}.tif", pixels)
    return {name: folder / f"{name}.tif" for name in images}


def _networks(folder: Path) -> dict[str, tuple[str, str]]:
    """Write the float and the INT8 file of a shipped pair and of a network of random weights."""
    network = ConvBEERS(Variant(blocks=2, features=8))
    initialise(network, torch.Generator().manual_seed(0))
    save_onnx(to_onnx(network, {}), folder / f"{PLAIN}.onnx")
    files = {SHIPPED: (str(folder / "xs.onnx"), str(folder / "xs-int8.onnx"))}
    for name, path in ((SHIPPED, "xs.onnx"), (f"{SHIPPED}-int8", "xs-int8.onnx")):
        _run("export", "--network", name, "--out", folder / path)
    floating, int8 = (str(folder / f"{PLAIN}{suffix}") for suffix in (".onnx", "-int8.onnx"))
    _run("quantize", floating, "--out", int8, *PATCHES)
    files[PLAIN] = (floating, int8)
    return files


def _run(*arguments: object) -> None:
    result = CliRunner().invoke(app, [str(each) for each in arguments], catch_exceptions=False)
    if result.exit_code > 1:
        raise RuntimeError(result.output)


def _restored(model: str, image: Path, folder: Path) -> np.ndarray:
    out = folder / "restored.tif"
    out.unlink(missing_ok=True)
    _run("restore", image, out, "--network", model, "--tile", "64", "--full-scale", "4095")
    return tifffile.imread(out)


def _integers(path: Path) -> dict[str, np.ndarray]:
    """Return how often each int8 weight has each value, and the sum of the int32 biases."""
    constants = [numpy_helper.to_array(each) for each in onnx.load(path).graph.initializer]
    weights = [each.ravel() for each in constants if each.dtype == np.int8 and each.ndim == 4]
    biases = [each.ravel() for each in constants if each.dtype == np.int32]
    return {
        "weights": np.bincount(np.concatenate(weights).astype(int) + 128, minlength=256),
        "biases": np.array([each.astype(np.int64).sum() for each in biases]),
    }


def _figures(key: str, folder: Path, *command: object) -> dict[str, Any]:
    """Return the figures of a command's JSON that depend on no clock."""
    out = folder / "figures.json"
    _run(*command, "--json", out)
    figures = {}
    for row in json.loads(out.read_text(encoding="utf-8"))["rows"]:
        if (
            command[0] == "bench"
            and "on the DPU (" not in row["name"]
            and "sum:" not in row["name"]
        ):
            continue
        for name, figure in row["figures"].items():
            figures[f"{key}: {row['table']}, {row['name']}, {name}"] = figure["value"]
    return figures


def main() -> None:
    """Write the stored outputs again."""
    with tempfile.TemporaryDirectory() as folder:
        current = outputs(Path(folder))
    np.savez_compressed(STORED.with_suffix(".npz"), **current.arrays)  # type: ignore[arg-type]
    document = {
        "figures": current.figures,
        "digests": current.digests,
        "layouts": current.layouts,
        "wrong calls": current.answers,
    }
    text = json.dumps(document, indent=0, ensure_ascii=False)
    STORED.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    sys.stdout.write(f"{len(current.arrays)} arrays, {len(current.figures)} figures\n")


if __name__ == "__main__":
    main()
