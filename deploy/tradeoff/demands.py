"""What a user can afford and needs: `latency<=20s`, `psnr>=44`, several with commas."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from deploy.results import Figure
from profiles.errors import OptionError

NAMES = {
    "psnr": ("PSNR", "dB"),
    "ssim": ("SSIM", "ratio"),
    "lpips": ("LPIPS-squeeze", "distance"),
    "mtf": ("MTF at Nyquist", "%"),
    "snr": ("flat SNR", "ratio"),
    "mae": ("float-INT8 MAE", "ratio"),
    "host": ("host p50", "s/Mpx"),
    "host-p90": ("host p90", "s/Mpx"),
    "latency": ("board latency", "s"),
    "throughput": ("board throughput", "frame/s"),
    "power": ("board power", "W"),
    "energy": ("board energy", "J"),
    "efficiency": ("board efficiency", "px/s/W"),
}
"""What a user writes: the figure that it stands for, and its unit."""

DEMAND = re.compile(
    r"(?P<name>[a-z0-9-]+)\s*(?P<side><=|>=)\s*(?P<limit>[+-]?\d+(\.\d+)?([eE][+-]?\d+)?)\s*(?P<unit>\S*)"
)


@dataclass(frozen=True)
class Demand:
    """One limit: the figure at most, or at least, so much."""

    key: str
    at_most: bool
    limit: float
    unit: str

    def __str__(self) -> str:
        unit = "" if self.unit in ("ratio", "distance") else f" {self.unit}"
        return f"{self.key} {'at most' if self.at_most else 'at least'} {self.limit:g}{unit}"

    def short_by(self, figure: Figure | None) -> float:
        """By what share of the limit a figure misses it; 0 where it keeps it, endless where it is unavailable."""
        if figure is None or figure.value is None:
            return math.inf
        miss = figure.value - self.limit if self.at_most else self.limit - figure.value
        return max(miss, 0.0) / (abs(self.limit) or 1.0)

    def surely_kept(self, figure: Figure) -> bool:
        """Whether the whole interval keeps it."""
        low, high = figure.interval or (figure.value or 0.0,) * 2
        return high <= self.limit if self.at_most else low >= self.limit


def parse_demands(option: str, text: str | None) -> list[Demand]:
    """Demands with commas between them.

    Raises:
        OptionError: another text, an unknown name, or a unit that is not the figure's.
    """
    return [_parse(option, part.strip()) for part in text.split(",")] if text is not None else []


def _parse(option: str, text: str) -> Demand:
    found = DEMAND.fullmatch(text.lower())
    if found is None:
        expected, remedy = "NAME<=NUMBER or NAME>=NUMBER", "write 'latency<=20s' or 'psnr>=44'"
        raise OptionError(option, expected=expected, got=repr(text), remedy=remedy)
    if found["name"] not in NAMES:
        expected = f"one of {', '.join(NAMES)}"
        raise OptionError(option, expected=expected, got=repr(found["name"]), remedy="correct the name")
    key, unit = NAMES[found["name"]]
    if found["unit"] not in ("", unit.lower()):
        remedy = f"write {found['name']}{found['side']}{found['limit']}{unit}"
        raise OptionError(option, expected=f"{key} in {unit}", got=repr(found["unit"]), remedy=remedy)
    return Demand(key, found["side"] == "<=", float(found["limit"]), unit)


def shortfall(figures: Mapping[str, Figure], demands: Sequence[Demand]) -> float:
    """By what share of its limit a point misses the demand that it misses most; 0 where it keeps all."""
    return max((demand.short_by(figures.get(demand.key)) for demand in demands), default=0.0)
