"""What this machine did while something was measured: load of its CPUs, and the memory that it took."""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

from profiles.figures import Figure, measured, unavailable

SAMPLE_S = 0.002
STATUS = Path("/proc/self/status")
"""Linux's own counts of this process."""


def cpu_load() -> Figure:
    """Load of all CPUs since the last call in this process, other processes included."""
    return measured(psutil.cpu_percent(), "%", "all CPUs over the same window, other processes included")


def peak_memory() -> Figure:
    """Most resident memory of this process since it began, in GB; unavailable where the system does not count it."""
    peak = _peak_bytes()
    if peak is None:
        return unavailable("GB", "this system counts no peak memory")
    return measured(peak / 1e9, "GB", "resident memory of this process, highest since it began")


def _peak_bytes() -> int | None:
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    with suppress(OSError, StopIteration):  # getrusage's count on Linux begins with what the process's parent held
        lines = STATUS.read_text(encoding="utf-8").splitlines()
        return 1024 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak  # macOS counts bytes, the others KiB


@dataclass
class Memory:
    """By how many bytes resident memory rose at most."""

    rise_bytes: int = 0


@contextmanager
def memory_rise() -> Iterator[Memory]:
    """The highest rise of this process's resident memory over a block of work, sampled every 2 ms.

    No count of the system's says it: theirs begin with the process, and a block after a larger one would seem to
    take nothing.
    """
    memory, process, done = Memory(), psutil.Process(), threading.Event()
    start = process.memory_info().rss

    def sample() -> None:
        memory.rise_bytes = max(memory.rise_bytes, process.memory_info().rss - start)

    def keep_sampling() -> None:
        while not done.wait(SAMPLE_S):
            sample()

    sampler = threading.Thread(target=keep_sampling, daemon=True)
    sampler.start()
    try:
        yield memory
    finally:
        sample()
        done.set()
        sampler.join()
