"""Two runs never write one output at once, and no dead one stands in the way."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import tifffile

from deploy.shipped import default_int8
from deploy.swath import lock
from deploy.swath.lock import only_run
from deploy.swath.options import Options
from deploy.swath.run import restore_file
from profiles.errors import MachineError

pytest.importorskip("fcntl", reason="this system has no locks of files")

ENTRY = "from deploy.cli import app; app()"
TILE_PX = 64


@pytest.fixture
def image(tmp_path: Path) -> Path:
    pixels = np.random.default_rng(1).integers(0, 4096, (700, 400)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "in.tif", pixels)
    return tmp_path / "in.tif"


def begin(image: Path, out: Path) -> subprocess.Popen[str]:
    """A run in the middle of its rows."""
    arguments = ["restore", image, out, "--tile", TILE_PX, "--threads", 1]
    command = [sys.executable, "-c", ENTRY, *map(str, arguments)]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert running.stdout is not None
    assert any("memory" in line for line in running.stdout)
    return running


def restore(image: Path, out: Path, resume: bool = False) -> None:
    restore_file(image, out, Options(default_int8(), TILE_PX, resume=resume), lambda _: None)


def test_a_second_run_is_refused_and_the_first_one_unharmed(image: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.tif"
    with begin(image, out) as first:
        for resume in (False, True):
            with pytest.raises(MachineError, match=r"out.tif: expected no other run"):
                restore(image, out, resume)
        assert first.poll() is None
        restore(image, tmp_path / "other.tif")  # another output is nobody's business
        said, _ = first.communicate(timeout=120)
    assert first.returncode == 0, said
    assert out.read_bytes() == (tmp_path / "other.tif").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in.tif", "other.tif", "out.tif"]


def test_a_killed_run_stands_in_nobody_s_way(image: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.tif"
    with begin(image, out) as running:
        running.kill()
    assert (tmp_path / ".out.tif.part" / lock.NAME).is_file()
    restore(image, out, resume=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in.tif", "out.tif"]


def test_rows_outlive_the_lock(tmp_path: Path) -> None:
    folder = tmp_path / ".out.part"
    with only_run(tmp_path / "out", folder):
        (folder / "rows.raw").touch()
    assert [p.name for p in folder.iterdir()] == ["rows.raw"]
    with only_run(tmp_path / "out", folder):
        (folder / "rows.raw").unlink()
    assert not folder.exists()


def test_it_is_given_back_after_an_error(tmp_path: Path) -> None:
    for _ in range(2):
        with pytest.raises(ZeroDivisionError), only_run(tmp_path / "out", tmp_path / ".out.part"):
            raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_a_run_that_ends_just_then_takes_no_lock_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between opening the file and locking it, the run that held it ends: the lock must be on the new file."""
    folder, taken = tmp_path / ".out.part", lock._lock
    ends = iter([True, True, False])

    def ending(handle: int) -> bool:
        if next(ends):
            (folder / lock.NAME).unlink()
            folder.rmdir()
        return taken(handle)

    monkeypatch.setattr(lock, "_lock", ending)
    with only_run(tmp_path / "out", folder):
        monkeypatch.undo()
        assert (folder / lock.NAME).is_file()
        with pytest.raises(MachineError, match="no other run"), only_run(tmp_path / "out", folder):
            pass


def test_many_that_try_are_never_two_at_once(tmp_path: Path) -> None:
    inside, most, refused = [0], [0], [0]

    def trying() -> None:
        for _ in range(100):
            try:
                with only_run(tmp_path / "out", tmp_path / ".out.part"):
                    inside[0] += 1
                    most[0] = max(most[0], inside[0])
                    os.sched_yield()
                    inside[0] -= 1
            except MachineError:
                refused[0] += 1

    threads = [threading.Thread(target=trying) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most[0] == 1
    assert refused[0] < 400
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / ".out.part").touch()
    with (
        pytest.raises(MachineError, match="a folder to write to"),
        only_run(tmp_path / "out", tmp_path / ".out.part"),
    ):
        pass
