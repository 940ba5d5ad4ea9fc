"""Choose a point by limits such as `latency<=20s`, recommend it in one line, and compare the best
point of each board with it.
"""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from beers_deploy.performance.swath import interval_ends
from beers_deploy.profiles.errors import OptionError, listed, printable
from beers_deploy.profiles.figures import Row
from beers_deploy.studies.tradeoff.front import (
    BOARDS,
    COSTS,
    LATENCY,
    PSNR,
    Comparison,
    Measured,
    figures_to_compare,
    placed,
    significant,
    verdict,
)
from beers_deploy.studies.tradeoff.points import UNITS

NAMES: dict[str, tuple[str, str]] = {
    "psnr": (PSNR, "dB"),
    "ssim": ("SSIM", "ratio"),
    "lpips": ("LPIPS-squeeze", "distance"),
    "host": ("host p50", "s/Mpx"),
    "host-p90": ("host p90", "s/Mpx"),
    **{key.removeprefix("board "): (key, unit) for key, unit in UNITS.items()},
}
"""The names that a user may write: the figure that each one stands for, and its unit."""
BETTER_LARGER = ("psnr", "ssim", "throughput", "efficiency")
"""Names of figures that a user limits from below; all others are limited from above."""
BARE_UNITS = ("ratio", "distance")

WORTH_A_WORD_DB = 0.002
"""Smaller gains are not mentioned unless they are significant."""

CONSTRAINT = re.compile(
    r"(?P<name>[a-z0-9-]+)\s*(?P<side><=|>=)\s*(?P<limit>[+-]?\d+(\.\d+)?(e[+-]?\d+)?)\s*(?P<unit>\S*)",
    re.IGNORECASE,
)


def with_unit(text: str, unit: str) -> str:
    """Append the unit to a number, such as "20 s"; ratios and distances are written without one."""
    return text if unit in BARE_UNITS else f"{text} {unit}"


@dataclass(frozen=True)
class Constraint:
    """A limit that a user sets on one figure of an operating point, such as `latency<=20s`.

    Attributes:
        key: the name of the figure.
        at_most: True for an upper limit, False for a lower one.
        limit: the limit, in the unit of the figure.
        unit: the unit of the figure.
    """

    key: str
    at_most: bool
    limit: float
    unit: str

    def __str__(self) -> str:
        sign = "<=" if self.at_most else ">="
        return f"{self.key} {sign} {with_unit(f'{self.limit:g}', self.unit)}"

    def violation(self, point: Measured) -> float:
        """Return by how much an operating point misses the limit, as a share of the limit: 0 if it
        complies, infinity if it lacks the figure.
        """
        over = point.value(self.key) - self.limit
        miss = over if self.at_most else -over
        # A limit of 0 has no share: there the miss itself counts.
        return math.inf if math.isnan(miss) else max(miss, 0.0) / (abs(self.limit) or 1.0)


def parse_constraints(option: str, text: str | None) -> list[Constraint]:
    """Parse the limits that a user gives, separated by commas, such as `latency<=20s, psnr>=44`.

    Args:
        option: the name of the option, for messages.
        text: the value of the option; None gives no limit.

    Raises:
        OptionError: a part has another form, or names an unknown figure or another unit.
    """
    limits = []
    for part in [] if text is None else listed(text):
        fields = CONSTRAINT.fullmatch(part)
        if fields is None or not math.isfinite(float(fields["limit"])):
            raise OptionError(
                f"`{option}` must be NAME<=NUMBER or NAME>=NUMBER, such as 'latency<=20s' or "
                f"'psnr>=44', but it is {printable(repr(part))}."
            )
        name, side, number, written_unit = fields.group("name", "side", "limit", "unit")
        name = name.lower()
        if name not in NAMES:
            raise OptionError(
                f"`{option}` must name one of {', '.join(NAMES)}, but it names "
                f"{printable(repr(name))}."
            )
        key, unit = NAMES[name]
        if written_unit.lower() not in ("", unit.lower()):
            raise OptionError(
                f"`{option}` must give {key} in {unit}, but its unit is "
                f"{printable(repr(written_unit))}. Convert the number to {unit}."
            )
        limit = Constraint(key, side == "<=", float(number), unit)
        if limit.at_most == (name in BETTER_LARGER):
            way, sign = ("below", ">=") if limit.at_most else ("above", "<=")
            raise OptionError(
                f"`{option}` must limit {key} from {way}, but it is {limit}. Write "
                f"{name}{sign}{number}{written_unit}."
            )
        # Every figure that can have an upper limit is above 0, so that no point would comply.
        if limit.at_most and limit.limit <= 0:
            raise OptionError(f"`{option}` must give an upper limit above 0, but it is {limit}.")
        limits.append(limit)
    return limits


@dataclass(frozen=True)
class Question:
    """The question of a study: which operating point is best within the user's limits.

    Attributes:
        budget: limits that the costs of a point must keep, such as latency or power.
        need: limits that its quality must reach, such as PSNR.
        compare: compares the quality of two points on the same images.
    """

    budget: Sequence[Constraint]
    need: Sequence[Constraint]
    compare: Comparison

    @property
    def constraints(self) -> list[Constraint]:
        """All limits: those of the budget, then those of the need."""
        return [*self.budget, *self.need]

    def cost(self, points: Sequence[Measured]) -> str:
        """Return the name of the cost against which quality is compared.

        This is the first cost that the budget limits; else the first of latency, energy and time on
        this machine that any point has a value of.

        Args:
            points: the operating points.
        """
        limited = [constraint.key for constraint in self.budget]
        available = [
            key for key in COSTS if any(not math.isnan(point.value(key)) for point in points)
        ]
        return next(key for key in (*limited, *available, LATENCY) if key in COSTS)


def recommend(points: Sequence[Measured], asked: Question) -> tuple[Measured | None, str]:
    """Recommend an operating point within the user's limits.

    It is the cheapest point whose PSNR is not significantly worse than the best one within the
    limits. For a need without a budget, it is the cheapest point of all within the limits.

    Args:
        points: the operating points of all boards.
        asked: the budget and the need.

    Returns:
        The recommended point, or None if none complies with the constraints, and a line that states
        the result.
    """
    constraints = asked.constraints
    cost = asked.cost(points)
    candidates = within(points, constraints, cost)
    limits = f" for {' and '.join(map(str, constraints))}" if constraints else ""
    if not candidates:
        return None, f"nothing to recommend{limits}{nearest(placed(points, cost), constraints)}"
    choice, best = choose(candidates, asked)
    keys = [PSNR, cost, *(constraint.key for constraint in constraints)]
    line = f"recommended{limits}: {_words(choice, keys)}"
    gain = asked.compare.difference(best, choice)
    if (
        (asked.budget or not asked.need)
        and best is not choice
        and (gain.value or 0.0) >= WORTH_A_WORD_DB
    ):
        line += f"; {best.name} has {gain} dB more, {verdict(gain)}"
    for constraint in constraints:
        low, high = interval_ends(choice.figures[constraint.key])
        holds = high <= constraint.limit if constraint.at_most else low >= constraint.limit
        if not holds:
            line += f"; {constraint} holds by value, not over the whole interval"
    return choice, line


def within(
    points: Iterable[Measured], constraints: Sequence[Constraint], cost: str
) -> list[Measured]:
    """Return the points whose values comply with every constraint, sorted by increasing cost.

    Args:
        points: the operating points.
        constraints: the limits.
        cost: the name of the cost. Points without a value of this cost or of PSNR are left out.
    """
    return [point for point in placed(points, cost) if not _violation(point, constraints)]


def choose(candidates: Sequence[Measured], asked: Question) -> tuple[Measured, Measured]:
    """Choose the point to recommend, as `recommend` describes.

    Args:
        candidates: the points that comply with the constraints, sorted by increasing cost; at least
            one.
        asked: the budget and the need.

    Returns:
        The chosen point, and the point with the best PSNR.
    """
    best = max(candidates, key=lambda point: point.value(PSNR))
    # A need without a budget asks for the cheapest point, however good it is.
    if asked.need and not asked.budget:
        return candidates[0], best
    # They are sorted by cost: the first that is not significantly worse is the cheapest such.
    choice = next(
        point for point in candidates if not significant(asked.compare.difference(best, point))
    )
    return choice, best


def _violation(point: Measured, constraints: Sequence[Constraint]) -> float:
    """Return by how much a point misses the constraint that it misses most; 0 if it complies."""
    return max((constraint.violation(point) for constraint in constraints), default=0.0)


def nearest(points: Sequence[Measured], constraints: Sequence[Constraint]) -> str:
    """Return the end of a sentence that names the point which comes nearest to the limits, or that
    says that no point has all figures that they name.

    Args:
        points: the operating points; may be empty.
        constraints: the limits.
    """
    comparable = [point for point in points if math.isfinite(_violation(point, constraints))]
    if not comparable:
        absent = [
            each.key for each in constraints if points and math.isinf(each.violation(points[0]))
        ]
        return f": no point has every figure asked for{f', such as {absent[0]}' if absent else ''}"
    least = min(comparable, key=lambda point: _violation(point, constraints))
    return f"; nearest is {_words(least, [constraint.key for constraint in constraints])}"


def _words(point: Measured, keys: Sequence[str]) -> str:
    # A constraint may name PSNR or the cost again: each figure is listed once.
    parts = []
    for key in dict.fromkeys(keys):
        figure = point.figures[key]
        parts.append(f"{key} {with_unit(str(figure), figure.unit)} ({figure.mode})")
    return f"{point.name}: {', '.join(parts)}"


def board_rows(
    points: Sequence[Measured], boards: Sequence[str], recommended: Measured | None, asked: Question
) -> list[Row]:
    """Compare the best point of each board with the recommended one.

    Args:
        points: the operating points of all boards.
        boards: the names of the boards, in the order of the rows.
        recommended: the recommended point; None if no point complies with the limits.
        asked: the budget and the need.

    Returns:
        A row for each board: the figures of its best point and a comparison in words, or the reason
        why no point of the board complies.
    """
    cost = asked.cost(points)
    limits = f" keeps {' and '.join(map(str, asked.constraints))}" if asked.constraints else ""
    rows: list[Row] = []
    for board in boards:
        here = [point for point in points if point.text.get("board") == board]
        candidates = within(here, asked.constraints, cost)
        if not candidates:
            reasons = [f"no point{limits}{nearest(placed(here, cost), asked.constraints)}"]
            reasons += [
                f"{point.name} does not fit its DPU: {point.point.reason}"
                for point in points
                if point.point is not None and point.point.refused_by == board
            ]
            rows.append(Row(BOARDS, board, {}, {"point": "none", "verdict": "; ".join(reasons)}))
            continue
        best, _ = choose(candidates, asked)
        words = "within the limits"
        if recommended is not None and recommended.text.get("board") == board:
            best = recommended
            words = "this is the recommended point"
        elif recommended is not None:
            difference = asked.compare.difference(best, recommended)
            ratio = best.value(cost) / recommended.value(cost)
            quality = f"PSNR {difference} dB against" if difference.value else "the PSNR of"
            words = f"{quality} the recommended point, for {ratio:.3g} times its {cost}"
        text = {"point": best.name, "verdict": words}
        rows.append(Row(BOARDS, board, figures_to_compare(best, cost), text))
    return rows
