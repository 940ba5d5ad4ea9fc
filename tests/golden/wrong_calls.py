"""Forty wrong calls, and their answers: exit code and message.

Each file is named by its fault. `inputs` writes the files.
"""

from pathlib import Path

import numpy as np
import onnx
import tifffile
from typer.testing import CliRunner

from beers_deploy.cli.commands import app
from tests.quant.simplify.networks import parsed

CALLS = (
    "restore",
    "restore none.tif out.tif",
    "restore image.tif image.tif",
    "restore empty.tif out.tif",
    "restore nan.tif out.tif",
    "restore image.tif out.jpg",
    "restore image.tif out.tif --network none",
    "restore image.tif out.tif --network empty.onnx",
    "restore image.tif out.tif --sensor none",
    "restore image.tif out.tif --tile 7",
    "restore image.tif out.tif --full-scale -1",
    "restore image.tif out.tif --method magic",
    "restore none.tif --dry-run",
    "restore text.tif --dry-run",
    "export --network none --out out.onnx",
    "export --network convbeers-xs --out out.txt",
    "quantize none.onnx --out out.onnx",
    "quantize text.onnx --out out.onnx",
    "quantize pixelwise.onnx --out out.onnx --patches 0",
    "quantize pixelwise.onnx --out out.onnx --images none",
    "gate convbeers-xs --baseline none.json",
    "gate convbeers-xs --max-mae -0.1",
    "gate pixelwise.onnx",
    "gate convbeers-xs --baseline text.json",
    "check none.onnx",
    "check pixelwise.onnx --target none",
    "check pixelwise.onnx --target broken.toml",
    "bench convbeers-xs-int8 --size 0x0",
    "bench convbeers-xs-int8 --size large",
    "bench convbeers-xs-int8 --target unknown.toml",
    "evaluate --pairs none",
    "tradeoff --images none --out out",
    "stress none.onnx none.onnx",
    "profiles none",
    "characterise none.tif --out out.toml",
    "simulate --images none --out out",
    "simulate --sensor broken.toml --out out",
    "train --recipe none --images none --out out",
    "none",
    "restore image.tif out.tif --none",
)
"""Command lines, which are run in the folder of the files."""


def inputs(folder: Path) -> None:
    """Write the files that the calls name."""
    pixels = np.random.default_rng(0).integers(100, 4000, (40, 50)).astype(np.uint16)
    tifffile.imwrite(folder / "image.tif", pixels)
    tifffile.imwrite(folder / "nan.tif", np.full((40, 50), np.nan, np.float32))
    for name in ("empty.tif", "empty.onnx"):
        (folder / name).touch()
    for name in ("text.tif", "text.onnx", "text.json"):
        (folder / name).write_text("words\n", encoding="utf-8")
    (folder / "broken.toml").write_text("[sensor\n", encoding="utf-8")
    (folder / "unknown.toml").write_text('base = "vck190"\nspeed = 3\n', encoding="utf-8")
    onnx.save(pixelwise(), str(folder / "pixelwise.onnx"))


def pixelwise() -> onnx.ModelProto:
    """Return a network of one convolution of 1 x 1."""
    sides = "[batch,1,height,width]"
    return parsed(
        "[scale] out = Conv(image, weight)",
        f"float{sides} image => float{sides} out",
        constants={"weight": [[[[0.9]]]]},
    )


def answer(words: str) -> dict[str, object]:
    """Run a call in the current folder; return its exit code, its error, and the files it left."""
    before = {path.name for path in Path().iterdir()}
    result = CliRunner(env={"COLUMNS": "200"}).invoke(app, words.split())
    # Lines of the log come first. Some of them, such as the memory, differ between machines.
    lines = result.stderr.splitlines()
    error = next((line for line in lines if line.startswith("beers-deploy: ")), result.stderr)
    # Click draws a box around the fault of an option, under a line of usage.
    message = " ".join(word for word in error.split() if not set(word) <= set("╭─│╮╰╯"))
    left = sorted({path.name for path in Path().iterdir()} - before)
    return {"exit code": result.exit_code, "message": message, "left behind": left}
