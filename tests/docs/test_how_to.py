"""Tests that every command of the how-to pages runs on small files and writes its outputs."""

import shutil
import tempfile
from pathlib import Path

import pytest

from tests.docs.how_to import (
    LEFT_OUT,
    PAGES,
    STARTED,
    Session,
    outputs,
    packages,
    sessions,
    shortened,
)
from tests.docs.how_to_files import prepare
from tests.docs.walk import Walk

pytestmark = pytest.mark.slow

SESSIONS = {page.stem: [*sessions(page.read_text(encoding="utf-8"))] for page in PAGES}
CASES: dict[str, Session] = {}
for page, all_commands in SESSIONS.items():
    for session in all_commands:
        commands = tuple(command for command in session if command not in LEFT_OUT)
        if commands:
            CASES[f"{page}, {commands[0]}"] = commands


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the files that the pages name."""
    folder = tmp_path_factory.mktemp("how-to") / "files"
    folder.mkdir()
    prepare(folder)
    return folder


@pytest.mark.parametrize("session", CASES.values(), ids=CASES)
def test_the_commands_run_and_write_their_outputs(session: Session, files: Path) -> None:
    for package in packages(session):
        pytest.importorskip(package, reason=f"no {package}")
    with tempfile.TemporaryDirectory(dir=files.parent) as folder:
        copy = Path(shutil.copytree(files, folder, dirs_exist_ok=True))
        walk = Walk(copy, started=STARTED)
        for command in session:
            run(walk, command)


def run(walk: Walk, command: str) -> None:
    """Run the shortened command, and check that it writes its outputs."""
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
