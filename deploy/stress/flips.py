"""Bit flips: injected into weights, shifts, feature maps or the image, one at a time and many.

Where a flip hurts, by layer and by the bit's weight; PSNR against flips in a megabit, with and without guards.
"""

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from deploy.stress.networks import planes_of
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
    guarded,
    map_channels,
    reloaded,
    shifts_of,
    turned_over,
    upset_conv,
    upset_count,
    upset_shifts,
    upset_weights,
    voted,
    weight_bits,
    with_ops,
)
from quant.graph import MAX_DN, Add
from quant.integer import SOUND, Faults, merged_correction, run_core

Pair = tuple[np.ndarray, np.ndarray]
"""Degraded and reference, (1, 1, H, W) in [0, 1] each."""
Shifts = dict[tuple[str, str], int]


@dataclass(frozen=True)
class Patient:
    """A network under fire: its core as the board stores it, its guards, and what it is tried on."""

    core: IntCore
    guards: Guards
    pairs: Sequence[Pair]

    @cached_property
    def shifts(self) -> Shifts:
        """As they are meant."""
        return shifts_of(self.core)

    def healthy(self, number: int) -> "Struck":
        """A pair with nothing turned over."""
        return Struck(self.core, SOUND, self.pairs[number][0], 0)


@dataclass(frozen=True)
class Struck:
    """A network and an image as they are after a strike.

    Attributes:
        core: with the weights as they are now.
        faults: what else is wrong.
        image: (1, 1, H, W), as it is now.
        flips: how many bits were turned over.
    """

    core: IntCore
    faults: Faults
    image: np.ndarray
    flips: int


def restored(patient: Patient, struck: Struck, clamped: bool = False) -> np.ndarray:
    """The image (1, 1, H, W) that a struck network makes of a struck image."""
    faults = guarded(struck.faults, patient.guards) if clamped else struck.faults
    tensors, _ = run_core(struck.core, planes_of(struck.core, struck.image), faults=faults)
    correction = merged_correction(struck.core, tensors)
    correction = patient.guards.limit(correction) if clamped else correction
    return np.asarray(np.clip(struck.image + correction, 0, 1), np.float32)


def quality_db(patient: Patient, struck: Struck, reference: np.ndarray, clamped: bool = False) -> float:
    """PSNR of what it makes, on [0, 1]."""
    return psnr_db(restored(patient, struck, clamped), reference, 1.0)


def mended(patient: Patient, struck: Struck, per_megabit: float, generator: np.random.Generator) -> Struck:
    """What checksums and three copies make of it before the next image: the other copies are struck as well."""
    core = reloaded(struck.core, patient.core, patient.guards.checksums)
    first = {**patient.shifts, **struck.faults.shifts}
    second, third = (_upset_copy(patient, per_megabit, generator) for _ in range(2))
    shifts = voted((first, second, third)) if struck.faults.shifts else {}
    return replace(struck, core=core, faults=replace(struck.faults, shifts=shifts))


def is_mended(patient: Patient, struck: Struck) -> bool:
    """Whether weights and shifts are all as they are meant."""
    meant = {**patient.shifts, **struck.faults.shifts} == patient.shifts
    return meant and checksums(struck.core) == patient.guards.checksums


def _weights(patient: Patient, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Struck:
    flips = upset_count(weight_bits(patient.core), per_megabit, generator)
    return Struck(upset_weights(patient.core, flips, generator), SOUND, image, flips)


def _shifts(patient: Patient, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Struck:
    wrong = _upset_copy(patient, per_megabit, generator)
    return Struck(patient.core, Faults(wrong), image, bits_apart(wrong, patient.shifts))


def _maps(patient: Patient, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Struck:
    """Every tensor is struck once, between the operation that writes it and those that read it."""
    pixels, channels = image[0, 0].size, map_channels(patient.core)
    counts = {name: upset_count(INT8_BITS * pixels * n, per_megabit, generator) for name, n in channels.items()}
    return struck_maps(patient, image, counts, int(generator.integers(2**63)))


def struck_maps(
    patient: Patient, image: np.ndarray, counts: dict[str, int], seed: int, bit: int | None = None
) -> Struck:
    """So many bits of each tensor turned over, the same ones whenever it runs."""
    seeds = {name: [seed, number] for number, name in enumerate(counts)}

    def touch(name: str, tensor: np.ndarray) -> np.ndarray:
        if not counts.get(name):
            return tensor
        return turned_over(tensor, counts[name], np.random.default_rng(seeds[name]), INT8_BITS, bit)

    return Struck(patient.core, Faults({}, touch), image, sum(counts.values()))


def _image(patient: Patient, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Struck:
    flips = upset_count(PIXEL_BITS * image.size, per_megabit, generator)
    dn = turned_over(np.rint(image * MAX_DN).astype(np.uint16), flips, generator, PIXEL_BITS)
    return Struck(patient.core, SOUND, (dn / np.float32(MAX_DN)).astype(np.float32), flips)


def _upset_copy(patient: Patient, per_megabit: float, generator: np.random.Generator) -> Shifts:
    flips = upset_count(SHIFT_BITS * len(patient.shifts), per_megabit, generator)
    return upset_shifts(patient.shifts, flips, generator)


Strike = Callable[[Patient, np.ndarray, float, np.random.Generator], Struck]
MEMORIES: dict[str, Strike] = {"weights": _weights, "shifts": _shifts, "maps": _maps, "image": _image}


SOURCE = "integer reference, one flip at a time: a number drawn for each bit"
PLACES = ("weights", "map", "shifts")


@dataclass(frozen=True)
class Flip:
    """One flip: where it fell, and what it did to the restored image, in DN, root mean square."""

    layer: str
    memory: str
    bit: int
    rms_dn: float


def place_rows(patient: Patient, seed: int, side_px: int, tick: Callable[[], None] = lambda: None) -> list[Row]:
    """A row a layer and a row a bit."""
    flips = list(single_flips(patient, seed, side_px, tick))
    layers = [
        _place_row("bit flips by layer", op.name, [f for f in flips if f.layer == op.name]) for op in patient.core.ops
    ]
    bits = [_place_row("bit flips by bit", _bit_name(k), [f for f in flips if f.bit == k]) for k in range(INT8_BITS)]
    return [*layers, *bits]


def place_ticks(patient: Patient) -> int:
    """How often `place_rows` reports progress."""
    return len(patient.core.ops)


def single_flips(
    patient: Patient, seed: int, side_px: int, tick: Callable[[], None] = lambda: None
) -> Iterator[Flip]:
    """For every bit a flip of one number in each layer's weights and result, and of each shift; on a crop."""
    for number, op in enumerate(patient.core.ops):
        generator = np.random.default_rng([seed, number])
        image = patient.pairs[number % len(patient.pairs)][0][:, :, :side_px, :side_px]
        healthy = restored(patient, Struck(patient.core, SOUND, image, 0))
        for memory, bit, struck in _strikes(patient, op, image, generator):
            error_dn = MAX_DN * (restored(patient, struck).astype(np.float64) - healthy)
            yield Flip(op.name, memory, bit, float(np.sqrt(np.mean(error_dn**2))))
        tick()


def _strikes(
    patient: Patient, op: IntConv | Add, image: np.ndarray, generator: np.random.Generator
) -> Iterator[tuple[str, int, Struck]]:
    healthy = Struck(patient.core, SOUND, image, 1)
    for bit in range(INT8_BITS):
        if isinstance(op, IntConv):
            struck = upset_conv(op, 1, generator, bit)
            yield "weights", bit, replace(healthy, core=with_ops(patient.core, {op.name: struck}))
        yield "map", bit, struck_maps(patient, image, {op.output: 1}, int(generator.integers(2**63)), bit)
    for key in [key for key in patient.shifts if key[0] == op.name]:
        for bit in range(SHIFT_BITS):
            wrong = _signed(patient.shifts[key] ^ (1 << bit))
            yield "shifts", bit, replace(healthy, faults=Faults({key: wrong}))


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
"""Bits turned over in a megabit, of 10^6."""
RATES_OF = {"shifts": (10.0, 100.0, 1000.0, 10_000.0)}
"""There are too few shifts to be hit at rates that matter elsewhere."""
DRAWS_OF = {"shifts": 10, "image": 5}
"""So many times the draws, where few of them strike; those that do not cost nothing."""
MENDABLE = ("weights", "shifts")
SETS = ("no guard", "clamped", "all guards")


@dataclass(frozen=True)
class Draw:
    """What one strike came to: bits turned over, and PSNR in dB with each set of guards."""

    flips: int
    quality_db: tuple[float, float, float]


def curve_rows(patient: Patient, draws: int, seed: int, tick: Callable[[], None] = lambda: None) -> list[Row]:
    """A row for every kind of memory and rate."""
    clean = [clean_db(patient, number) for number in range(len(patient.pairs))]
    rows = [_clean_row(clean)]
    for memory in MEMORIES:
        for rate in rates_of(memory):
            found = []
            for draw in range(draws_of(memory, draws)):
                found.append(_draw(patient, memory, rate, draw, seed, clean[draw % len(clean)]))
                tick()
            rows.append(_curve_row(memory, rate, found))
    return rows


def curve_ticks(draws: int) -> int:
    """How often `curve_rows` reports progress."""
    return sum(len(rates_of(memory)) * draws_of(memory, draws) for memory in MEMORIES)


def draws_of(memory: str, draws: int) -> int:
    """How often a kind of memory is struck at each rate."""
    return draws * DRAWS_OF.get(memory, 1)


def rates_of(memory: str) -> tuple[float, ...]:
    """The rates at which a kind of memory is struck."""
    return RATES_OF.get(memory, RATES)


def name_of(memory: str, rate: float) -> str:
    """Of a row."""
    return f"{memory}, {rate:g} in a megabit"


def clean_db(patient: Patient, number: int) -> tuple[float, float]:
    """PSNR of a pair without flips: as it is, and clamped."""
    struck, reference = patient.healthy(number), patient.pairs[number][1]
    bare, clamped = (quality_db(patient, struck, reference, clamped) for clamped in (False, True))
    return bare, clamped


def _draw(patient: Patient, memory: str, rate: float, draw: int, seed: int, clean: tuple[float, float]) -> Draw:
    image, reference = patient.pairs[draw % len(patient.pairs)]
    generator = np.random.default_rng([seed, draw, list(MEMORIES).index(memory), rates_of(memory).index(rate)])
    struck = MEMORIES[memory](patient, image, rate, generator)
    if struck.flips == 0:
        return Draw(0, (*clean, clean[1]))
    bare, clamped = (quality_db(patient, struck, reference, c) for c in (False, True))
    if memory not in MENDABLE:
        return Draw(struck.flips, (bare, clamped, clamped))
    healed = mended(patient, struck, rate, generator)
    whole = clean[1] if is_mended(patient, healed) else quality_db(patient, healed, reference, clamped=True)
    return Draw(struck.flips, (bare, clamped, whole))


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
