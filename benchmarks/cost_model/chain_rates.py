"""How fast this processor does each kind of work that the traditional pipeline is made of, on one core.

Short kernels of the library calls and shapes of `model.traditional`, timed in CPU time and interleaved; and three
resources, measured as published benchmarks measure them, by which the kinds are scaled to another processor.
"""

import lzma
import os
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from beers_deploy.model.traditional.nl_bayes import overlap_add, patch_matrix
from beers_deploy.model.traditional.rows import one_thread_per_operation
from benchmarks.cost_model.chain_work import FLOAT_BYTES, Work

ROUNDS = 25
CLOCK = time.perf_counter if os.name == "nt" else time.thread_time
"""Others' turns on the core do not count, but where the system counts in ticks of 16 ms."""

SEVEN_ZIP_DECODER = 1.09
"""How much faster 7-zip's decoder in C was than Python's, 1.04 to 1.12 on six texts (Zen 4, measured)."""

RESOURCES = {"products": "FLOP/s", "memory": "B/s", "integers": "instruction/s"}
"""What kinds are scaled by: products of large float32 matrices, bytes moved in order, and 7-zip's rating of LZMA
decoding, which is branches and dependent loads."""


@dataclass(frozen=True)
class Rates:
    """Of one core of this processor.

    Attributes:
        kinds: amount a second of each kind of `chain_work`.
        resources: rate of each of RESOURCES.
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
    kinds, resources = _kinds(generator), {"products": _large_product(generator), "integers": _decoding()}
    with one_thread_per_operation():
        rates = _rates({**kinds, **resources})
    found = {name: rates[name] for name in resources} | {"memory": rates["passes"]}
    return Rates({kind: rates[kind] for kind in kinds}, found)


def _rates(kernels: Mapping[str, Kernel]) -> dict[str, float]:
    """Amount a second of each, from the median of ROUNDS turns.

    Each is called once a turn: it finds the caches full of the others' arrays, as it does in the chain.
    """
    taken_s: dict[str, list[float]] = {name: [] for name in kernels}
    for _ in range(ROUNDS + 1):
        for name, kernel in kernels.items():
            start_s = CLOCK()
            kernel.call()
            taken_s[name].append(CLOCK() - start_s)
    return {name: kernel.amount / statistics.median(taken_s[name][1:]) for name, kernel in kernels.items()}


REFERENCES, COVERED_PX, WINDOW_PX, MEMBERS, SIDE_PX = 24, 74, 23, 45, 5
"""Of a tile of the first pass at standard quality; its groups are REFERENCES^2."""
GROUPS, PIXELS = REFERENCES**2, SIDE_PX**2
TRANSFORM_PX, PRODUCT_PX, CALLS = 512, 512, 400


def _kinds(generator: torch.Generator) -> dict[str, Kernel]:
    """One kernel for each kind of work."""
    return {
        "box sums": _box_sums(generator),
        "group products": _group_products(generator),
        "factorisations": _factorisations(generator),
        "selection": _selection(generator),
        "transforms": _transforms(generator),
        "passes": _passes(generator),
        "strided": _strided(generator),
        "gathers": _gathers(generator),
        "calls": _calls(),
    }


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
    return Kernel(lambda: torch.cholesky_inverse(torch.linalg.cholesky_ex(matrices)[0]), GROUPS * PIXELS**3)


def _selection(generator: torch.Generator) -> Kernel:
    distances = torch.rand(GROUPS, WINDOW_PX**2, generator=generator).numpy()
    ends = [MEMBERS - 1, MEMBERS - 1]  # as the chain asks: numpy has a faster way for one place alone
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


def _calls() -> Kernel:
    few = torch.zeros(8)

    def call() -> None:
        for _ in range(CALLS):
            few[1:].add_(1.0)

    return Kernel(call, 2 * CALLS)


def _large_product(generator: torch.Generator) -> Kernel:
    factor = torch.rand(PRODUCT_PX, PRODUCT_PX, generator=generator)
    return Kernel(lambda: factor @ factor, 2 * PRODUCT_PX**3)


TEXT_BYTES, FARTHEST_BITS = 1 << 17, 17


def _decoding() -> Kernel:
    """7-zip counts 200 instructions for each packed byte that it decodes, and 4 for each that comes out (16.02)."""
    text = _compressible(np.random.default_rng(0))
    packed = lzma.compress(text, format=lzma.FORMAT_ALONE)
    return Kernel(lambda: lzma.decompress(packed), SEVEN_ZIP_DECODER * (200 * len(packed) + 4 * len(text)))


def _compressible(generator: np.random.Generator) -> bytes:
    """Fresh bytes and copies of earlier ones by turns, packed to a quarter; 7-zip's own test data to a third."""
    text = bytearray(generator.bytes(1024))
    while len(text) < TEXT_BYTES:
        text += generator.bytes(int(generator.integers(0, 5)))
        size = int(generator.integers(2, 30))
        back = size + int(min(len(text) - size, 2 ** generator.uniform(0, FARTHEST_BITS)))
        text += text[len(text) - back :][:size]
    return bytes(text)
