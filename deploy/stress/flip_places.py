"""Where a flip hurts: one bit at a time, in each layer's weights, shifts and result, and by the bit's weight.

What one flip changes is the error of the restored image against the healthy network's, in DN; against the reference
a small one would not be seen. No guard is on.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from deploy.results import Row, measured
from deploy.stress.flips import Patient, Struck, restored, struck_maps
from quant.core import IntConv
from quant.graph import Add
from quant.integer import SOUND, Faults
from quant.planes import MAX_DN
from quant.upsets import INT8_BITS, SHIFT_BITS, upset_conv, with_ops

SOURCE = "integer reference, one flip at a time: a number drawn for each bit"
MEMORIES = ("weights", "map", "shifts")


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
        _row("bit flips by layer", op.name, [f for f in flips if f.layer == op.name]) for op in patient.core.ops
    ]
    bits = [_row("bit flips by bit", _bit_name(k), [f for f in flips if f.bit == k]) for k in range(INT8_BITS)]
    return [*layers, *bits]


def ticks(patient: Patient) -> int:
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


def _row(table: str, name: str, flips: Sequence[Flip]) -> Row:
    """For each memory the mean and the worst flip."""
    figures = {}
    for memory in MEMORIES:
        found = [flip for flip in flips if flip.memory == memory]
        if found:
            figures[f"{memory}, mean"] = measured(float(np.mean([f.rms_dn for f in found])), "DN rms", SOURCE)
            figures[f"{memory}, worst"] = measured(max(f.rms_dn for f in found), "DN rms", SOURCE)
    return Row(table, name, figures)


def _bit_name(bit: int) -> str:
    ends = {0: " (least)", INT8_BITS - 1: " (sign)"}
    return f"bit {bit}{ends.get(bit, '')}"
