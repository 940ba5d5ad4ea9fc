"""Time of the traditional pipeline on each board's own processor: `python -m benchmarks.cost_model.chain_time`.

Prints `chain_s_per_mpx` for the [cpu] of every board. CPU time of one core here is split by kind of work
(`chain_work` counts it, `chain_rates` measures how fast this processor does each). A kind is slower there by the
ratio of what bounds it: products of matrices, bytes moved or plain instructions, as measured here and as published
for the board's cores. Where either of two may bound it, the interval holds both. What the kinds do not explain may be
of any kind.
"""

import math
import statistics
import time
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from beers_deploy.bench.tables import Swath
from beers_deploy.bench.traditional import CROP_PX, CROPS, drawn_acquisition
from beers_deploy.model.shipped import SENSOR
from beers_deploy.model.traditional.pipeline import Chain, quality_named, restore_traditional
from beers_deploy.model.traditional.rows import one_thread_per_operation
from beers_deploy.profiles import TargetProfile, load_sensor, load_target
from beers_deploy.profiles.sensor_file import REFERENCE
from beers_deploy.profiles.target import board_names
from benchmarks.cost_model.chain_rates import Rates, measured_rates
from benchmarks.cost_model.chain_work import chain_work

WIDTH_PX, HEIGHT_PX = 13600, 9016
QUALITY = "standard"
"""What the pipeline takes when nothing is said."""
RUNS = 5

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

SERIAL = (0.02, 0.04)
"""Share of the pipeline's CPU time outside its pool of tiles, which one core spends while the others wait: 2.1 and
3.5 % of images of 256 x 768 and 256 x 256 (measured)."""

Interval = tuple[float, float]


def main() -> None:
    """A line for each board: the median of RUNS, each with rates and times of its own."""
    here = [measured_here() for _ in range(RUNS)]
    for board in map(load_target, board_names()):
        ends = np.median([s_per_mpx(*run, board) for run in here], axis=0)
        low, high = (float(f"{end:.2g}") for end in ends)
        print(f"{board.name}: chain_s_per_mpx = [{low:g}, {high:g}]")


def measured_here() -> tuple[float, Mapping[str, float], Rates]:
    """CPU time of one core here for 10^6 pixels, in s; the share of it that each kind explains; the rates."""
    sensors = load_sensor(SENSOR), load_sensor(REFERENCE)
    scene = drawn_acquisition(Swath(CROPS * CROP_PX, CROP_PX), *sensors)
    crops = [scene[:, k * CROP_PX : (k + 1) * CROP_PX] for k in range(CROPS)]
    chain = Chain(sensors[0].nominal(), sensors[1].nominal())
    with one_thread_per_operation():
        cpu_s = statistics.median(_cpu_s(crop, chain) for crop in crops)
    rates, quality = measured_rates(), quality_named(QUALITY)
    explained = math.fsum(rates.times_s(chain_work(CROP_PX, CROP_PX, quality)).values()) / cpu_s
    times_s = rates.times_s(chain_work(HEIGHT_PX, WIDTH_PX, quality))
    scale = min(explained, 1.0) / math.fsum(times_s.values())
    return 1e6 * cpu_s / CROP_PX**2, {kind: scale * time_s for kind, time_s in times_s.items()}, rates


def _cpu_s(dn: np.ndarray, chain: Chain) -> float:
    start_s = time.process_time()
    restore_traditional(torch.from_numpy(np.ascontiguousarray(dn)), chain)
    return time.process_time() - start_s


def s_per_mpx(cpu_s: float, shares: Mapping[str, float], rates: Rates, board: TargetProfile) -> Interval:
    """Time of 10^6 pixels on all the board's cores, least and most: one core's shared by Amdahl's law."""
    by_kind, cores = slowdowns(board, rates), board.value("cpu", "cores")
    unknown, rest = _hull(list(by_kind.values())), 1 - math.fsum(shares.values())
    low, high = (
        cpu_s
        * (math.fsum(share * by_kind[kind][end] for kind, share in shares.items()) + rest * unknown[end])
        * (SERIAL[end] + (1 - SERIAL[end]) / cores)
        for end in (0, 1)
    )
    return low, high


def slowdowns(board: TargetProfile, rates: Rates) -> dict[str, Interval]:
    """How many times longer a core of the board takes for each kind of work: lowest, highest."""
    clock, products, moved, integers = (
        board.constant("cpu", key)
        for key in ("clock_ghz", "product_flops_per_cycle", "moved_bytes_per_s", "decoding_mips_per_ghz")
    )
    there = {
        "products": (1e9 * clock.low * products.low, 1e9 * clock.high * products.high),
        "memory": (moved.low, moved.high),
        "integers": (1e6 * clock.low * integers.low, 1e6 * clock.high * integers.high),
    }
    here = rates.resources
    slower = {name: (here[name] / high, here[name] / low) for name, (low, high) in there.items()}
    return {kind: _hull([slower[name] for name in names]) for kind, names in BOUND_BY.items()}


def _hull(intervals: Sequence[Interval]) -> Interval:
    return min(low for low, _ in intervals), max(high for _, high in intervals)


if __name__ == "__main__":
    main()
