"""Test that the cells of docs/tutorials/jp2-to-cog.ipynb run and print their stored outputs."""

import contextlib
import io
import json
import re
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from beers_deploy.cli.commands import app
from tests.project_files import ROOT

pytestmark = pytest.mark.slow

NOTEBOOK = ROOT / "docs/tutorials/jp2-to-cog.ipynb"
CELLS: list[dict[str, Any]] = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
MOST_BYTES = 100_000
"""Largest size of the notebook with its picture, because a clone has every version of it."""


def run_cell(source: str, names: dict[str, Any]) -> str:
    """Run a cell of Python, or of a program after an exclamation mark; return what it prints."""
    stream = io.StringIO()
    if source.startswith("!beers-deploy "):
        result = CliRunner().invoke(app, source.split()[1:])
        assert result.exit_code == 0, (source, result.output, result.exception)
        return result.stdout
    with contextlib.redirect_stdout(stream):
        exec(source, names)  # noqa: S102 - our own notebook
    return stream.getvalue()


def test_its_cells_run_and_print_the_stored_outputs(working_folder: Path) -> None:
    pytest.importorskip("rasterio")
    pytest.importorskip("pystac")
    import matplotlib.pyplot as plt

    names: dict[str, Any] = {}
    with plt.rc_context({"backend": "Agg"}):
        for cell in CELLS:
            if cell["cell_type"] == "code":
                text = run_cell("".join(cell["source"]), names)
                lines = chain.from_iterable(output.get("text", []) for output in cell["outputs"])
                stored = "".join(lines)
                assert not stored or text == stored
        plt.close("all")
    assert sorted(path.name for path in working_folder.iterdir()) == [
        "raw.jp2",
        "restored-network.json",
        "restored-network.onnx",
        "restored.json",
        "restored.tif",
    ]
    truth = names["pair"].reference
    before = np.abs(gain_of(names["before"], truth) - truth).mean()
    after = np.abs(gain_of(names["restored"], truth) - truth).mean()
    assert after < 0.7 * before


def gain_of(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return an image in the digital numbers of another sensor, by the line that fits best."""
    slope, offset = np.polyfit(image.ravel(), truth.ravel(), 1)
    scaled: np.ndarray = slope * image + offset
    return scaled


def test_it_is_small_and_shows_a_picture() -> None:
    assert NOTEBOOK.stat().st_size < MOST_BYTES
    outputs = chain.from_iterable(cell.get("outputs", []) for cell in CELLS)
    pictures = ["image/png" in output.get("data", {}) for output in outputs]
    assert sum(pictures) == 1


def test_the_pages_that_it_links_exist() -> None:
    texts = ["".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "markdown"]
    for target in re.findall(r"\]\(([^)]+)\)", "".join(texts)):
        assert (NOTEBOOK.parent / target).is_file(), target
