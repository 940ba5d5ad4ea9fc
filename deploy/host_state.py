"""What this machine did while something was measured: load and clock of its CPUs, and the memory that it took."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import psutil

from deploy.results import Figure, measured, unavailable

SAMPLE_S = 0.002


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
        watch.clock = unavailable("GHz", "this system does not tell its clock")


@dataclass
class Memory:
    """By how many bytes resident memory rose at most."""

    rise_bytes: int = 0


@contextmanager
def peak_memory() -> Iterator[Memory]:
    """Resident memory of this process, sampled every 2 ms over a block of work: its highest rise."""
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
    frequency = psutil.cpu_freq()
    return frequency.current / 1e3 if frequency and frequency.current else None
