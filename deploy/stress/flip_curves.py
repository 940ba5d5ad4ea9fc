"""PSNR against bits turned over in a megabit, without guards, in a clamped network, and with all guards.

One kind of memory is struck at a time, so that each shows what it does; the same strikes meet each set of guards.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from deploy.results import Figure, Row, measured
from deploy.stress.flips import MEMORIES, Patient, is_mended, mended, quality_db

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
            rows.append(_row(memory, rate, found))
    return rows


def ticks(draws: int) -> int:
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


def _row(memory: str, rate: float, draws: Sequence[Draw]) -> Row:
    source = f"integer reference, mean and range of {len(draws)} draws"
    flips = measured(float(np.mean([draw.flips for draw in draws])), "bits", source)
    figures = {name: _mean([draw.quality_db[k] for draw in draws], source) for k, name in enumerate(SETS)}
    return Row("bit flips", name_of(memory, rate), {"flips": flips, **figures})


def _mean(values: Sequence[float], source: str) -> Figure:
    return measured(float(np.mean(values)), "dB", source, (min(values), max(values)))
