"""Tests that a stopped run leaves the old output or the new one, and is resumed to the same bytes.

BEERS_KILLS=50 kills 50 runs. The suite kills a few.
"""

import errno
import os
import signal
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from beers_deploy.cli.run import INTERRUPTED
from beers_deploy.model.io.lock import part_folder
from beers_deploy.profiles.errors import MachineError, OptionError
from beers_deploy.restoration.output import RestoredPixels
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import begin, noise, stop_after, stopped_after, until
from tests.model.raster import formats as images

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("BEERS_KILLS", "2"))
TILE_PX = 64


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("image") / "in.tif"
    tifffile.imwrite(path, noise(900, 260), tile=(16, 16))
    return path


@pytest.fixture(scope="module")
def expected(image: Path, model: Path) -> bytes:
    """Return the bytes of an undisturbed run."""
    out = image.with_name("expected.tif")
    restore(image, out, network=model, tile=TILE_PX)
    return out.read_bytes()


def resume_options(model: Path) -> list[str]:
    return f"--network {model} --tile {TILE_PX} --resume --overwrite".split()


def finish(image: Path, out: Path, words: list[str], expected: bytes) -> None:
    """Run to the end, and check the bytes that are written."""
    running = begin(image, out, *words)
    output, _ = running.communicate(timeout=120)
    assert running.returncode == 0, output
    assert out.read_bytes() == expected


def test_killed_at_random_moments_it_is_resumed_to_the_same_bytes(
    image: Path, model: Path, expected: bytes, tmp_path: Path
) -> None:
    out = tmp_path / "out.tif"
    rng = np.random.default_rng()
    out.write_bytes(b"old")
    finished = 0
    for _ in range(KILLS):
        running = begin(image, out, *resume_options(model))
        until(running, rng.choice(["plan", "memory", "memory"]))
        time.sleep(rng.uniform(0, 0.8))
        running.kill()
        running.communicate()
        finished += running.returncode == 0
        assert out.read_bytes() in (b"old", expected)
    finish(image, out, resume_options(model), expected)
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.skipif(sys.platform == "win32", reason="no other process can send Ctrl-C on Windows")
def test_ctrl_c_prints_how_to_resume(
    image: Path, model: Path, expected: bytes, tmp_path: Path
) -> None:
    out = tmp_path / "out.tif"
    running = begin(image, out, *resume_options(model))
    until(running, "memory")
    running.send_signal(signal.SIGINT)
    output, _ = running.communicate(timeout=60)
    assert running.returncode == INTERRUPTED
    assert "--resume" in output
    assert "Traceback" not in output
    assert not out.exists()
    restore(image, out, network=model, tile=TILE_PX, threads=1, resume=True)
    assert out.read_bytes() == expected


def test_finished_rows_are_not_restored_again(
    image: Path, model: Path, expected: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out.tif"
    run = partial(restore, network=model, tile=TILE_PX)
    with stopped_after(50):
        run(image, out)
    stop_after(50, monkeypatch, AssertionError("restored more than what was left"))
    run(image, out, resume=True)
    assert out.read_bytes() == expected
    with pytest.raises(OptionError, match="exists already"):
        run(image, out, resume=True)


@pytest.mark.parametrize("calls", [0, 4, 1000])
def test_a_full_disk_is_an_error_of_one_line_and_loses_no_finished_row(
    calls: int,
    image: Path,
    model: Path,
    expected: bytes,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The disk fills up at the first rows, at later ones, or while the output is written."""
    out = tmp_path / "out.tif"
    run = partial(restore, network=model, tile=TILE_PX)
    count = iter(range(10**6))
    sync = os.fsync

    def full(handle: Any, *_: Any) -> None:
        if next(count) == calls or calls == 1000:
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(handle)

    if calls == 1000:
        monkeypatch.setattr(RestoredPixels, "read", full)
    else:
        monkeypatch.setattr(os, "fsync", full)
    out.write_bytes(b"old")
    with pytest.raises(MachineError, match=r"No space left.*resume"):
        run(image, out, compression="none", overwrite=True)
    monkeypatch.undo()
    assert out.read_bytes() == b"old"
    run(image, out, resume=True, overwrite=True)
    assert out.read_bytes() == expected


def test_killed_among_its_rows_and_at_its_cog_it_is_resumed_to_the_same_bytes(
    model: Path, tmp_path: Path
) -> None:
    """The image is an index of several files."""
    image = images.write_vrt(tmp_path / "a.vrt")
    out = tmp_path / "out.tif"
    restore(image, tmp_path / "expected.tif", network=model, tile=16, threads=1, cog=True)
    expected = (tmp_path / "expected.tif").read_bytes()
    before = {path.name for path in tmp_path.iterdir()}
    out.write_bytes(b"old")
    words = f"--network {model} --tile 16 --cog --resume --overwrite".split()
    # The journal is there when some rows are finished, the TIFF when all rows are.
    for sign in ("journal.json", "out.tif"):
        running = begin(image, out, *words)
        while running.poll() is None and not (part_folder(out) / sign).exists():
            time.sleep(0.001)
        running.kill()
        output, _ = running.communicate()
        assert running.returncode < 0 or (sign == "out.tif" and not running.returncode), output
        assert out.read_bytes() in (b"old", expected)
    finish(image, out, words, expected)
    assert {path.name for path in tmp_path.iterdir()} == before | {"out.tif"}
