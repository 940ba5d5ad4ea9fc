"""Every command of the how-to pages, run on small files: it ends as the page says, and what it
names is written.
"""

import shutil
import tempfile
from pathlib import Path

import pytest

from tests.docs.how_to import (
    LEFT_OUT,
    PAGES,
    STARTED,
    Sitting,
    outputs,
    packages,
    shortened,
    sittings,
)
from tests.docs.how_to_files import prepare
from tests.docs.walk import Walk

pytestmark = pytest.mark.slow

FOUND = {page.stem: [*sittings(page.read_text(encoding="utf-8"))] for page in PAGES}
RUN: dict[str, Sitting] = {}
for page, all_commands in FOUND.items():
    for sitting in all_commands:
        commands = tuple(command for command in sitting if command not in LEFT_OUT)
        if commands:
            RUN[f"{page}, {commands[0]}"] = commands


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the pages name."""
    folder = tmp_path_factory.mktemp("how-to") / "files"
    folder.mkdir()
    prepare(folder)
    return folder


@pytest.mark.parametrize("sitting", RUN.values(), ids=RUN)
def test_it_runs_and_writes_what_it_names(sitting: Sitting, files: Path) -> None:
    for package in packages(sitting):
        pytest.importorskip(package, reason=f"no {package}")
    with tempfile.TemporaryDirectory(dir=files.parent) as folder:
        copy = Path(shutil.copytree(files, folder, dirs_exist_ok=True))
        walk = Walk(copy, started=STARTED)
        for command in sitting:
            run(walk, command)


def run(walk: Walk, command: str) -> None:
    """Run it as it is short; what it writes was not there before."""
    short = shortened(command)
    paths = [walk.folder / path for path in outputs(short)]
    for path in paths:
        path.unlink(missing_ok=True)
    process = walk.run(short)
    assert process.returncode == 0, f"{command}\nrun as {short}\n{process.stdout}"
    assert [path for path in paths if not path.is_file()] == [], (
        f"{command}\nrun as {short}\n{process.stdout}"
    )
    if command.startswith("rio cogeo validate"):
        assert "is a valid cloud optimized GeoTIFF" in process.stdout
