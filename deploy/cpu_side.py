"""The traditional pipeline on the board's own processor: CPU time spent here, scaled by published benchmarks.

A host core beats a Cortex-A72 by

    at least  7-zip   slowest common server core / fastest A72     integers, one lane
    at most   HPL     fastest common server core / slowest A72     float64 matrices, every lane of the vector unit

The chain lies between: it searches and sorts, and multiplies small matrices. Which host ran it is not known, so both
ends are those of any common x86 server: an assumption (`profiles/targets/host-cpu.toml`, `vck190.toml`, [cpu]). CPU
time is scaled, not the clock on the wall: other programs on this machine must not slow the board down.
"""

import math

from deploy.bench import TABLE, Swath, efficiency
from deploy.results import Row, predicted, published
from profiles import TargetProfile

NAME = "traditional pipeline on the board's CPU, 2 x Cortex-A72"


def slowdown(board: TargetProfile, host: TargetProfile) -> tuple[float, float]:
    """How many times longer a core of the board's processor takes than one of a common server: lowest, highest."""
    clock, integers, floats = (
        board.constant("cpu", key) for key in ("clock_ghz", "zip_mips_per_ghz", "linpack_gflops_per_ghz")
    )
    low = host.value("cpu", "zip_mips") / (integers.high * clock.high)
    return low, host.value("cpu", "linpack_gflops") / (floats.low * clock.low)


def board_cpu_row(cpu_s: tuple[float, float], swath: Swath, board: TargetProfile, host: TargetProfile) -> Row:
    """CPU time scaled to the board's processor: shared by its cores at best, on one core at worst.

    Args:
        cpu_s: time of this host's cores together that the swath takes, lowest and highest, in s.
        swath: the image it is about.
        board: profile with a table [cpu], and the power of its CPU run.
        host: profile of a common server core.
    """
    fast, slow = slowdown(board, host)
    low, high = cpu_s[0] * fast / board.value("cpu", "cores"), cpu_s[1] * slow
    source = (
        f"CPU time here x {fast:.2g} to {slow:.2g} (7-zip and HPL of A72 and common server cores), on 1 or 2 cores"
    )
    latency = predicted(math.sqrt(low * high), "s", (low, high), source)  # the ends are ratios: their geometric mean
    rates = swath.frames / high, swath.frames / low
    power = board.constant("power", "cpu_run_w")
    figures = {
        "latency": latency,
        "throughput": predicted(math.sqrt(rates[0] * rates[1]), "frame/s", rates, source),
        "power": published(power.low, "W", power.source),
    }
    return Row(TABLE, NAME, {**figures, "efficiency": efficiency(swath.pixels, latency, figures["power"])})
