import json
from pathlib import Path

import jsonschema
import numpy as np
import tifffile
from typer.testing import CliRunner

from deploy.cli import app
from deploy.results import SCHEMA_PATH


def test_the_demo_takes_a_raw_image_through_the_whole_chain(tmp_path: Path) -> None:
    raw = tmp_path / "raw.tif"
    tifffile.imwrite(raw, np.random.default_rng(0).integers(300, 1500, (120, 150)).astype(np.uint16))
    out, figures = tmp_path / "out", tmp_path / "figures.json"
    result = CliRunner().invoke(app, ["demo", "--image", str(raw), "--out", str(out), "--json", str(figures)])
    assert result.exit_code == 0, result.output
    made = {path.name for path in out.iterdir()}
    assert made == {"report.html", "float.onnx", "int8.onnx", "core.onnx", "restored.tif", "before-after.png"}
    assert tifffile.imread(out / "restored.tif").shape == (120, 150)
    document = json.loads(figures.read_text())
    jsonschema.validate(document, json.loads(SCHEMA_PATH.read_text()))
    modes = {figure["mode"] for row in document["rows"] for figure in row["figures"].values()}
    assert {"measured", "predicted", "published"} <= modes
    assert "fits the DPU whole" in (out / "report.html").read_text()
