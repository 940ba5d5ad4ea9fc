"""Compare operating points: the front of quality against cost, and paired differences.

Points of all boards are compared in one list, and ties are broken by the points' own figures and
names. The order in which boards are named therefore has no effect.

Two points are compared on the same images, by the bootstrap interval over whole sites of the mean
difference of their scores. Their own intervals reflect the differences between images, which are
common to both points.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from beers_deploy.model.metrics.statistics import site_interval
from beers_deploy.network import Network
from beers_deploy.performance.swath import interval_ends
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Figure, Row, measured, predicted
from beers_deploy.studies.tradeoff.measure import Scores
from beers_deploy.studies.tradeoff.points import Point

LATENCY = "board latency"
COSTS = (LATENCY, "board energy", "host p50")
PSNR = "PSNR"
FRONT = "front of PSNR against"
BOARDS = "boards"
"""The beginning of the names of the tables."""
ALIKE_DB = 0.05
"""If there are too few sites for an interval, a difference of PSNR within this counts as none."""
SIGNIFICANT = "significant"
NOT_SIGNIFICANT = "not significant"
TOO_FEW = "too few sites to tell"


@dataclass(frozen=True, eq=False)
class Measured:
    """An operating point (a method on a device, with its tiles) or a published run, with all its
    figures.

    Attributes:
        name: the name of the point, or of a published run as it is printed.
        figures: quality and costs by name; unavailable ones have a reason.
        text: facts in words by name, such as board, tile and halo.
        point: the operating point; None for a published run.
        images: the scores of each image, in the order of the pairs; empty for a published run.
    """

    name: str
    figures: dict[str, Figure]
    text: Mapping[str, str]
    point: Point | None = None
    images: Sequence[Scores] = field(default=(), repr=False)

    def value(self, key: str) -> float:
        """Return the value of the figure named `key`, or NaN if the point lacks the figure or it is
        published: a published figure was measured on other images.
        """
        figure = self.figures.get(key)
        if figure is None or figure.value is None or figure.mode == "published":
            return math.nan
        return figure.value

    @property
    def network(self) -> Network:
        """The network that restores at this point.

        Raises:
            OptionError: the point is a published run or a method without a network.
        """
        if self.point is None or self.point.variant.network is None:
            raise OptionError(f"The point {self.name} has no network. Choose a point of a network.")
        return self.point.variant.network


def placed(points: Iterable[Measured], cost: str) -> list[Measured]:
    """Return the points that have both a cost and a PSNR to compare, sorted by increasing cost.

    Points of the same cost are sorted by descending PSNR, then by latency and name, so that the
    result does not depend on the order of `points`.

    Args:
        points: the operating points and published runs.
        cost: the name of the cost.
    """

    def rank(point: Measured) -> tuple[float, float, float, str]:
        latency_s = point.value(LATENCY)
        last = math.inf if math.isnan(latency_s) else latency_s
        return point.value(cost), -point.value(PSNR), last, point.name

    comparable = [
        point for point in points if not math.isnan(point.value(cost) + point.value(PSNR))
    ]
    return sorted(comparable, key=rank)


def pareto_front(points: Sequence[Measured], cost: str) -> list[Measured]:
    """Return the points for which no other is both cheaper and better in PSNR, sorted by increasing
    cost. Values are compared, not their intervals.
    """
    front: list[Measured] = []
    for point in placed(points, cost):
        if not front or point.value(PSNR) > front[-1].value(PSNR):
            front.append(point)
    return front


@dataclass(frozen=True)
class Comparison:
    """Compares the quality of two operating points on the same images.

    Attributes:
        sites: the site of each image; images of one site resemble one another.
        seed: the seed of the bootstrap over sites, which gives the interval.
    """

    sites: Sequence[str]
    seed: int

    def difference(self, a: Measured, b: Measured) -> Figure:
        """Return the mean PSNR of `a` minus that of `b` in dB, with the interval of the paired
        difference. For fewer than five sites there is no interval, unless the PSNR of both is equal
        on every image.
        """
        # Differences on the same images: how the images differ from one another drops out.
        pairs = zip(a.images, b.images, strict=True)
        differences = [(x[PSNR] or 0.0) - (y[PSNR] or 0.0) for x, y in pairs]
        # Identical images need no bootstrap, however few the sites are.
        if not any(differences):
            return measured(0.0, "dB", "the same pictures", (0.0, 0.0))
        interval, words = site_interval(differences, self.sites, np.random.default_rng(self.seed))
        source = f"PSNR less that of {b.name} on the same images, {words}"
        return measured(a.value(PSNR) - b.value(PSNR), "dB", source, interval)


def significant(difference: Figure) -> bool:
    """Return True if a difference of PSNR shows that the first point is better: its whole interval
    is above 0, or, without an interval, its value exceeds ALIKE_DB.
    """
    if difference.interval is None:
        return (difference.value or 0.0) > ALIKE_DB
    return difference.interval[0] > 0


def verdict(difference: Figure) -> str:
    """Return the significance of a difference of PSNR in words: `SIGNIFICANT`, `NOT_SIGNIFICANT` if
    the interval contains 0, or `TOO_FEW` if there is no interval.
    """
    if difference.interval is None:
        return TOO_FEW
    low, high = difference.interval
    return NOT_SIGNIFICANT if low <= 0 <= high else SIGNIFICANT


def cost_ratio(a: Measured, b: Measured, cost: str) -> Figure:
    """Return the cost of point `a` divided by that of point `b`, with an interval.

    Two predictions for one board share most of their error. The interval of a ratio of latencies is
    therefore the board's `pair_width`, and empty if only the number of tiles differs. Predictions
    for two boards share no error.

    Args:
        a: an operating point.
        b: another operating point.
        cost: the name of the cost. Times on this machine have a ratio without an interval.
    """
    value = a.value(cost) / b.value(cost)
    source = f"{cost} over that of {b.name}"
    if cost.startswith("host"):
        return measured(value, "x", f"{source}, medians of interleaved runs")
    a_low, a_high = interval_ends(a.figures[cost])
    b_low, b_high = interval_ends(b.figures[cost])
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


def front_rows(front: Sequence[Measured], cost: str, compare: Comparison) -> list[Row]:
    """Return the rows of the front of quality against cost, numbered from the cheapest point.

    Args:
        front: the points for which no other is both cheaper and better, sorted by increasing cost.
        cost: the name of the cost.
        compare: compares the PSNR of two points on the same images.

    Returns:
        A row for each point: its figures, the gain in PSNR over the next cheaper point, and the
        ratio of their costs.
    """
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
    """Return the figures of a point that tables of comparison show, by name: PSNR, the cost, and
    the board's power and energy, as far as the point has them.
    """
    keys = dict.fromkeys((PSNR, cost, "board power", "board energy"))
    return {key: point.figures[key] for key in keys if key in point.figures}
