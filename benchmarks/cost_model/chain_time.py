"""Time of the traditional pipeline on each board's own processor: `python -m
benchmarks.cost_model.chain_time`.

Prints `chain_s_per_mpx` for the [cpu] of every board. CPU time of one core here is split by kind of
work (`chain_work` counts it, `measured_rates` tells how fast this processor does each). A kind is
slower there by the ratio of what bounds it: products of matrices, bytes moved or plain
instructions, as measured here and as published for the board's cores. Where either of two may bound
it, the interval holds both. What the kinds do not explain may be of any kind. Short kernels of the
library calls and shapes of `model.traditional`, timed in CPU time and interleaved, tell how fast
this processor is; resources are measured as published benchmarks measure them.
"""

import lzma
import math
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from beers_deploy.model.shipped import SENSOR
from beers_deploy.model.traditional.nl_bayes import overlap_add, patch_matrix
from beers_deploy.model.traditional.pipeline import Chain, quality_named, restore_traditional
from beers_deploy.model.traditional.rows import one_thread_per_operation
from beers_deploy.performance.swath import Swath
from beers_deploy.performance.traditional import CROP_PX, CROPS, drawn_acquisition
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import REFERENCE, board_names
from beers_deploy.profiles.target import TargetProfile
from benchmarks.cost_model.chain_work import FLOAT_BYTES, Work, chain_work

ROUNDS = 25
CLOCK = time.perf_counter if os.name == "nt" else time.thread_time
"""Others' turns on the core do not count, but where the system counts in ticks of 16 ms."""

SEVEN_ZIP_DECODER = 1.09
"""How much faster 7-zip's decoder in C was than Python's, 1.04 to 1.12 on six texts (Zen 4,
measured).
"""


@dataclass(frozen=True)
class Rates:
    """Of one core of this processor.

    Attributes:
        kinds: amount a second of each kind of `chain_work`.
        resources: what kinds are scaled by, a second: floating-point operations of large float32
            "products", bytes moved in order in "memory", and "integers" by 7-zip's rating of LZMA
            decoding: branches, dependent loads.
    """

    kinds: Mapping[str, float]
    resources: Mapping[str, float]

    def times_s(self, work: Work) -> dict[str, float]:
        """Time of each kind of some work, on one core."""
        return {kind: amount / self.kinds[kind] for kind, amount in work.items()}


@dataclass(frozen=True)
class Kernel:
    """A call, and the amount of work that it does."""

    call: Callable[[], object]
    amount: float


def measured_rates() -> Rates:
    """Rates of this processor; takes about a second."""
    generator = torch.Generator().manual_seed(0)
    with one_thread_per_operation():
        rates = _rates({name: make(generator) for name, make in KERNELS.items()})
    resources = {name: rates.pop(name) for name in ("products", "integers")}
    return Rates(rates, {**resources, "memory": rates["passes"]})


def _rates(kernels: Mapping[str, Kernel]) -> dict[str, float]:
    """Amount a second of each, from the median of ROUNDS turns.

    Each is called once a turn: it finds the caches full of the others' arrays, as it does in the
    chain.
    """
    taken_s: dict[str, list[float]] = {name: [] for name in kernels}
    for _ in range(ROUNDS + 1):
        # Each kernel is called once a turn, so that it finds the caches full of the other kernels'
        # arrays, as in the chain.
        for name, kernel in kernels.items():
            start_s = CLOCK()
            kernel.call()
            taken_s[name].append(CLOCK() - start_s)
    return {
        name: kernel.amount / statistics.median(taken_s[name][1:])
        for name, kernel in kernels.items()
    }


REFERENCES = 24
COVERED_PX = 74
WINDOW_PX = 23
MEMBERS = 45
SIDE_PX = 5
"""Of a tile of the first pass at standard quality; its groups are REFERENCES^2."""
GROUPS = REFERENCES**2
PIXELS = SIDE_PX**2
TRANSFORM_PX = 512
PRODUCT_PX = 512
CALLS = 400


def _box_sums(generator: torch.Generator) -> Kernel:
    rows = torch.rand(REFERENCES, COVERED_PX, generator=generator)
    squares = torch.rand(WINDOW_PX, COVERED_PX, WINDOW_PX * COVERED_PX, generator=generator)
    sums = REFERENCES * WINDOW_PX * COVERED_PX * (COVERED_PX + REFERENCES)

    def call() -> None:
        for of_a_row in squares:
            _ = (rows @ of_a_row).reshape(-1, COVERED_PX) @ rows.T

    return Kernel(call, 2 * WINDOW_PX * sums)


def _group_products(generator: torch.Generator) -> Kernel:
    patches = torch.rand(GROUPS, MEMBERS, PIXELS, generator=generator)
    matrix = torch.rand(GROUPS, PIXELS, PIXELS, generator=generator)

    def call() -> None:
        _ = patches.mT @ patches
        torch.baddbmm(patches, patches, matrix, alpha=-1)

    return Kernel(call, 2 * 2 * GROUPS * MEMBERS * PIXELS**2)


def _factorisations(generator: torch.Generator) -> Kernel:
    patches = torch.rand(GROUPS, MEMBERS, PIXELS, generator=generator)
    matrices = patches.mT @ patches + torch.eye(PIXELS)
    return Kernel(
        lambda: torch.cholesky_inverse(torch.linalg.cholesky_ex(matrices)[0]), GROUPS * PIXELS**3
    )


def _selection(generator: torch.Generator) -> Kernel:
    distances = torch.rand(GROUPS, WINDOW_PX**2, generator=generator).numpy()
    # The place is listed twice, as the chain does: numpy has a faster way for a single place.
    ends = [MEMBERS - 1, MEMBERS - 1]
    return Kernel(lambda: np.argpartition(distances, ends, axis=1), distances.size)


def _transforms(generator: torch.Generator) -> Kernel:
    image = torch.rand(TRANSFORM_PX, TRANSFORM_PX, generator=generator)
    operations = 2.5 * image.numel() * np.log2(image.numel())
    return Kernel(lambda: torch.fft.irfft2(torch.fft.rfft2(image), s=image.shape), 2 * operations)


def _passes(generator: torch.Generator) -> Kernel:
    guide = torch.rand(COVERED_PX + WINDOW_PX - 1, COVERED_PX + WINDOW_PX - 1, generator=generator)

    def call() -> None:
        for top in range(WINDOW_PX):
            rows = guide[top : top + COVERED_PX]
            (rows.unfold(1, COVERED_PX, 1) - rows[:, None, :COVERED_PX]).square_()

    return Kernel(call, 5 * FLOAT_BYTES * WINDOW_PX**2 * COVERED_PX**2)


def _strided(generator: torch.Generator) -> Kernel:
    image = torch.rand(COVERED_PX + WINDOW_PX, COVERED_PX + WINDOW_PX, generator=generator)
    patches = patch_matrix(image, SIDE_PX)

    def call() -> None:
        overlap_add(patch_matrix(image, SIDE_PX), image.shape, SIDE_PX)

    return Kernel(call, 5 * FLOAT_BYTES * patches.numel())


def _gathers(generator: torch.Generator) -> Kernel:
    side = COVERED_PX + WINDOW_PX - SIDE_PX
    patches = torch.rand(side**2, PIXELS, generator=generator)
    steps = torch.randint(WINDOW_PX, (2, GROUPS, MEMBERS), generator=generator)
    places = torch.arange(REFERENCES) * (COVERED_PX // REFERENCES)
    first = (places[:, None] * side + places).reshape(-1, 1)
    numbers = (first + steps[0] * side + steps[1]).reshape(-1)
    total = torch.zeros_like(patches)

    def call() -> None:
        total.index_add_(0, numbers, patches.index_select(0, numbers))

    return Kernel(call, 5 * FLOAT_BYTES * numbers.numel() * PIXELS)


def _calls(_: torch.Generator) -> Kernel:
    few = torch.zeros(8)

    def call() -> None:
        for _ in range(CALLS):
            few[1:].add_(1.0)

    return Kernel(call, 2 * CALLS)


def _large_product(generator: torch.Generator) -> Kernel:
    factor = torch.rand(PRODUCT_PX, PRODUCT_PX, generator=generator)
    return Kernel(lambda: factor @ factor, 2 * PRODUCT_PX**3)


TEXT_BYTES = 1 << 17
FARTHEST_BITS = 17


def _decoding(_: torch.Generator) -> Kernel:
    """7-zip counts 200 instructions for each packed byte that it decodes, and 4 for each that comes
    out (16.02).
    """
    text = _compressible(np.random.default_rng(0))
    packed = lzma.compress(text, format=lzma.FORMAT_ALONE)
    return Kernel(
        lambda: lzma.decompress(packed), SEVEN_ZIP_DECODER * (200 * len(packed) + 4 * len(text))
    )


def _compressible(generator: np.random.Generator) -> bytes:
    """Fresh bytes and copies of earlier ones by turns, packed to a quarter; 7-zip's own test data
    to a third.
    """
    text = bytearray(generator.bytes(1024))
    while len(text) < TEXT_BYTES:
        text += generator.bytes(int(generator.integers(0, 5)))
        size = int(generator.integers(2, 30))
        back = size + int(min(len(text) - size, 2 ** generator.uniform(0, FARTHEST_BITS)))
        text += text[len(text) - back :][:size]
    return bytes(text)


KERNELS: Mapping[str, Callable[[torch.Generator], Kernel]] = {
    "box sums": _box_sums,
    "group products": _group_products,
    "factorisations": _factorisations,
    "selection": _selection,
    "transforms": _transforms,
    "passes": _passes,
    "strided": _strided,
    "gathers": _gathers,
    "calls": _calls,
    "products": _large_product,
    "integers": _decoding,
}
"""One for each kind of work, and one for each resource that is none."""


WIDTH_PX = 13600
HEIGHT_PX = 9016
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
"""What bounds each kind.

Matrices of 25 x 25 are too small to be products alone: held to vectors a quarter as wide, this
processor factorised them as fast (measured). Patches lie in pieces of five numbers, and calls miss
caches.
"""

SERIAL = (0.02, 0.04)
"""Share of the pipeline's CPU time outside its pool of tiles, which one core spends while the
others wait: 2.1 and 3.5 % of images of 256 x 768 and 256 x 256 (measured).
"""

Interval = tuple[float, float]


def main() -> None:
    """A line for each board: the median of RUNS, each with rates and times of its own."""
    here = [measured_here() for _ in range(RUNS)]
    for board in map(TargetProfile.load, board_names()):
        ends = np.median([s_per_mpx(*run, board) for run in here], axis=0)
        low, high = (float(f"{end:.2g}") for end in ends)
        print(f"{board.name}: chain_s_per_mpx = [{low:g}, {high:g}]")


def measured_here() -> tuple[float, Mapping[str, float], Rates]:
    """CPU time of one core here for 10^6 pixels, in s; the share of it that each kind explains; the
    rates.
    """
    sensors = Sensor.load(SENSOR), Sensor.load(REFERENCE)
    scene = drawn_acquisition(Swath(CROPS * CROP_PX, CROP_PX), *sensors)
    crops = [scene[:, k * CROP_PX : (k + 1) * CROP_PX] for k in range(CROPS)]
    chain = Chain(sensors[0].nominal(), sensors[1].nominal())
    with one_thread_per_operation():
        cpu_s = statistics.median(_cpu_s(crop, chain) for crop in crops)
    rates = measured_rates()
    quality = quality_named(QUALITY)
    explained = math.fsum(rates.times_s(chain_work(CROP_PX, CROP_PX, quality)).values()) / cpu_s
    times_s = rates.times_s(chain_work(HEIGHT_PX, WIDTH_PX, quality))
    scale = min(explained, 1.0) / math.fsum(times_s.values())
    return (
        1e6 * cpu_s / CROP_PX**2,
        {kind: scale * time_s for kind, time_s in times_s.items()},
        rates,
    )


def _cpu_s(dn: np.ndarray, chain: Chain) -> float:
    start_s = time.process_time()
    restore_traditional(torch.from_numpy(np.ascontiguousarray(dn)), chain)
    return time.process_time() - start_s


def s_per_mpx(
    cpu_s: float, shares: Mapping[str, float], rates: Rates, board: TargetProfile
) -> Interval:
    """Time of 10^6 pixels on all the board's cores, least and most: one core's shared by Amdahl's
    law.
    """
    by_kind = slowdowns(board, rates)
    cores = board.value("cpu", "cores")
    unknown = _hull(list(by_kind.values()))
    rest = 1 - math.fsum(shares.values())
    low, high = (
        cpu_s
        * (
            math.fsum(share * by_kind[kind][end] for kind, share in shares.items())
            + rest * unknown[end]
        )
        * (SERIAL[end] + (1 - SERIAL[end]) / cores)
        for end in (0, 1)
    )
    return low, high


def slowdowns(board: TargetProfile, rates: Rates) -> dict[str, Interval]:
    """How many times longer a core of the board takes for each kind of work: lowest, highest."""
    clock, products, bytes_per_s, integers = (
        board.constant("cpu", key)
        for key in (
            "clock_ghz",
            "product_flops_per_cycle",
            "moved_bytes_per_s",
            "decoding_mips_per_ghz",
        )
    )
    there = {
        "products": (1e9 * clock.low * products.low, 1e9 * clock.high * products.high),
        "memory": (bytes_per_s.low, bytes_per_s.high),
        "integers": (1e6 * clock.low * integers.low, 1e6 * clock.high * integers.high),
    }
    here = rates.resources
    slower = {name: (here[name] / high, here[name] / low) for name, (low, high) in there.items()}
    return {kind: _hull([slower[name] for name in names]) for kind, names in BOUND_BY.items()}


def _hull(intervals: Sequence[Interval]) -> Interval:
    return min(low for low, _ in intervals), max(high for _, high in intervals)


if __name__ == "__main__":
    main()
