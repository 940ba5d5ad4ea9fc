"""The traditional pipeline on a board's own processor: its work by kind, each scaled by what bounds it.

CPU time of one core here is split by kind of work (`model.traditional.work` counts, `rates` measures). A kind is
slower there by the ratio of what bounds it: products of matrices, bytes moved or plain instructions, as measured here
and as published for the board's cores. Where either of two may bound it, the interval holds both.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from deploy.bench.rates import Rates
from deploy.bench.tables import TABLE, Swath, efficiency, exact
from model.traditional.work import UNITS, Work
from profiles import TargetProfile
from profiles.figures import Figure, Row, measured, predicted, published, unavailable

KINDS_TABLE = "chain by kind"

BOUND_BY = {
    "box sums": ("products",),
    "group products": ("products",),
    "factorisations": ("products", "integers"),
    "selection": ("integers",),
    "transforms": ("products",),
    "passes": ("memory",),
    "strided": ("memory", "integers"),
    "gathers": ("memory", "integers"),
    "calls": ("memory", "integers"),
}
"""What bounds each kind. Matrices of 25 x 25 are too small to be products alone: held to vectors a quarter as wide,
this processor factorised them as fast (measured). Patches lie in pieces of five numbers, and calls miss caches."""

CHAIN_SERIAL = (0.02, 0.04)
"""Share of the chain's CPU time outside its pool of tiles, which one core spends while the others wait: 2.1 and 3.5 %
of images of 256 x 768 and 256 x 256 (measured)."""

Interval = tuple[float, float]


@dataclass(frozen=True)
class CpuTime:
    """What a method takes on one core of this processor for a swath.

    Attributes:
        cpu_s: CPU time, least and most, in s.
        shares: of it by kind of work; what is left to 1 may be of any kind.
        serial: share that only one core can do, least and most.
    """

    cpu_s: Interval
    shares: Mapping[str, float]
    serial: Interval = (0.0, 1.0)


def chain_time(cpu_s: Interval, work: Work, rates: Rates, explained: float) -> CpuTime:
    """That of the chain: shares as its work takes at the rates measured here.

    Args:
        cpu_s: CPU time of the swath, least and most, in s.
        work: of the swath.
        rates: of this processor.
        explained: counted time over measured time of the parts that were timed; below 1 the rest has no known kind.
    """
    times_s = rates.times_s(work)
    scale = min(explained, 1.0) / math.fsum(times_s.values())
    return CpuTime(cpu_s, {kind: time_s * scale for kind, time_s in times_s.items()}, CHAIN_SERIAL)


def slowdowns(board: TargetProfile, rates: Rates) -> dict[str, Interval]:
    """How many times longer a core of the board takes for what each resource bounds: lowest, highest.

    Raises:
        ProfileError: the target states no processor.
    """
    clock, products, moved, integers = (
        board.constant("cpu", key)
        for key in ("clock_ghz", "product_flops_per_cycle", "moved_bytes_per_s", "decoding_mips_per_ghz")
    )
    there = {
        "products": (1e9 * clock.low * products.low, 1e9 * clock.high * products.high),
        "memory": (moved.low, moved.high),
        "integers": (1e6 * clock.low * integers.low, 1e6 * clock.high * integers.high),
    }
    return {name: (rates.resources[name] / high, rates.resources[name] / low) for name, (low, high) in there.items()}


def kind_slowdowns(board: TargetProfile, rates: Rates) -> dict[str, Interval]:
    """The same for each kind: the hull of the resources that may bound it."""
    found = slowdowns(board, rates)
    return {kind: _hull([found[name] for name in names]) for kind, names in BOUND_BY.items()}


def board_latency_s(time: CpuTime, board: TargetProfile, rates: Rates) -> Interval:
    """Time of the swath on all the board's cores, lowest and highest, in s.

    One core's time shared by Amdahl's law; the published rates are those of cores that are all busy.
    """
    by_kind, cores = kind_slowdowns(board, rates), board.value("cpu", "cores")
    unknown, rest = _hull(list(by_kind.values())), 1 - math.fsum(time.shares.values())
    ends = []
    for end in (0, 1):
        slower = math.fsum(share * by_kind[kind][end] for kind, share in time.shares.items()) + rest * unknown[end]
        ends.append(time.cpu_s[end] * slower * (time.serial[end] + (1 - time.serial[end]) / cores))
    return ends[0], ends[1]


def _hull(intervals: list[Interval]) -> Interval:
    return min(low for low, _ in intervals), max(high for _, high in intervals)


def board_cpu_row(time: CpuTime, swath: Swath, board: TargetProfile, rates: Rates) -> Row:
    """The swath on the board's processor, predicted.

    Raises:
        ProfileError: the target states no processor.
    """
    low, high = board_latency_s(time, board, rates)
    source = (
        "CPU time of one core here, each kind of its work scaled by rates measured here and published for the board"
    )
    latency = predicted(math.sqrt(low * high), "s", (low, high), source)  # the ends are ratios: their geometric mean
    fps = swath.frames / high, swath.frames / low
    power = _power(board)
    figures = {
        "latency": latency,
        "throughput": predicted(math.sqrt(fps[0] * fps[1]), "frame/s", fps, source),
        "power": power,
        "efficiency": efficiency(swath.pixels, latency, power),
    }
    cores = board.value("cpu", "cores")
    return Row(TABLE, f"traditional pipeline on the processor of {board.name}, {cores:g} cores", figures)


def _power(board: TargetProfile) -> Figure:
    """Of the board while its processor runs, where it is published."""
    constant = board.tables.get("power", {}).get("cpu_run_w")
    if constant is None:
        return unavailable("W", "no power of a run on this board's processor is published")
    return published(constant.low, "W", constant.source)


def kind_rows(time: CpuTime, work: Work, board: TargetProfile, rates: Rates) -> list[Row]:
    """One row a kind: its work, its rate and share of the time here, and how much slower a core of the board is."""
    by_kind = kind_slowdowns(board, rates)
    return [
        Row(
            KINDS_TABLE,
            f"{kind}, {unit}",
            _kind_figures(work[kind], rates.kinds[kind], time.shares[kind], by_kind[kind]),
            {"bound": " or ".join(BOUND_BY[kind])},
        )
        for kind, unit in UNITS.items()
    ]


def _kind_figures(amount: float, rate: float, share: float, slower: Interval) -> dict[str, Figure]:
    counted = "counted from the size and the settings"
    scaled = "rates measured here over those published for the board's cores"
    return {
        "work": exact(amount / 1e9, "10^9", counted),
        "rate": measured(rate / 1e9, "10^9/s", "one core here, median of interleaved kernels"),
        "share": exact(100 * share, "%", f"work {counted}, over the rate"),
        "slower there": predicted(math.sqrt(slower[0] * slower[1]), "x", slower, scaled),
    }
