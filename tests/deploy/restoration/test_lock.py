"""Tests that two runs never write one output at once, and that the lock leaves no files."""

import sys
import threading
import time
from pathlib import Path

import pytest
import tifffile

from beers_deploy.model.io import lock
from beers_deploy.model.io.lock import only_run
from beers_deploy.profiles.errors import MachineError
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import begin, names, noise, until

TILE_PX = 64


@pytest.fixture
def image(tmp_path: Path) -> Path:
    tifffile.imwrite(tmp_path / "in.tif", noise(700, 400))
    return tmp_path / "in.tif"


@pytest.mark.slow
def test_a_second_run_is_refused_and_the_first_one_unharmed(image: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.tif"
    with begin(image, out, "--tile", TILE_PX) as first:
        assert until(first, "memory")
        for resume in (False, True):
            with pytest.raises(
                MachineError, match=r"Another run is at work on the output .*out\.tif\."
            ):
                restore(image, out, tile=TILE_PX, resume=resume)
        assert first.poll() is None
        # The lock is on the output, so a run to another one is allowed.
        restore(image, tmp_path / "other.tif", tile=TILE_PX)
        output, _ = first.communicate(timeout=120)
    assert first.returncode == 0, output
    assert out.read_bytes() == (tmp_path / "other.tif").read_bytes()
    assert names(tmp_path) == ["in.tif", "other.tif", "out.tif"]


@pytest.mark.skipif(sys.platform == "win32", reason="only POSIX systems have flock")
@pytest.mark.parametrize("number", lock.NO_LOCKS)
def test_a_disk_without_locks_locks_nothing_and_is_left_clean(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fcntl

    def refuse(*_: int) -> None:
        raise OSError(number, "no locks here")

    monkeypatch.setattr(fcntl, "flock", refuse)
    folder = tmp_path / ".out.part"
    with only_run(tmp_path / "out"), only_run(tmp_path / "out"):
        pass
    assert not folder.exists()


def test_new_parent_folders_are_removed_unless_something_was_written_there(tmp_path: Path) -> None:
    out = tmp_path / "new" / "below" / "out"
    with pytest.raises(ZeroDivisionError), only_run(out):
        raise ZeroDivisionError
    assert names(tmp_path) == []
    # This folder is empty, but no run made it, so no run may remove it.
    (tmp_path / "new").mkdir()
    with only_run(out):
        pass
    assert [path.name for path in tmp_path.rglob("*")] == ["new"]
    with only_run(out):
        out.touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["new", "below", "out"]


@pytest.mark.skipif(
    sys.platform == "win32", reason="Windows removes no open file, so this cannot happen"
)
def test_a_run_that_ends_just_before_the_lock_does_not_invalidate_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The previous run ends after the file was opened and before it is locked.

    The lock must then be on the new file.
    """
    import fcntl

    folder = tmp_path / ".out.part"
    flock = fcntl.flock
    ends = iter([True, True, False])

    def ending(handle: int, operation: int) -> None:
        if operation & fcntl.LOCK_EX and next(ends):
            (folder / lock.NAME).unlink()
            folder.rmdir()
        flock(handle, operation)

    monkeypatch.setattr(fcntl, "flock", ending)
    # On a busy machine the next attempt may come late.
    monkeypatch.setattr(lock, "GRACE_S", 60.0)
    with only_run(tmp_path / "out"):
        monkeypatch.undo()
        assert (folder / lock.NAME).is_file()
        with pytest.raises(MachineError, match="Another run"), only_run(tmp_path / "out"):
            pass


def test_at_most_one_of_many_threads_has_the_lock(tmp_path: Path) -> None:
    inside = [0]
    most = [0]
    refusals = [0]

    def trying() -> None:
        for _ in range(100):
            try:
                with only_run(tmp_path / "out"):
                    inside[0] += 1
                    most[0] = max(most[0], inside[0])
                    time.sleep(0)
                    inside[0] -= 1
            except MachineError:
                refusals[0] += 1

    threads = [threading.Thread(target=trying) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most[0] == 1
    assert refusals[0] < 400
    assert names(tmp_path) == []


def test_links_in_the_place_of_a_run_s_files_are_refused_and_nothing_behind_them_changes(
    image: Path, tmp_path: Path
) -> None:
    mine = tmp_path / "mine"
    out = tmp_path / "out.tif"
    mine.mkdir()
    for name in ("out.tif", "cog.tif.aux", "rows.raw"):
        (mine / name).write_bytes(b"mine")
    lock.part_folder(out).symlink_to(mine, target_is_directory=True)
    with pytest.raises(MachineError, match="a symbolic link"):
        restore(image, out, network="convbeers-xs-int8", tile=TILE_PX)
    lock.part_folder(out).unlink()
    lock.part_folder(out).mkdir()
    (lock.part_folder(out) / "rows.raw").symlink_to(mine / "rows.raw")
    with pytest.raises(MachineError, match="a symbolic link"):
        restore(image, out, network="convbeers-xs-int8", tile=TILE_PX, resume=True)
    assert {path.read_bytes() for path in mine.iterdir()} == {b"mine"}
