"""Tests that run every command of docs/tutorials as a reader would, and compare its output.

Each tutorial starts in an empty folder.
"""

import re
import shutil
from pathlib import Path

import pytest
import tifffile

from tests.deploy.studies.tradeoff.small import small_studies
from tests.docs.walk import Walk
from tests.project_files import ROOT, text_of

pytestmark = pytest.mark.slow

FOLDER = ROOT / "docs/tutorials"
PAGES = sorted({path.stem for path in FOLDER.glob("*.md")} - {"index"})
INSTALLED = "python3 -m venv .venv && .venv/bin/pip install --quiet '.[all]'"


def run_page(name: str, folder: Path) -> Walk:
    walk = Walk(folder)
    walk.page(text_of(f"docs/tutorials/{name}.md"))
    return walk


@pytest.mark.parametrize("name", PAGES)
def test_it_is_set_up_as_the_readme_says(name: str) -> None:
    """.ci/run runs this command in an empty environment. Only this fence of a tutorial is not run
    here.
    """
    page = text_of(f"docs/tutorials/{name}.md")
    (block,) = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    assert block.splitlines()[0] == INSTALLED
    assert INSTALLED in text_of("README.md")
    assert set(re.findall(r"^```(\w+)", page, re.MULTILINE)) <= {
        "sh",
        "bash",
        "text",
        "python",
        "toml",
        "yaml",
    }


def test_restore_an_image(tmp_path: Path) -> None:
    run_page("restore-an-image", tmp_path)
    raw = tifffile.imread(tmp_path / "pairs" / "degraded" / "0000-drawn.tif")
    assert raw.max() < 4096
    assert tifffile.imread(tmp_path / "known.tif").shape == raw.shape
    assert tifffile.imread(tmp_path / "8bit-restored.tif").dtype == "uint8"


def test_your_sensor(tmp_path: Path) -> None:
    run_page("your-sensor", tmp_path)
    assert (tmp_path / "report" / "report.html").is_file()
    assert tifffile.imread(tmp_path / "network.tif").shape == (256, 256)


def test_real_camera(tmp_path: Path, shared_data: Path) -> None:
    """The page needs real frames, so the test is skipped without them."""
    for folder in ("frames", "restored/network", "restored/traditional"):
        (tmp_path / folder).mkdir(parents=True)
    for path in sorted((shared_data / "mono16").glob("*.tif")):
        shutil.copy(path, tmp_path / "frames" / path.name.replace("garfield", "IMG"))
    run_page("real-camera", tmp_path)
    assert (
        tifffile.imread(tmp_path / "restored/network/IMG_161122_164605_0126_GRE.tif").dtype
        == "uint16"
    )


def test_your_network(tmp_path: Path) -> None:
    run_page("your-network", tmp_path)
    raw, restored = (
        tifffile.imread(tmp_path / name)
        for name in ("pairs/degraded/0000-drawn.tif", "restored.tif")
    )
    assert (restored.shape, restored.dtype) == (raw.shape, raw.dtype)
    assert (restored != raw).any()


def test_gate_in_ci(tmp_path: Path) -> None:
    """The workflow may only use inputs that the action has, and files that the page wrote."""
    import yaml  # type: ignore[import-untyped]

    run_page("gate-in-ci", tmp_path)
    action, workflow = (
        yaml.safe_load(path.read_text(encoding="utf-8"))
        for path in (ROOT / "action.yml", tmp_path / ".github" / "workflows" / "gate.yml")
    )
    (inputs,) = (
        step["with"] for step in workflow["jobs"]["gate"]["steps"] if step.get("id") == "gate"
    )
    assert set(inputs) <= set(action["inputs"])
    assert all((tmp_path / path.removeprefix("protected/")).is_file() for path in inputs.values())
    assert 'failures="5"' in (tmp_path / "gate.xml").read_text(encoding="utf-8")


def test_accuracy_and_time(tmp_path: Path) -> None:
    with small_studies():
        run_page("accuracy-and-time", tmp_path)
    files = {"tradeoff.html", "tradeoff.svg", "tradeoff.json"}
    assert {path.name for path in (tmp_path / "study").iterdir()} == files
    limits = "board latency &lt;= 20 s and board power &lt;= 18 W"
    assert f"Recommended for {limits}: convbeers-half INT8, zcu104" in (
        tmp_path / "study" / "tradeoff.html"
    ).read_text(encoding="utf-8")
