"""Time calls on this machine: one call with its power, or several calls interleaved.

Power is read from RAPL's counters, never guessed from a data sheet.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import psutil

from beers_deploy.profiles.figures import Figure, measured, unavailable

POWERCAP = Path("/sys/class/powercap")
"""The folder of the energy counters (RAPL) of Linux."""

Result = TypeVar("Result")


def timed(work: Callable[[], Result]) -> tuple[Result, float, Figure]:
    """Run some work once, and measure its wall time and the mean power of the processor.

    Args:
        work: the function to run.

    Returns:
        The result of `work`, its wall time in s, and the power in W of all processor packages,
        unavailable if there are no counters.
    """
    before = _counters_uj()
    start = time.perf_counter()
    result = work()
    elapsed_s = time.perf_counter() - start
    after = _counters_uj()
    if isinstance(before, str):
        return result, elapsed_s, unavailable("W", before)
    if isinstance(after, str):
        return result, elapsed_s, unavailable("W", after)
    energy_uj = 0
    for domain, first_uj in before.items():
        energy_uj += after[domain] - first_uj
        # A counter starts again at its range.
        if after[domain] < first_uj:
            energy_uj += int((domain / "max_energy_range_uj").read_text(encoding="utf-8"))
    source = "RAPL package counters over the same window"
    return result, elapsed_s, measured(energy_uj / 1e6 / elapsed_s, "W", source)


def _counters_uj() -> dict[Path, int] | str:
    """Read the counters of the packages in microjoules, or return the reason why there are none."""
    try:
        counters = {
            domain: int((domain / "energy_uj").read_text(encoding="utf-8"))
            for domain in POWERCAP.glob("*rapl*:*")
            if (domain / "name").read_text(encoding="utf-8").startswith("package")
        }
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no number in it"
        return f"RAPL energy counters cannot be read here ({reason})"
    return counters or "this machine shows no RAPL energy counters (usual in virtual machines)"


def interleaved(
    calls: Sequence[Callable[[], object]], rounds: int, least_s: float = 0.0
) -> list[list[tuple[float, Figure]]]:
    """Time several calls in turn, once per round, so that other load affects all of them alike.

    Args:
        calls: the functions to time, already warmed up.
        rounds: the smallest number of rounds.
        least_s: the shortest total time of each call in s. Rounds are added until every call has
            reached it.

    Returns:
        For each call, the time in s and the power of each round.
    """
    samples: list[list[tuple[float, Figure]]] = [[] for _ in calls]
    while (
        len(samples[0]) < rounds
        or min(sum(time_s for time_s, _ in call_samples) for call_samples in samples) < least_s
    ):
        # Each call runs once a round, so that whatever else runs here meets all of them alike.
        for call, call_samples in zip(calls, samples, strict=True):
            call_samples.append(timed(call)[1:])
    return samples


def cpu_load() -> Figure:
    """Measure the load in % of all CPUs since the last call in this process.

    Other processes are included. Call this once before the work to begin the window, and ignore
    that result.
    """
    return measured(
        psutil.cpu_percent(), "%", "all CPUs over the same window, other processes included"
    )


def own_cpu_s() -> float:
    """Return the CPU time of this process so far, user and system, in s."""
    times = psutil.Process().cpu_times()
    return float(times.user + times.system)


def load_of_others(load: Figure, own_s: float, elapsed_s: float) -> float:
    """Compute the share of all CPUs that other processes used during a window of time.

    Args:
        load: the load of all CPUs in % over the window, as `cpu_load` returns it.
        own_s: the CPU time of this process over the window, in s.
        elapsed_s: the length of the window in s.

    Returns:
        The share in [0, 1], 0 if this process used all of the load.
    """
    cpus = psutil.cpu_count() or 1
    return max((load.value or 0.0) / 100 - own_s / (cpus * max(elapsed_s, 1e-9)), 0.0)


def resident_bytes() -> int:
    """Return the resident memory of this process in bytes."""
    return int(psutil.Process().memory_info().rss)
