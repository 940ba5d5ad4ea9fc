"""Fronts: points that nothing beats, by their values and beyond their intervals.

By its values, a point is on the front when no other costs as little and is as good, and better in one of the two.
Values have intervals, so a point off the front is *beaten* only by one that is surely no worse in both and surely
better in one: the interval of the difference says so, not the two intervals. What lies between is not told apart.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

Interval = tuple[float, float]


@dataclass(frozen=True)
class Place:
    """A point in one plane: what it costs, and how good it is (higher is better)."""

    name: str
    cost: float
    quality: float


class Judge(Protocol):
    """Tells points apart, each with the interval of the difference."""

    def ratio(self, a: str, b: str) -> Interval:
        """Cost of `a` over cost of `b`."""
        ...

    def gain(self, a: str, b: str) -> Interval:
        """Quality of `a` less quality of `b`."""
        ...


def front(places: Sequence[Place]) -> tuple[str, ...]:
    """Names on the front by values, from cheap to dear; of points that are alike the first."""
    members, best = [], float("-inf")
    for place in sorted(places, key=lambda p: (p.cost, -p.quality)):
        if place.quality > best:
            members.append(place.name)
            best = place.quality
    return tuple(members)


def dominates(a: Place, b: Place, judge: Judge) -> bool:
    """Whether `a` is surely no worse than `b` in both, and surely better in one."""
    worse = a.cost > b.cost or a.quality < b.quality
    if worse or (a.cost, a.quality) == (b.cost, b.quality):
        return False
    most, least = judge.ratio(a.name, b.name)[1], judge.gain(a.name, b.name)[0]
    return most <= 1 and least >= 0 and (most < 1 or least > 0)


def beaten(places: Sequence[Place], judge: Judge) -> Mapping[str, str]:
    """Every point that another dominates, with the best of those that do."""
    found = {}
    for b in places:
        above = [a for a in places if a.name != b.name and dominates(a, b, judge)]
        if above:
            found[b.name] = max(above, key=lambda a: (a.quality, -a.cost)).name
    return found
