"""What this machine did while something was measured: load and clock of its CPUs, and the memory that it took."""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from profiles.figures import Figure, measured, unavailable

SAMPLE_S = 0.002
STATUS = Path("/proc/self/status")
"""Linux's own counts of this process."""


@dataclass
class Watch:
    """Filled in when the watched block ends."""

    load: Figure = field(default_factory=lambda: unavailable("%", "not measured"))
    clock: Figure = field(default_factory=lambda: unavailable("GHz", "not measured"))


@contextmanager
def watched() -> Iterator[Watch]:
    """Load of all CPUs, other processes included, and their clock, over a block of work."""
    watch, before, first_ghz = Watch(), psutil.cpu_times(), _clock_ghz()
    yield watch
    watch.load = _load(before, psutil.cpu_times())
    clocks = [ghz for ghz in (first_ghz, _clock_ghz()) if ghz]
    if clocks:
        watch.clock = measured(sum(clocks) / len(clocks), "GHz", "mean of all CPUs at start and end")
    else:
        watch.clock = unavailable("GHz", "this system does not tell the clock of the moment")


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


def _load(before: tuple[float, ...], after: tuple[float, ...]) -> Figure:
    """Share of CPU time that was not idle, from two readings of psutil.cpu_times()."""
    spent = {name: b - a for name, a, b in zip(type(before)._fields, before, after, strict=True)}  # type: ignore[attr-defined]
    total = sum(value for name, value in spent.items() if not name.startswith("guest"))  # guests are counted in user
    if total <= 0:
        return unavailable("%", "too short for the system's clock of CPU time")
    idle = spent["idle"] + spent.get("iowait", 0.0)
    return measured(100 * (1 - idle / total), "%", "all CPUs over the same window, other processes included")


def _clock_ghz() -> float | None:
    if sys.platform != "linux":  # elsewhere psutil knows the nominal clock alone
        return None
    frequency = psutil.cpu_freq()
    return frequency.current / 1e3 if frequency and frequency.current else None
