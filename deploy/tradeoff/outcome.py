"""A point with all that is known of it, and points held against one another."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from deploy.results import Figure, Row
from deploy.tradeoff.accuracy import Scores
from deploy.tradeoff.board import BoardRun, energy_ratio, latency_ratio
from deploy.tradeoff.host_time import Times, ratio_interval
from deploy.tradeoff.pareto import Interval, Place
from deploy.tradeoff.points import Point
from model.metrics.bootstrap import site_interval

COSTS = ("board latency", "board energy", "host p50")
QUALITIES = {"PSNR": 1, "SSIM": 1, "LPIPS-squeeze": -1}
"""Figures of quality, and whether more (1) or less (-1) of it is better."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What was found of a point.

    Attributes:
        point: what it is.
        figures: all of them, unavailable ones with their reasons.
        text: words beside them.
        scores: image by image; None where there are none.
        board: its run on the board; None where it has none.
        host: its times here; None where there are none.
        work_factor: pixels computed for each of the swath's.
    """

    point: Point
    figures: Mapping[str, Figure]
    text: Mapping[str, str]
    scores: Scores | None = None
    board: BoardRun | None = None
    host: Times | None = None
    work_factor: float = 1.0

    @property
    def name(self) -> str:
        """What it is listed under."""
        return self.point.name

    @property
    def host_s(self) -> list[float]:
        """Its times for a megapixel here, round by round."""
        return self.host.per_megapixel(self.work_factor).tolist() if self.host else []

    @property
    def row(self) -> Row:
        """For tables and documents."""
        return Row("points", self.name, self.figures, self.text)

    def value(self, key: str) -> float | None:
        """A figure's value, where it can be compared: a published one was found elsewhere."""
        figure = self.figures[key]
        return figure.value if figure.mode != "published" else None

    def place(self, x: str, y: str) -> Place | None:
        """Where it lies in a plane; None where it lacks one of the two."""
        cost, quality = self.value(x), self.value(y)
        return None if cost is None or quality is None else Place(self.name, cost, QUALITIES[y] * quality)


@dataclass(frozen=True)
class Arena:
    """All outcomes, and the sites of the pairs that they share."""

    outcomes: Mapping[str, Outcome]
    sites: Sequence[str]
    seed: int

    def gain(self, a: str, b: str, key: str) -> Interval:
        """How much better `a` is than `b`: bootstrap over sites of the differences on the same images, 95 %.

        Endless either way where the sites are too few to tell anything apart.
        """
        first, second = (self._values(name, key) for name in (a, b))
        return _difference(first, second, tuple(self.sites), QUALITIES[key], self.seed)

    def ratio(self, a: str, b: str, key: str) -> Interval:
        """Cost of `a` over cost of `b`."""
        first, second = self.outcomes[a], self.outcomes[b]
        if key.startswith("host"):
            return self._host_ratio(first, second)
        assert first.board is not None  # noqa: S101 - only what has the figure is compared by it
        assert second.board is not None  # noqa: S101
        return (latency_ratio if key == "board latency" else energy_ratio)(first.board, second.board)

    def times(self, a: str, b: str, key: str) -> float:
        """Cost of `a` over cost of `b`, by value; on the host of the same rounds where there are such."""
        first, second = self.outcomes[a], self.outcomes[b]
        if key.startswith("host") and _together(first, second):
            ratios = [w1 / w2 for w1, w2 in zip(first.host_s, second.host_s, strict=True)]
            return float(np.median(ratios))
        return (first.value(key) or 0.0) / (second.value(key) or math.inf)

    def _host_ratio(self, a: Outcome, b: Outcome) -> Interval:
        return ratio_interval(np.asarray(a.host_s), np.asarray(b.host_s), _together(a, b), self.seed)

    def _values(self, name: str, key: str) -> tuple[float, ...]:
        scores = self.outcomes[name].scores
        return tuple(np.nan if v[key] is None else float(v[key] or 0.0) for v in scores.images) if scores else ()


@dataclass(frozen=True)
class Plane:
    """Two figures of an arena: what `pareto` asks."""

    arena: Arena
    x: str
    y: str

    def ratio(self, a: str, b: str) -> Interval:
        """Cost of `a` over cost of `b`."""
        return self.arena.ratio(a, b, self.x)

    def gain(self, a: str, b: str) -> Interval:
        """Quality of `a` less quality of `b`."""
        return self.arena.gain(a, b, self.y)


def _together(a: Outcome, b: Outcome) -> bool:
    """Whether both were timed in the same rounds."""
    return a.host is not None and b.host is not None and a.host.session == b.host.session


@cache
def _difference(
    first: tuple[float, ...], second: tuple[float, ...], sites: tuple[str, ...], sign: int, seed: int
) -> Interval:
    differences = sign * (np.asarray(first) - np.asarray(second))
    known = np.isfinite(differences)
    if known.any() and not differences[known].any():  # the same pictures, on however many sites
        return 0.0, 0.0
    places = np.asarray(sites)[known].tolist()
    interval, _ = site_interval(differences[known].tolist(), places, np.random.default_rng(seed))
    return interval or (-np.inf, np.inf)
