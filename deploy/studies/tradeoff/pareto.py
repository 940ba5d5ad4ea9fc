"""The Pareto front of quality against cost, and whether one point is better than another.

Two points are compared on the same images: by the bootstrap interval, over whole sites, of the mean difference of
their scores. Their own intervals show how images differ, which the points share.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from beers_deploy.model.metrics.bootstrap import site_interval
from beers_deploy.network import Network
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Figure, Row, measured, predicted
from beers_deploy.studies.tradeoff.measure import Scores
from beers_deploy.studies.tradeoff.points import Point

Interval = tuple[float, float]

COSTS = ("board latency", "board energy", "host p50")
PSNR = "PSNR"

ALIKE_DB = 0.05
"""Where the sites are too few for an interval, PSNR within this is not told apart."""

SIGNIFICANT, NOT_SIGNIFICANT, TOO_FEW = "significant", "not significant", "too few sites to tell"


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
    figures: Mapping[str, Figure]
    text: Mapping[str, str]
    point: Point | None = None
    images: Sequence[Scores] = field(default=(), repr=False)

    def value(self, key: str) -> float | None:
        """A figure's value where it can be compared: a published one was found on other images."""
        figure = self.figures.get(key)
        return figure.value if figure is not None and figure.mode != "published" else None

    def cost(self, key: str) -> float:
        """The value of a cost; endless where it has none."""
        value = self.value(key)
        return math.inf if value is None else value

    @property
    def psnr_db(self) -> float:
        """The value of PSNR; less than any where there is none to compare."""
        value = self.value(PSNR)
        return -math.inf if value is None else value

    @property
    def network(self) -> Network:
        """The network that restores here."""
        if self.point is None or self.point.variant.file is None:
            remedy = "take a point of a network"
            raise OptionError("point", expected="one with a network", got=self.name, remedy=remedy)
        return Network.load(self.point.variant.file)

    @property
    def row(self) -> Row:
        """For tables."""
        return Row("points", self.name, self.figures, self.text)


def pareto_front(points: Sequence[Measured], cost: str) -> list[Measured]:
    """The points than which none is both cheaper and of better PSNR, by value, from cheap to dear."""
    front: list[Measured] = []
    for point in sorted(placed(points, cost), key=lambda p: (p.cost(cost), -p.psnr_db)):
        if not front or point.psnr_db > front[-1].psnr_db:
            front.append(point)
    return front


def placed(points: Iterable[Measured], cost: str) -> list[Measured]:
    """The points that have both a cost and a PSNR to compare."""
    return [point for point in points if None not in (point.value(cost), point.value(PSNR))]


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
        """The PSNR of `a` less that of `b`, with the interval of the paired difference; none below five sites."""
        pairs = zip(a.images, b.images, strict=True)
        differences = [(x[PSNR] or 0.0) - (y[PSNR] or 0.0) for x, y in pairs]
        if not any(differences):  # the same pictures, on however few sites
            return measured(0.0, "dB", "the same pictures", (0.0, 0.0))
        interval, words = site_interval(differences, self.sites, np.random.default_rng(self.seed))
        source = f"PSNR less that of {b.name} on the same images, {words}"
        return measured(a.psnr_db - b.psnr_db, "dB", source, interval)

    def significantly_better(self, a: Measured, b: Measured) -> bool:
        """Whether the whole interval of the difference says so; by value, beyond ALIKE_DB, where there is none."""
        found = self.difference(a, b)
        if found.interval is None:
            return (found.value or 0.0) > ALIKE_DB
        return found.interval[0] > 0

    def verdict(self, a: Measured, b: Measured) -> str:
        """Of a difference in PSNR, in words: not significant where its interval holds 0."""
        found = self.difference(a, b)
        if found.interval is None:
            return TOO_FEW
        low, high = found.interval
        return NOT_SIGNIFICANT if low <= 0 <= high else SIGNIFICANT


def cost_ratio(a: Measured, b: Measured, cost: str) -> Figure:
    """How many times the cost of `b` that `a` has on the same board, with an interval.

    Two predictions of one board share most of their error: the interval of a ratio of latencies is the board's
    `pair_width`, and nothing where only the count of tiles differs.
    """
    value, source = a.cost(cost) / b.cost(cost), f"{cost} over that of {b.name}"
    if cost.startswith("host"):
        return measured(value, "x", f"{source}, medians of interleaved runs")
    return predicted(value, "x", _ratio_interval(a, b, cost, value), source)


def _ratio_interval(a: Measured, b: Measured, cost: str, value: float) -> Interval:
    first, second = a.point, b.point
    if first and second and first.dpu and second.dpu:
        if replace(first, halo_px=second.halo_px) == second:
            return value, value
        width = first.dpu.target.tables["cost"].get("pair_width")
        if cost == "board latency" and width is not None:
            return value * math.exp(-width.low), value * math.exp(width.low)
    (a_low, a_high), (b_low, b_high) = (ends(each.figures[cost]) for each in (a, b))
    return a_low / b_high, a_high / b_low


def ends(figure: Figure) -> Interval:
    """The interval, or the value twice where it has none."""
    return figure.interval or (figure.value or 0.0, figure.value or 0.0)


def front_rows(front: Sequence[Measured], cost: str, compare: Comparison) -> list[Row]:
    """A front's members by number, each with its difference from the next cheaper one."""
    table = f"front of PSNR against {cost}"
    keys = dict.fromkeys(("PSNR", cost, *(["board energy"] if cost.startswith("board") else [])))
    rows = []
    for number, (cheaper, each) in enumerate(pairwise([None, *front]), 1):
        assert each is not None  # noqa: S101 - only the first of the pairs is None
        figures = {key: each.figures[key] for key in keys if key in each.figures}
        verdict = "cheapest"
        if cheaper is not None:
            figures["PSNR gain"] = compare.difference(each, cheaper)
            figures[f"{cost} ratio"] = cost_ratio(each, cheaper, cost)
            verdict = compare.verdict(each, cheaper)
        rows.append(Row(table, f"{number}. {each.name}", figures, {"gain over the next cheaper": verdict}))
    return rows
