"""An axis of a plot: where a value stands, and which values are written beside it."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

MANTISSAS = ((1.0, 1.5, 2.0, 3.0, 5.0, 7.0), (1.0, 2.0, 5.0), (1.0, 3.0), (1.0,))
LEAST_TICKS = 3


@dataclass(frozen=True)
class Axis:
    """Values from low to high, between two places in pixels; a logarithmic one holds positive values only."""

    low: float
    high: float
    start_px: float
    end_px: float
    logarithmic: bool

    def place(self, value: float) -> float:
        """In pixels; a value beyond the axis stands at its end."""
        low, high, here = (self._warp(each) for each in (self.low, self.high, min(max(value, self.low), self.high)))
        return round(self.start_px + (self.end_px - self.start_px) * (here - low) / (high - low), 1)

    def ticks(self, most: int) -> list[float]:
        """Round values, at most so many."""
        for mantissas in MANTISSAS if self.logarithmic else ():
            found = self._decades(mantissas)
            if LEAST_TICKS <= len(found) <= most:
                return found
        powers = self._decades((1.0,)) if self.logarithmic else []
        return powers[:: -(-len(powers) // most)] if len(powers) > most else even_ticks(self.low, self.high, most)

    def _decades(self, mantissas: Iterable[float]) -> list[float]:
        powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        values = [float(f"{mantissa}e{power}") for power in powers for mantissa in mantissas]
        return [value for value in values if self.low <= value <= self.high]

    def _warp(self, value: float) -> float:
        return math.log(value) if self.logarithmic else value


def even_ticks(low: float, high: float, most: int) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten, the closest together that are at most so many."""
    power = math.floor(math.log10((high - low) / most))
    steps = [round(m * 10.0**p, 15 - p) for p in range(power, power + 3) for m in (1, 2, 5)]
    step = next(step for step in steps if math.floor(high / step) - math.ceil(low / step) < most)
    digits = max(-math.floor(math.log10(step)), 0)
    return [round(k * step, digits) for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def padded(low: float, high: float, share: float, *, logarithmic: bool) -> tuple[float, float]:
    """A range widened at both ends by a share of its length; one without length gets some."""
    if logarithmic:
        ends = padded(math.log(low), math.log(high), share, logarithmic=False)
        return math.exp(ends[0]), math.exp(ends[1])
    margin = share * (high - low) or max(abs(high) * share, share)
    return low - margin, high + margin
