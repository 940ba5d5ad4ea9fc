"""What sets the rate of a network: intervals are as wide as the errors of networks with the same answer."""

from typing import Literal, get_args

Regime = Literal["host", "small maps", "large maps"]
"""The host; or the DPU, on maps of at most LARGE_MAP_BYTES, or with larger ones."""
REGIMES: tuple[Regime, ...] = get_args(Regime)

LARGE_MAP_BYTES = 2 << 20


def regime_of(host_bound: bool, map_bytes: float) -> Regime:
    """The regime of a network, from its largest result."""
    if host_bound:
        return "host"
    return "large maps" if map_bytes > LARGE_MAP_BYTES else "small maps"
