"""The oldest versions of the dependencies that pyproject.toml allows run the main commands.

`.ci/run` runs the tests in a new environment, which has the newest versions. The oldest are
installed without PyTorch, because these commands work without it.
"""

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import onnx
import pytest
import tifffile
from packaging.requirements import Requirement

from tests.deploy.dpu.graphs import SAME
from tests.project_files import ROOT, text_of
from tests.quant.simplify.networks import parsed

PROJECT = [
    "deploy",
    "model",
    "profiles",
    "quant",
    "pyproject.toml",
    "setup.py",
    "MANIFEST.in",
    "README.md",
    "LICENSE",
]
SIDE_PX = 96
SCENE_PX = 400
SAMPLES = 4


def lowest_versions() -> list[str]:
    """Return `name==version` of each core dependency, by the lower bound that pyproject.toml
    declares.
    """
    declared = tomllib.loads(text_of("pyproject.toml"))["project"]["dependencies"]
    pins = []
    for requirement in map(Requirement, declared):
        (lowest,) = (clause.version for clause in requirement.specifier if clause.operator == ">=")
        pins.append(f"{requirement.name}=={lowest}")
    return pins


def pip(python: Path, *words: object) -> subprocess.CompletedProcess[str]:
    # To compile the bytecode of all of SciPy takes longer than to install it.
    options = ("--quiet", "--disable-pip-version-check", "--no-compile", *map(str, words))
    return subprocess.run(
        [python, "-m", "pip", "install", *options], capture_output=True, text=True
    )


def copied_project(folder: Path) -> Path:
    """Copy the files of the package, because a build in the repository would leave files there."""
    for name in PROJECT:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder / name)
    return folder


@pytest.fixture(scope="module")
def lowest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the Python of a new environment with the oldest version of every core dependency."""
    folder = tmp_path_factory.mktemp("lowest")
    subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)
    python = folder / "venv" / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    reached = pip(python, "--dry-run", "--retries", 0, "--timeout", 15, "filelock")
    if reached.returncode:
        pytest.skip(f"the package index cannot be reached: {reached.stderr.strip()[-200:]}")
    constraints = folder / "constraints.txt"
    constraints.write_text("\n".join(lowest_versions()), encoding="utf-8")
    project = copied_project(tmp_path_factory.mktemp("project"))
    installed = pip(python, "--constraint", constraints, project)
    assert installed.returncode == 0, installed.stderr
    return python


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a raw image, a scene, a small network and samples for it."""
    rng = np.random.default_rng(0)
    for name, side_px in (("raw.tif", SIDE_PX), ("scene.tif", SCENE_PX)):
        tifffile.imwrite(
            tmp_path / name, rng.integers(400, 3000, (side_px, side_px)).astype(np.uint16)
        )
    np.save(
        tmp_path / "samples.npy",
        rng.uniform(0, 1, (SAMPLES, 1, SIDE_PX, SIDE_PX)).astype(np.float32),
    )
    model = parsed(
        f"a = {SAME}(image, first) b = Relu(a) c = {SAME}(b, last) y = Add(image, c)",
        "float[N,1,H,W] image => float[N,1,H,W] y",
        constants={
            "first": rng.normal(0, 0.1, (8, 1, 3, 3)),
            "last": rng.normal(0, 0.1, (1, 8, 3, 3)),
        },
    )
    onnx.save(model, tmp_path / "float.onnx")
    return tmp_path


COMMANDS = """
--help
restore --help
restore raw.tif float32.tif --network convbeers-xs --sensor pleiades-degraded
restore raw.tif int8.tif --network convbeers-xs-int8 --sensor pleiades-degraded
simulate --images scene.tif --sensor pleiades-degraded --out pairs
quantize float.onnx --samples samples.npy --effort fast --out int8.onnx
gate float.onnx int8.onnx --samples samples.npy --json gate.json
check int8.onnx --tile 64
bench int8.onnx --size 200x100 --tile 64 --no-traditional
"""
# In one process, because to load the libraries takes longer than most commands. A verdict on so
# small a network may be negative.
RUN_ALL = """
import sys
from beers_deploy.cli.commands import app

for line in sys.stdin.read().strip().splitlines():
    try:
        app(line.split())
    except SystemExit as end:
        assert end.code in (0, 1), line
"""


@pytest.mark.slow
def test_the_oldest_versions_run_the_main_commands(lowest: Path, folder: Path) -> None:
    process = subprocess.run(
        [lowest, "-c", RUN_ALL],
        cwd=folder,
        input=COMMANDS,
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stdout[-2000:] + process.stderr[-2000:]


def test_every_dependency_has_a_lower_bound() -> None:
    assert all(pin.partition("==")[2] for pin in lowest_versions())
