"""What this machine did while something was measured: load of its CPUs, and the memory that it
took.
"""

import sys
from contextlib import suppress
from pathlib import Path

import psutil

from beers_deploy.profiles.figures import Figure, measured, unavailable

STATUS = Path("/proc/self/status")
"""Linux's own counts of this process."""


def cpu_load() -> Figure:
    """Load of all CPUs since the last call in this process, other processes included."""
    return measured(
        psutil.cpu_percent(), "%", "all CPUs over the same window, other processes included"
    )


def resident_bytes() -> int:
    """Resident memory of this process."""
    return int(psutil.Process().memory_info().rss)


def peak_memory() -> Figure:
    """Most resident memory of this process since it began, in GB; unavailable where the system does
    not count it.
    """
    peak = _peak_bytes()
    if peak is None:
        return unavailable("GB", "this system counts no peak memory")
    return measured(peak / 1e9, "GB", "resident memory of this process, highest since it began")


def _peak_bytes() -> int | None:
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    # On Linux, getrusage's count begins with the memory of the process's parent.
    with suppress(OSError, StopIteration):
        lines = STATUS.read_text(encoding="utf-8").splitlines()
        return 1024 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # macOS counts bytes, the others KiB.
    return peak if sys.platform == "darwin" else 1024 * peak
