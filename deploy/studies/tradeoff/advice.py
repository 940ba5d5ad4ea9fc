"""Choose a point: the front of quality against cost, limits such as `latency<=20s`, and one
recommended line.

Points of all boards are compared in one list, and ties are broken by the points' own figures and
names. So the order in which boards were named changes nothing.

Two points are compared on the same images: by the bootstrap interval, over whole sites, of the mean
difference of their scores. Their own intervals show how images differ, which the points share.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from beers_deploy.model.metrics.bootstrap import site_interval
from beers_deploy.network import Network
from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.figures import Figure, Row, measured, number, predicted
from beers_deploy.studies.tradeoff.measure import Scores
from beers_deploy.studies.tradeoff.points import UNITS, Point

LATENCY = "board latency"
COSTS = (LATENCY, "board energy", "host p50")
PSNR = "PSNR"
FRONT = "front of PSNR against"
BOARDS = "boards"
"""What the names of the tables begin with."""
NAMES: dict[str, tuple[str, str]] = {
    "psnr": (PSNR, "dB"),
    "ssim": ("SSIM", "ratio"),
    "lpips": ("LPIPS-squeeze", "distance"),
    "host": ("host p50", "s/Mpx"),
    "host-p90": ("host p90", "s/Mpx"),
    **{key.removeprefix("board "): (key, unit) for key, unit in UNITS.items()},
}
"""What a user writes: the figure that it stands for, and its unit."""
BARE_UNITS = ("ratio", "distance")
"""Units that are not written behind a number."""

ALIKE_DB = 0.05
"""Where the sites are too few for an interval, PSNR within this is not told apart."""
WORTH_A_WORD_DB = 0.002
"""Gains below it that are not significant are not mentioned."""

SIGNIFICANT = "significant"
NOT_SIGNIFICANT = "not significant"
TOO_FEW = "too few sites to tell"


@dataclass(frozen=True, eq=False)
class Measured:
    """A point with all its figures.

    Attributes:
        name: of the point; of a published run, as it is printed.
        figures: by name; unavailable ones with the reason.
        text: words beside them.
        point: None of a published run.
        images: scores of each image, in the order of the pairs; empty where there are none.
    """

    name: str
    figures: dict[str, Figure]
    text: Mapping[str, str]
    point: Point | None = None
    images: Sequence[Scores] = field(default=(), repr=False)

    def value(self, key: str) -> float:
        """A figure's value; NaN where there is none to compare: a published one was found on other
        images.
        """
        figure = self.figures.get(key)
        if figure is None or figure.value is None or figure.mode == "published":
            return math.nan
        return figure.value

    @property
    def network(self) -> Network:
        """The network that restores here."""
        if self.point is None or self.point.variant.network is None:
            raise OptionError(f"The point {self.name} has no network. Choose a point of a network.")
        return self.point.variant.network


def placed(points: Iterable[Measured], cost: str) -> list[Measured]:
    """Return the points that have both a cost and a PSNR to compare, sorted by increasing cost."""
    comparable = (
        point for point in points if not math.isnan(point.value(cost) + point.value(PSNR))
    )
    return sorted(comparable, key=lambda point: _rank(point, cost))


def _rank(point: Measured, cost: str) -> tuple[float, float, float, str]:
    """Return the sort key of a point: its cost, then what breaks ties without regard to the order
    of the points.
    """
    latency_s = point.value(LATENCY)
    return (
        point.value(cost),
        -point.value(PSNR),
        math.inf if math.isnan(latency_s) else latency_s,
        point.name,
    )


def pareto_front(points: Sequence[Measured], cost: str) -> list[Measured]:
    """Return the Pareto-optimal points by value, sorted by increasing cost."""
    front: list[Measured] = []
    for point in placed(points, cost):
        if not front or point.value(PSNR) > front[-1].value(PSNR):
            front.append(point)
    return front


@dataclass(frozen=True)
class Comparison:
    """Compares points by their scores on the same images.

    Attributes:
        sites: of the images, in their order.
        seed: of the bootstrap.
    """

    sites: Sequence[str]
    seed: int

    def difference(self, a: Measured, b: Measured) -> Figure:
        """The PSNR of `a` less that of `b`, with the interval of the paired difference; none below
        five sites.
        """
        # Differences on the same images: how the images differ from one another drops out.
        pairs = zip(a.images, b.images, strict=True)
        differences = [(x[PSNR] or 0.0) - (y[PSNR] or 0.0) for x, y in pairs]
        # The same pictures are equal on however few sites: no bootstrap is needed to tell.
        if not any(differences):
            return measured(0.0, "dB", "the same pictures", (0.0, 0.0))
        interval, words = site_interval(differences, self.sites, np.random.default_rng(self.seed))
        source = f"PSNR less that of {b.name} on the same images, {words}"
        return measured(a.value(PSNR) - b.value(PSNR), "dB", source, interval)


def significant(difference: Figure) -> bool:
    """Whether the whole interval is above 0; by value, beyond ALIKE_DB, where there is none."""
    if difference.interval is None:
        return (difference.value or 0.0) > ALIKE_DB
    return difference.interval[0] > 0


def verdict(difference: Figure) -> str:
    """In words: not significant where the interval holds 0."""
    if difference.interval is None:
        return TOO_FEW
    low, high = difference.interval
    return NOT_SIGNIFICANT if low <= 0 <= high else SIGNIFICANT


def cost_ratio(a: Measured, b: Measured, cost: str) -> Figure:
    """Return the cost of `a` divided by that of `b`, with an interval.

    Two predictions of one board share most of their error: the interval of a ratio of latencies is
    the board's `pair_width`, and nothing where only the count of tiles differs. Predictions of two
    boards share none of it.
    """
    value = a.value(cost) / b.value(cost)
    source = f"{cost} over that of {b.name}"
    if cost.startswith("host"):
        return measured(value, "x", f"{source}, medians of interleaved runs")
    a_low, a_high = ends(a.figures[cost])
    b_low, b_high = ends(b.figures[cost])
    interval = (a_low / b_high, a_high / b_low)
    first = a.point
    second = b.point
    if first and second and first.dpu and second.dpu:
        width = first.dpu.target.tables["cost"].get("pair_width")
        # Points that differ in the halo alone differ in the count of tiles, which is no estimate.
        if replace(first, halo_px=second.halo_px) == second:
            interval = value, value
        # Two predictions of one board share most of their error.
        elif cost == LATENCY and width is not None and first.board == second.board:
            interval = value * math.exp(-width.low), value * math.exp(width.low)
    return predicted(value, "x", interval, source)


def ends(figure: Figure) -> tuple[float, float]:
    """The interval, or the value twice where it has none."""
    return figure.interval or (figure.value or 0.0, figure.value or 0.0)


def front_rows(front: Sequence[Measured], cost: str, compare: Comparison) -> list[Row]:
    """Return a front's members by number, each with its difference from the next cheaper one."""
    rows: list[Row] = []
    for place, point in enumerate(front, 1):
        figures = figures_to_compare(point, cost)
        word = "cheapest"
        if rows:
            cheaper = front[place - 2]
            gain = compare.difference(point, cheaper)
            figures |= {"PSNR gain": gain, f"{cost} ratio": cost_ratio(point, cheaper, cost)}
            word = verdict(gain)
        text = {"gain over the next cheaper": word}
        rows.append(Row(f"{FRONT} {cost}", f"{place}. {point.name}", figures, text))
    return rows


def figures_to_compare(point: Measured, cost: str) -> dict[str, Figure]:
    """Return the figures by which points are compared: PSNR, the cost, and power and energy of a
    board.
    """
    keys = dict.fromkeys((PSNR, cost, "board power", "board energy"))
    return {key: point.figures[key] for key in keys if key in point.figures}


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
        return f"{self.key} {'<=' if self.at_most else '>='} {self.limit:g}{self._unit}"

    def in_words(self, value: float) -> str:
        """Return a value of the figure with its unit, with as many digits as tell it apart from the
        limit.
        """
        digits = next(
            (count for count in range(3, 9) if float(f"{value:.{count}g}") != self.limit), 9
        )
        return f"{number(value, digits)}{self._unit}"

    @property
    def _unit(self) -> str:
        return "" if self.unit in BARE_UNITS else f" {self.unit}"

    def violation(self, point: Measured) -> float:
        """By what share of the limit a point misses it: 0 where it keeps it, endless without such a
        figure.
        """
        over = point.value(self.key) - self.limit
        miss = over if self.at_most else -over
        # A limit of 0 has no share: there the miss itself counts.
        return math.inf if math.isnan(miss) else max(miss, 0.0) / (abs(self.limit) or 1.0)

    def holds_throughout(self, figure: Figure) -> bool:
        """Whether the figure's whole interval keeps it."""
        low, high = ends(figure)
        return high <= self.limit if self.at_most else low >= self.limit


def parse_constraints(option: str, text: str | None) -> list[Constraint]:
    """Read constraints with commas between: `latency<=20s, psnr>=44`."""
    return [_parse(option, part.strip()) for part in text.split(",")] if text is not None else []


def _parse(option: str, text: str) -> Constraint:
    fields = CONSTRAINT.fullmatch(text.lower())
    if fields is None or not math.isfinite(float(fields["limit"])):
        raise OptionError(
            f"`{option}` must be NAME<=NUMBER or NAME>=NUMBER, such as 'latency<=20s' or "
            f"'psnr>=44', but it is {printable(repr(text))}."
        )
    if fields["name"] not in NAMES:
        raise OptionError(
            f"`{option}` must name one of {', '.join(NAMES)}, but it names "
            f"{printable(repr(fields['name']))}."
        )
    key, unit = NAMES[fields["name"]]
    if fields["unit"] not in ("", unit.lower()):
        raise OptionError(
            f"`{option}` must give {key} in {unit}, but its unit is "
            f"{printable(repr(fields['unit']))}. Write "
            f"{fields['name']}{fields['side']}{fields['limit']}{unit}."
        )
    return Constraint(key, fields["side"] == "<=", float(fields["limit"]), unit)


def chosen_cost(points: Sequence[Measured], budget: Sequence[Constraint]) -> str:
    """The cost that the budget names; else the first that any point has, the board's latency before
    all.
    """
    in_budget = (constraint.key for constraint in budget if constraint.key in COSTS)
    available = (key for key in COSTS if any(not math.isnan(point.value(key)) for point in points))
    return next(in_budget, next(available, COSTS[0]))


def recommend(
    points: Sequence[Measured],
    budget: Sequence[Constraint],
    need: Sequence[Constraint],
    compare: Comparison,
) -> tuple[Measured | None, str]:
    """Recommend the best PSNR within a budget, or the cheapest point that is not significantly
    worse.

    For a need without a budget, the cheapest point is recommended.

    Args:
        points: of all boards that are compared.
        budget: what can be afforded.
        need: what must be reached.
        compare: tells which point is better.

    Returns:
        The recommended point, None where none keeps the constraints; and a line that says so.
    """
    constraints = [*budget, *need]
    cost = chosen_cost(points, budget)
    candidates = within(points, constraints, cost)
    limits = f" for {' and '.join(map(str, constraints))}" if constraints else ""
    if not candidates:
        return None, f"nothing to recommend{limits}{nearest(placed(points, cost), constraints)}"
    choice, best = choose(candidates, compare, cheapest=bool(need) and not budget)
    keys = [PSNR, cost, *(constraint.key for constraint in constraints)]
    line = f"recommended{limits}: {_words(choice, keys)}"
    gain = compare.difference(best, choice)
    if (budget or not need) and best is not choice and (gain.value or 0.0) >= WORTH_A_WORD_DB:
        line += f"; {best.name} has {gain} dB more, {verdict(gain)}"
    unsure = [
        str(constraint)
        for constraint in constraints
        if not constraint.holds_throughout(choice.figures[constraint.key])
    ]
    if unsure:
        verb = "holds" if len(unsure) == 1 else "hold"
        line += f"; {' and '.join(unsure)} {verb} by value, not over the whole interval"
    return choice, line


def within(
    points: Iterable[Measured], constraints: Sequence[Constraint], cost: str
) -> list[Measured]:
    """Return the points that keep every constraint by value, sorted by increasing cost."""
    return [point for point in placed(points, cost) if not _violation(point, constraints)]


def choose(
    kept: Sequence[Measured], compare: Comparison, *, cheapest: bool
) -> tuple[Measured, Measured]:
    """Choose among points that keep the constraints.

    Args:
        kept: sorted by increasing cost, at least one.
        compare: tells which point is better.
        cheapest: choose the cheapest point, however good it is.

    Returns:
        The chosen point, and the one with the best PSNR.
    """
    best = max(kept, key=lambda point: point.value(PSNR))
    if cheapest:
        return kept[0], best
    # They are sorted by cost: the first that is not significantly worse is the cheapest such.
    return next(point for point in kept if not significant(compare.difference(best, point))), best


def affordable(
    points: Sequence[Measured], constraints: Sequence[Constraint], cost: str
) -> Sequence[Measured]:
    """Return the points that keep the limits on figures other than PSNR and cost; all points if
    none does.

    The front shows PSNR against one cost. Without this, a point that the budget excludes for
    another reason, such as its power, would hide those that can be recommended.
    """
    others = [constraint for constraint in constraints if constraint.key not in (PSNR, cost)]
    return within(points, others, cost) or points


def _violation(point: Measured, constraints: Sequence[Constraint]) -> float:
    """Return the violation of the constraint that a point misses most."""
    return max((constraint.violation(point) for constraint in constraints), default=0.0)


def nearest(points: Sequence[Measured], constraints: Sequence[Constraint]) -> str:
    """Name the point that misses the constraints least, as the end of a sentence."""
    comparable = [point for point in points if math.isfinite(_violation(point, constraints))]
    if not comparable:
        return ": no point has every figure asked for"
    least = min(comparable, key=lambda point: _violation(point, constraints))
    return f"; nearest is {_words(least, [constraint.key for constraint in constraints])}"


def _words(point: Measured, keys: Sequence[str]) -> str:
    # A constraint may name PSNR or the cost again: each figure is listed once.
    figures = (f"{key} {_figure(point.figures[key])}" for key in dict.fromkeys(keys))
    return f"{point.name}: {', '.join(figures)}"


def _figure(figure: Figure) -> str:
    unit = "" if figure.unit in BARE_UNITS else f" {figure.unit}"
    return f"{figure}{unit} ({figure.mode})"
