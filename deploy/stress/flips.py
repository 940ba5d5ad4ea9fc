"""Bit flips: injected into weights, shifts, feature maps or the image, one at a time and many.

Where a flip hurts, by layer and by the bit's weight; PSNR against flips in a megabit, with and without guards.
"""

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from model.io.images import MAX_DN
from model.metrics.fidelity import psnr_db
from profiles.figures import Figure, Row, measured
from quant.core import IntConv, IntCore
from quant.faults import (
    INT8_BITS,
    PIXEL_BITS,
    SHIFT_BITS,
    Guards,
    bits_apart,
    checksums,
    flip_bits,
    flip_conv,
    flip_count,
    flip_shifts,
    flip_weights,
    guarded,
    map_channels,
    scrubbed,
    shifts_of,
    voted,
    weight_bits,
    with_ops,
)
from quant.graph import Op
from quant.integer import SOUND, Faults, merged_correction, run_core

Pair = tuple[np.ndarray, np.ndarray]
"""Degraded and reference, (1, 1, H, W) in [0, 1] each."""
Shifts = dict[tuple[str, str], int]


@dataclass(frozen=True)
class FaultTarget:
    """What faults are injected into.

    Attributes:
        core: the network as the board stores it.
        guards: learnt from calibration patches.
        pairs: the patches that it restores, degraded and reference.
    """

    core: IntCore
    guards: Guards
    pairs: Sequence[Pair]

    @cached_property
    def shifts(self) -> Shifts:
        """The shifts of every operation, free of faults."""
        return shifts_of(self.core)

    def fault_free(self, number: int) -> "Injected":
        """Pair `number` and the network without any fault."""
        return Injected(self.core, SOUND, self.pairs[number][0], 0)


@dataclass(frozen=True)
class Injected:
    """A network and an image after an injection.

    Attributes:
        core: with the weights as they are now.
        faults: what else is wrong.
        image: (1, 1, H, W), as it is now.
        flips: how many bits were flipped.
    """

    core: IntCore
    faults: Faults
    image: np.ndarray
    flips: int


def restored(target: FaultTarget, injected: Injected, clamped: bool = False) -> np.ndarray:
    """The restored image (1, 1, H, W) in [0, 1]; `clamped` turns the ReLU6 and the limit of the correction on."""
    faults = guarded(injected.faults, target.guards) if clamped else injected.faults
    tensors, _ = run_core(injected.core, injected.core.ends.split(injected.image), faults=faults)
    correction = merged_correction(injected.core, tensors)
    correction = target.guards.limit(correction) if clamped else correction
    return np.asarray(injected.core.ends.finished(injected.image, correction), np.float32)


def quality_db(target: FaultTarget, injected: Injected, reference: np.ndarray, clamped: bool = False) -> float:
    """PSNR in dB of the restored image against the reference (1, 1, H, W), on [0, 1]."""
    return psnr_db(restored(target, injected, clamped), reference, 1.0)


def correct_faults(
    target: FaultTarget, injected: Injected, per_megabit: float, generator: np.random.Generator
) -> Injected:
    """The network as scrubbing and triple modular redundancy leave it before the next image.

    The other two copies of the shifts suffer flips at the same rate, each on its own.
    """
    core = scrubbed(injected.core, target.core, target.guards.checksums)
    # The copy that the injection hit is the first of the three.
    first = {**target.shifts, **injected.faults.shifts}
    second, third = (_flip_copy(target, per_megabit, generator) for _ in range(2))
    shifts = voted((first, second, third)) if injected.faults.shifts else {}
    return replace(injected, core=core, faults=replace(injected.faults, shifts=shifts))


def is_corrected(target: FaultTarget, injected: Injected) -> bool:
    """Whether no fault is left in weights and shifts."""
    meant = {**target.shifts, **injected.faults.shifts} == target.shifts
    return meant and checksums(injected.core) == target.guards.checksums


def _weights(target: FaultTarget, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Injected:
    flips = flip_count(weight_bits(target.core), per_megabit, generator)
    return Injected(flip_weights(target.core, flips, generator), SOUND, image, flips)


def _shifts(target: FaultTarget, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Injected:
    wrong = _flip_copy(target, per_megabit, generator)
    return Injected(target.core, Faults(wrong), image, bits_apart(wrong, target.shifts))


def _maps(target: FaultTarget, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Injected:
    """Faults enter every tensor once, between the operation that writes it and those that read it."""
    places, channels = image[0, 0].size // target.core.ends.place_px**2, map_channels(target.core)
    counts = {name: flip_count(INT8_BITS * places * n, per_megabit, generator) for name, n in channels.items()}
    return inject_maps(target, image, counts, int(generator.integers(2**63)))


def inject_maps(
    target: FaultTarget, image: np.ndarray, counts: dict[str, int], seed: int, bit: int | None = None
) -> Injected:
    """The network with `counts` bits flipped in each tensor, by name; the same ones whenever it runs.

    Args:
        target: the network.
        image: (1, 1, H, W) in [0, 1], left as it is.
        counts: bits to flip in each tensor.
        seed: of the draw.
        bit: flip only this one of each number, 0 being the least.
    """
    seeds = {name: [seed, number] for number, name in enumerate(counts)}

    def touch(name: str, tensor: np.ndarray) -> np.ndarray:
        if not counts.get(name):
            return tensor
        return flip_bits(tensor, counts[name], np.random.default_rng(seeds[name]), INT8_BITS, bit)

    return Injected(target.core, Faults({}, touch), image, sum(counts.values()))


def _image(target: FaultTarget, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Injected:
    flips = flip_count(PIXEL_BITS * image.size, per_megabit, generator)
    dn = flip_bits(np.rint(image * MAX_DN).astype(np.uint16), flips, generator, PIXEL_BITS)
    return Injected(target.core, SOUND, (dn / np.float32(MAX_DN)).astype(np.float32), flips)


def _flip_copy(target: FaultTarget, per_megabit: float, generator: np.random.Generator) -> Shifts:
    flips = flip_count(SHIFT_BITS * len(target.shifts), per_megabit, generator)
    return flip_shifts(target.shifts, flips, generator)


Inject = Callable[[FaultTarget, np.ndarray, float, np.random.Generator], Injected]
MEMORIES: dict[str, Inject] = {"weights": _weights, "shifts": _shifts, "maps": _maps, "image": _image}


SOURCE = "integer reference, one flip at a time: a number drawn for each bit"
PLACES = ("weights", "map", "shifts")


@dataclass(frozen=True)
class Flip:
    """One flip: where it fell, and what it did to the restored image, in DN, root mean square."""

    layer: str
    memory: str
    bit: int
    rms_dn: float


def place_rows(target: FaultTarget, seed: int, side_px: int, tick: Callable[[], None] = lambda: None) -> list[Row]:
    """A row for each layer and one for each bit: how far a single flip there moves the image, in DN rms."""
    flips = list(single_flips(target, seed, side_px, tick))
    layers = [
        _place_row("bit flips by layer", op.name, [f for f in flips if f.layer == op.name]) for op in target.core.ops
    ]
    bits = [_place_row("bit flips by bit", _bit_name(k), [f for f in flips if f.bit == k]) for k in range(INT8_BITS)]
    return [*layers, *bits]


def single_flips(
    target: FaultTarget, seed: int, side_px: int, tick: Callable[[], None] = lambda: None
) -> Iterator[Flip]:
    """For every bit a flip of one number in each layer's weights and result, and of each shift; on a crop."""
    for number, op in enumerate(target.core.ops):
        generator = np.random.default_rng([seed, number])
        image = target.pairs[number % len(target.pairs)][0][:, :, :side_px, :side_px]
        fault_free = restored(target, Injected(target.core, SOUND, image, 0))
        for memory, bit, injected in _injections(target, op, image, generator):
            error_dn = MAX_DN * (restored(target, injected).astype(np.float64) - fault_free)
            yield Flip(op.name, memory, bit, float(np.sqrt(np.mean(error_dn**2))))
        tick()


def _injections(
    target: FaultTarget, op: IntConv | Op, image: np.ndarray, generator: np.random.Generator
) -> Iterator[tuple[str, int, Injected]]:
    fault_free = Injected(target.core, SOUND, image, 1)
    for bit in range(INT8_BITS):
        if isinstance(op, IntConv):
            flipped = flip_conv(op, 1, generator, bit)
            yield "weights", bit, replace(fault_free, core=with_ops(target.core, {op.name: flipped}))
        yield "map", bit, inject_maps(target, image, {op.output: 1}, int(generator.integers(2**63)), bit)
    for key in [key for key in target.shifts if key[0] == op.name]:
        for bit in range(SHIFT_BITS):
            wrong = _signed(target.shifts[key] ^ (1 << bit))
            yield "shifts", bit, replace(fault_free, faults=Faults({key: wrong}))


def _signed(raw: int) -> int:
    """Six bits as two's complement."""
    low = raw & ((1 << SHIFT_BITS) - 1)
    return low - (1 << SHIFT_BITS) if low >> (SHIFT_BITS - 1) else low


def _place_row(table: str, name: str, flips: Sequence[Flip]) -> Row:
    """For each memory the mean and the worst flip."""
    figures = {}
    for memory in PLACES:
        found = [flip for flip in flips if flip.memory == memory]
        if found:
            figures[f"{memory}, mean"] = measured(float(np.mean([f.rms_dn for f in found])), "DN rms", SOURCE)
            figures[f"{memory}, worst"] = measured(max(f.rms_dn for f in found), "DN rms", SOURCE)
    return Row(table, name, figures)


def _bit_name(bit: int) -> str:
    ends = {0: " (least)", INT8_BITS - 1: " (sign)"}
    return f"bit {bit}{ends.get(bit, '')}"


RATES = (0.1, 1.0, 10.0, 100.0, 1000.0)
"""Bit flips in a megabit, of 10^6."""
RATES_OF = {"shifts": (10.0, 100.0, 1000.0, 10_000.0)}
"""There are too few shifts to be hit at rates that matter elsewhere."""
DRAWS_OF = {"shifts": 10, "image": 5}
"""So many times the draws, where few of them flip a bit; those that do not cost nothing."""
CORRECTABLE = ("weights", "shifts")
SETS = ("no guard", "clamped", "all guards")


@dataclass(frozen=True)
class Draw:
    """What one injection came to: the bits that it flipped, and PSNR in dB with each set of guards."""

    flips: int
    quality_db: tuple[float, float, float]


def curve_rows(target: FaultTarget, draws: int, seed: int, tick: Callable[[], None] = lambda: None) -> list[Row]:
    """A row for every kind of memory and rate."""
    clean = [clean_db(target, number) for number in range(len(target.pairs))]
    rows = [_clean_row(clean)]
    for memory in MEMORIES:
        for rate in rates_of(memory):
            found = []
            for draw in range(draws_of(memory, draws)):
                found.append(_draw(target, memory, rate, draw, seed, clean[draw % len(clean)]))
                tick()
            rows.append(_curve_row(memory, rate, found))
    return rows


def curve_ticks(draws: int) -> int:
    """How often `curve_rows` reports progress."""
    return sum(len(rates_of(memory)) * draws_of(memory, draws) for memory in MEMORIES)


def draws_of(memory: str, draws: int) -> int:
    """How many injections into a kind of memory there are at each rate, `draws` being those asked for."""
    return draws * DRAWS_OF.get(memory, 1)


def rates_of(memory: str) -> tuple[float, ...]:
    """The rates of injection for a kind of memory, bit flips in a megabit."""
    return RATES_OF.get(memory, RATES)


def name_of(memory: str, rate: float) -> str:
    """The name of the row for a kind of memory and a rate."""
    return f"{memory}, {rate:g} in a megabit"


def clean_db(target: FaultTarget, number: int) -> tuple[float, float]:
    """PSNR of a pair without flips: as it is, and clamped."""
    injected, reference = target.fault_free(number), target.pairs[number][1]
    bare, clamped = (quality_db(target, injected, reference, clamped) for clamped in (False, True))
    return bare, clamped


def _draw(target: FaultTarget, memory: str, rate: float, draw: int, seed: int, clean: tuple[float, float]) -> Draw:
    image, reference = target.pairs[draw % len(target.pairs)]
    # Keyed by what is drawn, so that a draw is the same whatever else runs.
    generator = np.random.default_rng([seed, draw, list(MEMORIES).index(memory), rates_of(memory).index(rate)])
    injected = MEMORIES[memory](target, image, rate, generator)
    # No flip, no change: the fault-free figures stand, at no cost.
    if injected.flips == 0:
        return Draw(0, (*clean, clean[1]))
    bare, clamped = (quality_db(target, injected, reference, c) for c in (False, True))
    # Maps and pixels live for one tile: scrubbing has nothing to compare them with.
    if memory not in CORRECTABLE:
        return Draw(injected.flips, (bare, clamped, clamped))
    corrected = correct_faults(target, injected, rate, generator)
    whole = clean[1] if is_corrected(target, corrected) else quality_db(target, corrected, reference, clamped=True)
    return Draw(injected.flips, (bare, clamped, whole))


def _clean_row(clean: Sequence[tuple[float, float]]) -> Row:
    source = f"integer reference, mean and range of {len(clean)} patches"
    figures = {
        name: _mean([pair[k] for pair in clean], source) for k, name in ((0, SETS[0]), (1, SETS[1]), (1, SETS[2]))
    }
    return Row("bit flips", "none", {"flips": measured(0, "bits", source), **figures})


def _curve_row(memory: str, rate: float, draws: Sequence[Draw]) -> Row:
    source = f"integer reference, mean and range of {len(draws)} draws"
    flips = measured(float(np.mean([draw.flips for draw in draws])), "bits", source)
    figures = {name: _mean([draw.quality_db[k] for draw in draws], source) for k, name in enumerate(SETS)}
    return Row("bit flips", name_of(memory, rate), {"flips": flips, **figures})


def _mean(values: Sequence[float], source: str) -> Figure:
    # Exact before it is rounded once: the mean of the same values is the same, however often each stands there.
    return measured(statistics.mean(values), "dB", source, (min(values), max(values)))
