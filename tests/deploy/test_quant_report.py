"""What `quantize` reports: layers in whole numbers, and what each pass buys."""

import json
from pathlib import Path

import jsonschema
import torch
from typer.testing import CliRunner

from deploy.cli import app
from deploy.export import to_onnx
from deploy.quant_report import ablations
from deploy.results import SCHEMA_PATH
from model.convbeers import ConvBEERS, Variant, initialise
from quant.onnx_file import save_onnx
from quant.quantise import ALL, Passes


def test_every_pass_is_left_out_once() -> None:
    found = ablations()
    assert found["all passes"] == ALL
    assert found["none"] == Passes(*[False] * 5)
    assert len(found) == 7
    assert not found["without steady stream"].equalise


def test_quantize_reports_layers_and_passes(tmp_path: Path) -> None:
    network = ConvBEERS(Variant(1, 4))
    initialise(network, torch.Generator().manual_seed(0))
    save_onnx(to_onnx(network.eval(), {}), tmp_path / "f.onnx")
    options = ["--out", str(tmp_path / "i.onnx"), "--patches", "4", "--ablate", "--json", str(tmp_path / "q.json")]
    result = CliRunner().invoke(app, ["quantize", str(tmp_path / "f.onnx"), *options])
    assert result.exit_code == 0, result.output
    document = json.loads((tmp_path / "q.json").read_text())
    jsonschema.validate(document, json.loads(SCHEMA_PATH.read_text()))
    tables = [row["table"] for row in document["rows"]]
    assert tables.count("integer layers") == 7
    assert tables.count("ablation") == 7
    for row in document["rows"]:
        if row["table"] == "integer layers":
            figures = row["figures"]
            assert figures["accumulator, seen"]["value"] <= figures["accumulator, proven"]["value"] < 31
