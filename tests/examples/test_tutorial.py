"""The commands of docs/tutorials/your-network.md, one after the other, on a network trained for a moment."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "tutorials" / "your-network.md"
SMALLER = {"--steps 1000": "--steps 2", "--count 64": "--count 8", "--size 2048x2048": "--size 700x700 --budget 0"}
COMMANDS = re.findall(
    r"^    ((?:python -m examples|beers-deploy).*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE
)
ENTRY = {"beers-deploy": [sys.executable, "-c", "from deploy.cli import app; app()"], "python": [sys.executable]}


def run(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    for long, short in SMALLER.items():
        command = command.replace(long, short)
    program, *arguments = command.split()
    environment = {"PYTHONPATH": str(ROOT), "PATH": "", "HOME": str(folder), "OMP_NUM_THREADS": "1"}
    whole = [*ENTRY[program], *arguments]
    return subprocess.run(whole, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, subprocess.CompletedProcess[str]]]:
    folder = tmp_path_factory.mktemp("tutorial")
    pixels = np.random.default_rng(0).integers(0, 4096, (90, 131)).astype(np.uint16)
    tifffile.imwrite(folder / "raw.tif", pixels)
    return folder, {command: run(command, folder) for command in COMMANDS}


def test_every_command_runs(done: tuple[Path, dict[str, subprocess.CompletedProcess[str]]]) -> None:
    _, results = done
    assert len(results) == 9
    assert {command: r.stderr for command, r in results.items() if r.returncode} == {}


def test_each_leaves_what_the_next_one_needs(done: tuple[Path, dict[str, subprocess.CompletedProcess[str]]]) -> None:
    folder, results = done
    output = {command.split()[1]: result.stdout for command, result in results.items() if "beers-deploy" in command}
    assert "gate passed" in output["gate"]
    assert "check passed" in output["check"]
    assert "predicted" in output["bench"]
    restored = tifffile.imread(folder / "restored.tif")
    assert restored.shape == (90, 131)
    assert restored.dtype == np.uint16
