"""What the verbs give for three networks and two small images, in a form that is small to keep and
to compare.

    PYTHONPATH=. python tests/golden/outputs.py

writes `outputs.npz` and `outputs.json` anew: to be done only where a change of them is meant, and
said in its commit.
"""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import tifffile
import torch
from onnx import numpy_helper
from typer.testing import CliRunner

from beers_deploy.cli import app
from beers_deploy.export import to_onnx
from beers_deploy.model.convbeers import ConvBEERS, initialise
from beers_deploy.model.variants import Variant
from beers_deploy.quant.onnx_file import save_onnx
from examples.networks import build
from examples.networks import to_onnx as example_to_onnx

KEPT = Path(__file__).resolve().parent / "outputs"
SHIPPED = "convbeers-xs"
PLAIN = "plain"
OTHER = "dncnn"
PATCHES = ("--patches", "4", "--patch", "48")


def outputs(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Restored pixels and the integers of INT8 files by name; predicted and counted figures by verb
    and network.
    """
    images = _images(folder)
    networks = _networks(folder)
    arrays: dict[str, np.ndarray] = {}
    figures: dict[str, Any] = {}
    for name, (float_model, int8_model) in networks.items():
        for precision, file in (("float32", float_model), ("int8", int8_model)):
            for image, path in images.items():
                arrays[f"{name}, {precision}, {image}"] = _restored(file, path, folder)
            figures |= _figures(
                f"check, {name}, {precision}", folder, "check", file, "--tile", "64"
            )
        arrays |= {f"{name}, {key}": value for key, value in _integers(Path(int8_model)).items()}
        pair = (float_model, int8_model) if name != SHIPPED else (name,)
        figures |= _figures(
            f"gate, {name}", folder, "gate", *pair, "--patches", "2", "--max-mae", "0.1"
        )
    figures |= _figures(
        f"bench, {SHIPPED}", folder, "bench", f"{SHIPPED}-int8", "--size", "3000x2000"
    )
    return arrays, figures


def _images(folder: Path) -> dict[str, Path]:
    """A textured image of 12 bits, and one of floats with a hole."""
    rows, columns = np.mgrid[:61, :83] / 20
    scene = 900 + 700 * np.sin(5 * rows) * np.cos(3 * columns) + 1400 * (rows + columns > 4)
    noisy = scene + 12 * np.random.default_rng(0).standard_normal(scene.shape)
    holed = noisy.astype(np.float32)[:48, :70]
    holed[20:23, 30:41] = np.nan
    found = {"uint16": np.rint(noisy.clip(0, 4095)).astype(np.uint16), "float32": holed}
    for name, pixels in found.items():
        tifffile.imwrite(folder / f"{name}.tif", pixels)
    return {name: folder / f"{name}.tif" for name in found}


def _networks(folder: Path) -> dict[str, tuple[str, str]]:
    """The float and the INT8 file of each network: a shipped pair, and two of random weights
    quantised here.
    """
    network = ConvBEERS(Variant(blocks=2, features=8))
    initialise(network, torch.Generator().manual_seed(0))
    save_onnx(to_onnx(network, {}), folder / f"{PLAIN}.onnx")
    save_onnx(
        example_to_onnx(OTHER, build(OTHER, torch.Generator().manual_seed(0))),
        folder / f"{OTHER}.onnx",
    )
    found = {SHIPPED: (str(folder / "xs.onnx"), str(folder / "xs-int8.onnx"))}
    for name, path in ((SHIPPED, "xs.onnx"), (f"{SHIPPED}-int8", "xs-int8.onnx")):
        _run("export", "--network", name, "--out", folder / path)
    for name in (PLAIN, OTHER):
        _run("quantize", folder / f"{name}.onnx", "--out", folder / f"{name}-int8.onnx", *PATCHES)
        found[name] = (str(folder / f"{name}.onnx"), str(folder / f"{name}-int8.onnx"))
    return found


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
    """How often each value stands among the int8 weights, and the sum of the int32 biases."""
    constants = [numpy_helper.to_array(each) for each in onnx.load(path).graph.initializer]
    weights = [each.ravel() for each in constants if each.dtype == np.int8 and each.ndim == 4]
    biases = [each.ravel() for each in constants if each.dtype == np.int32]
    return {
        "weights": np.bincount(np.concatenate(weights).astype(int) + 128, minlength=256),
        "biases": np.array([each.astype(np.int64).sum() for each in biases]),
    }


def _figures(key: str, folder: Path, *command: str) -> dict[str, Any]:
    """Figures of a command's JSON that no clock made: of a bench those of the DPU, whole."""
    out = folder / "figures.json"
    _run(*command, "--json", out)
    rows = json.loads(out.read_text(encoding="utf-8"))["rows"]
    return {
        f"{key}: {row['table']}, {row['name']}, {name}": figure["value"]
        for row in rows
        for name, figure in row["figures"].items()
        if command[0] != "bench" or "on the DPU (" in row["name"] or "sum:" in row["name"]
    }


def main() -> None:
    """Write what is kept anew."""
    with tempfile.TemporaryDirectory() as folder:
        arrays, figures = outputs(Path(folder))
    np.savez_compressed(KEPT.with_suffix(".npz"), **arrays)  # type: ignore[arg-type]
    KEPT.with_suffix(".json").write_text(json.dumps(figures, indent=0) + "\n", encoding="utf-8")
    sys.stdout.write(f"{len(arrays)} arrays, {len(figures)} figures\n")


if __name__ == "__main__":
    main()
