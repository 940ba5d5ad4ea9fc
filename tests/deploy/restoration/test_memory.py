"""Tests of the peak memory of a process, as each kind of system reports it."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from beers_deploy.profiles.figures import Figure
from beers_deploy.restoration.memory import peak_memory

MEGABYTE = 1_000_000
NOWHERE = Path("no such file")


def gigabytes(figure: Figure) -> float:
    assert figure.value is not None, figure.reason
    return figure.value


TAKE = """
import sys
from beers_deploy.restoration.memory import peak_memory
before = peak_memory().value
block = b"x" * int(sys.argv[1])
del block
print(before, peak_memory().value)
"""


def test_the_peak_includes_freed_memory_and_excludes_the_parent_s() -> None:
    block = b"x" * (400 * MEGABYTE)
    command = [sys.executable, "-c", TAKE, str(300 * MEGABYTE)]
    process = subprocess.run(command, capture_output=True, text=True, check=True)
    before, after = map(float, process.stdout.split())
    assert 0.005 < before < 0.3
    assert after - before == pytest.approx(0.3, abs=0.01)
    assert gigabytes(peak_memory()) > len(block) / 1e9


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has two ways to compare")
def test_the_posix_way_agrees_with_that_of_linux(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    own = gigabytes(peak_memory())
    monkeypatch.setattr("beers_deploy.restoration.memory.STATUS", NOWHERE)
    # The peak may be that of a parent process, which may have held more.
    assert own * 0.95 < gigabytes(peak_memory()) < psutil.virtual_memory().total / 1e9


@pytest.mark.parametrize(("system", "unit_bytes"), [("darwin", 1), ("freebsd14", 1024)])
def test_macos_counts_bytes_and_the_others_kibibytes(
    system: str, unit_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = SimpleNamespace(RUSAGE_SELF=0, getrusage=lambda _: SimpleNamespace(ru_maxrss=2_000_000))
    monkeypatch.setitem(sys.modules, "resource", usage)
    monkeypatch.setattr("beers_deploy.restoration.memory.STATUS", NOWHERE)
    monkeypatch.setattr(sys, "platform", system)
    assert gigabytes(peak_memory()) == pytest.approx(2e6 * unit_bytes / 1e9)
