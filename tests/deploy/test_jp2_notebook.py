"""The cells of docs/tutorials/jp2-to-cog.ipynb, as a reader would run them, and the words it keeps
of such a run.
"""

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from beers_deploy.cli import app

pytestmark = pytest.mark.slow

NOTEBOOK = Path(__file__).parents[2] / "docs" / "tutorials" / "jp2-to-cog.ipynb"
CELLS: list[dict[str, Any]] = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
MOST_BYTES = 100_000
"""Of the whole notebook with its picture: a clone carries every version of it."""


def run_cell(source: str, names: dict[str, Any]) -> str:
    """What a cell prints: of Python, or of the program where its line begins with an exclamation
    mark.
    """
    printed = io.StringIO()
    if source.startswith("!beers-deploy "):
        done = CliRunner().invoke(app, source.split()[1:])
        assert done.exit_code == 0, (source, done.output, done.exception)
        return done.stdout
    with contextlib.redirect_stdout(printed):
        exec(source, names)  # noqa: S102 - our own notebook
    return printed.getvalue()


def test_its_cells_run_and_print_what_it_keeps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rasterio")
    pytest.importorskip("pystac")
    import matplotlib.pyplot as plt

    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    with plt.rc_context({"backend": "Agg"}):
        for cell in CELLS:
            if cell["cell_type"] == "code":
                printed = run_cell("".join(cell["source"]), names)
                kept = "".join(
                    line for output in cell["outputs"] for line in output.get("text", [])
                )
                assert not kept or printed == kept
        plt.close("all")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "raw.jp2",
        "restored.json",
        "restored.tif",
    ]
    truth = names["pair"].reference
    errors = {
        name: np.abs(gain_of(names[name], truth) - truth).mean() for name in ("before", "restored")
    }
    assert errors["restored"] < 0.7 * errors["before"]


def gain_of(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """An image in the digital numbers of another sensor, by the line that fits best."""
    slope, offset = np.polyfit(image.ravel(), truth.ravel(), 1)
    scaled: np.ndarray = slope * image + offset
    return scaled


def test_it_is_small_and_shows_a_picture() -> None:
    assert NOTEBOOK.stat().st_size < MOST_BYTES
    kinds = [
        kind
        for cell in CELLS
        for output in cell.get("outputs", [])
        for kind in output.get("data", {})
    ]
    assert kinds.count("image/png") == 1


def test_the_pages_beside_it_are_there() -> None:
    import re

    words = "".join(
        line for cell in CELLS if cell["cell_type"] == "markdown" for line in cell["source"]
    )
    for target in re.findall(r"\]\(([^)]+)\)", words):
        assert (NOTEBOOK.parent / target).is_file(), target
