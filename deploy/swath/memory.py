"""The most memory this process ever held."""

import sys

from deploy.results import Figure, measured, unavailable


def peak_memory() -> Figure:
    """Peak resident memory in GB; unavailable where the system keeps no such count."""
    try:
        import resource
    except ImportError:
        return unavailable("GB", "this system counts no peak memory")
    unit_bytes = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit_bytes
    return measured(peak / 1e9, "GB", "resident memory of this process, highest since it began")
