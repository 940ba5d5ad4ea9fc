"""Which point to take: what a user can afford and needs (`latency<=20s`, `psnr>=44`), and one recommended line."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Figure, Row
from beers_deploy.studies.tradeoff.pareto import COSTS, PSNR, Comparison, Measured, ends, placed

MAP50 = "mAP50"
NAMES: dict[str, tuple[str, str]] = {
    "psnr": ("PSNR", "dB"),
    "ssim": ("SSIM", "ratio"),
    "lpips": ("LPIPS-squeeze", "distance"),
    "map50": (MAP50, "%"),
    "host": ("host p50", "s/Mpx"),
    "host-p90": ("host p90", "s/Mpx"),
    "latency": ("board latency", "s"),
    "throughput": ("board throughput", "frame/s"),
    "power": ("board power", "W"),
    "energy": ("board energy", "J"),
    "efficiency": ("board efficiency", "px/s/W"),
}
"""What a user writes: the figure that it stands for, and its unit."""

CONSTRAINT = re.compile(
    r"(?P<name>[a-z0-9-]+)\s*(?P<side><=|>=)\s*(?P<limit>[+-]?\d+(\.\d+)?([eE][+-]?\d+)?)\s*(?P<unit>\S*)"
)


@dataclass(frozen=True)
class Constraint:
    """A figure at most, or at least, so much."""

    key: str
    at_most: bool
    limit: float
    unit: str

    def __str__(self) -> str:
        unit = "" if self.unit in ("ratio", "distance") else f" {self.unit}"
        return f"{self.key} {'<=' if self.at_most else '>='} {self.limit:g}{unit}"

    def violation(self, figure: Figure | None) -> float:
        """By what share of the limit a figure misses it: 0 where it keeps it, endless where there is none."""
        if figure is None or figure.value is None or figure.mode == "published":
            return math.inf
        miss = figure.value - self.limit if self.at_most else self.limit - figure.value
        return max(miss, 0.0) / (abs(self.limit) or 1.0)

    def holds_throughout(self, figure: Figure) -> bool:
        """Whether the figure's whole interval keeps it."""
        low, high = ends(figure)
        return high <= self.limit if self.at_most else low >= self.limit


def parse_constraints(option: str, text: str | None) -> list[Constraint]:
    """Read constraints with commas between: `latency<=20s, psnr>=44`."""
    return [_parse(option, part.strip()) for part in text.split(",")] if text is not None else []


def _parse(option: str, text: str) -> Constraint:
    found = CONSTRAINT.fullmatch(text.lower())
    if found is None or not math.isfinite(float(found["limit"])):
        expected, remedy = "NAME<=NUMBER or NAME>=NUMBER", "write 'latency<=20s' or 'psnr>=44'"
        raise OptionError(option, expected=expected, got=repr(text), remedy=remedy)
    if found["name"] not in NAMES:
        expected = f"one of {', '.join(NAMES)}"
        raise OptionError(option, expected=expected, got=repr(found["name"]), remedy="correct the name")
    key, unit = NAMES[found["name"]]
    if found["unit"] not in ("", unit.lower()):
        remedy = f"write {found['name']}{found['side']}{found['limit']}{unit}"
        raise OptionError(option, expected=f"{key} in {unit}", got=repr(found["unit"]), remedy=remedy)
    return Constraint(key, found["side"] == "<=", float(found["limit"]), unit)


WORTH_A_WORD_DB = 0.002
"""Gains below it that are not significant are not mentioned."""


@dataclass(frozen=True)
class Recommendation:
    """The point to take, None where none keeps the constraints; and a line that says so."""

    point: Measured | None
    line: str

    @property
    def row(self) -> Row:
        """For the document."""
        name, figures = (self.point.name, self.point.figures) if self.point else ("none", {})
        return Row("recommended", name, figures, {"line": self.line})


def chosen_cost(points: Sequence[Measured], budget: Sequence[Constraint]) -> str:
    """The cost that the budget names; else the first that any point has, the board's latency before all."""
    named = (constraint.key for constraint in budget if constraint.key in COSTS)
    had = (key for key in COSTS if any(point.value(key) is not None for point in points))
    return next(named, next(had, COSTS[0]))


def recommend(
    points: Sequence[Measured], budget: Sequence[Constraint], need: Sequence[Constraint], compare: Comparison
) -> Recommendation:
    """Within a budget the best PSNR, or the cheapest point that is not significantly worse; for a need the cheapest.

    Args:
        points: of one board.
        budget: what can be afforded.
        need: what must be reached.
        compare: tells which point is better.
    """
    constraints, cost = [*budget, *need], chosen_cost(points, budget)
    ranked = placed(points, cost)
    kept = [point for point in ranked if not _violation(point, constraints)]
    limits = f" for {' and '.join(map(str, constraints))}" if constraints else ""
    if not kept:
        return Recommendation(None, _nearest(ranked, constraints, limits))
    cheapest_first = sorted(kept, key=lambda point: point.cost(cost))
    best = max(cheapest_first, key=lambda point: point.psnr_db)
    taken = cheapest_first[0]
    if budget or not need:
        taken = next(point for point in cheapest_first if not compare.significantly_better(best, point))
    line = f"recommended{limits}: {_words(taken, [PSNR, cost, *(each.key for each in constraints)])}"
    return Recommendation(taken, line + _remarks(taken, best, constraints, compare, by_psnr=bool(budget or not need)))


def _violation(point: Measured, constraints: Sequence[Constraint]) -> float:
    """Of the constraint that a point misses most."""
    return max((each.violation(point.figures.get(each.key)) for each in constraints), default=0.0)


def _nearest(points: Sequence[Measured], constraints: Sequence[Constraint], limits: str) -> str:
    known = [point for point in points if math.isfinite(_violation(point, constraints))]
    if not known:
        return f"nothing to recommend{limits}: no point has every figure asked for"
    nearest = min(known, key=lambda point: _violation(point, constraints))
    return f"nothing to recommend{limits}; nearest is {_words(nearest, [each.key for each in constraints])}"


def _words(point: Measured, keys: Sequence[str]) -> str:
    figures = [f"{key} {_figure(point.figures[key])}" for key in dict.fromkeys(keys)]
    return f"{point.name}: {', '.join(figures)}"


def _figure(figure: Figure) -> str:
    if figure.value is None:
        return "unavailable"
    unit = "" if figure.unit in ("ratio", "distance") else f" {figure.unit}"
    return f"{figure}{unit} ({figure.mode})"


def _remarks(
    taken: Measured, best: Measured, constraints: Sequence[Constraint], compare: Comparison, *, by_psnr: bool
) -> str:
    """That a better value is not significant, and that an interval reaches beyond a limit."""
    remarks = ""
    if by_psnr and best is not taken:
        gain = compare.difference(best, taken)
        if (gain.value or 0.0) >= WORTH_A_WORD_DB:
            remarks += f"; {best.name} has {gain} dB more, {compare.verdict(best, taken)}"
    unsure = [str(each) for each in constraints if not each.holds_throughout(taken.figures[each.key])]
    return remarks + (f"; {' and '.join(unsure)} holds by value, not over the whole interval" if unsure else "")
