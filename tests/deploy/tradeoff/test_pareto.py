"""Fronts against brute force, and dominance beyond intervals."""

from dataclasses import dataclass
from itertools import combinations

from hypothesis import given
from hypothesis import strategies as st

from deploy.tradeoff.outcome import Interval, Place, dominated, dominates, front

NUMBERS = st.integers(-3, 3).map(float)  # few values: many ties
PLACES = st.lists(st.tuples(NUMBERS, NUMBERS), max_size=12).map(
    lambda pairs: [Place(f"p{n}", 2.0**cost, quality) for n, (cost, quality) in enumerate(pairs)]
)


@dataclass(frozen=True)
class Spread:
    """A judge whose intervals reach so far to either side of the values."""

    places: list[Place]
    cost: float = 1.0
    quality: float = 0.0

    def ratio(self, a: str, b: str) -> Interval:
        value = self._named(a).cost / self._named(b).cost
        return value / self.cost, value * self.cost

    def gain(self, a: str, b: str) -> Interval:
        value = self._named(a).quality - self._named(b).quality
        return value - self.quality, value + self.quality

    def _named(self, name: str) -> Place:
        return next(place for place in self.places if place.name == name)


def better(a: Place, b: Place) -> bool:
    return a.cost <= b.cost and a.quality >= b.quality and (a.cost, a.quality) != (b.cost, b.quality)


@given(PLACES)
def test_a_front_holds_just_what_no_other_dominates(places: list[Place]) -> None:
    undominated = {(b.cost, b.quality) for b in places if not any(better(a, b) for a in places)}
    members = [next(p for p in places if p.name == name) for name in front(places)]
    assert {(m.cost, m.quality) for m in members} == undominated
    assert len(members) == len(undominated)
    assert [m.cost for m in members] == sorted(m.cost for m in members)
    assert [m.quality for m in members] == sorted(m.quality for m in members)


@given(PLACES)
def test_without_intervals_dominated_is_all_that_is_not_as_good_as_the_front(places: list[Place]) -> None:
    judge = Spread(places)
    on_front = {(p.cost, p.quality) for p in places if p.name in front(places)}
    found = dominated(places, judge)
    assert set(found) == {p.name for p in places if (p.cost, p.quality) not in on_front}


@given(PLACES, st.floats(1, 4), st.floats(0, 3))
def test_intervals_only_ever_spare_points(places: list[Place], cost: float, quality: float) -> None:
    judge = Spread(places, cost, quality)
    found = dominated(places, judge)
    assert set(found) <= set(dominated(places, Spread(places)))
    assert not set(found) & set(front(places))
    for name, by in found.items():
        a, b = (next(p for p in places if p.name == each) for each in (by, name))
        assert better(a, b)
        assert judge.ratio(by, name)[1] <= 1
        assert judge.gain(by, name)[0] >= 0


@given(PLACES, st.floats(1, 4), st.floats(0, 3))
def test_no_two_points_dominate_each_other(places: list[Place], cost: float, quality: float) -> None:
    judge = Spread(places, cost, quality)
    for a, b in combinations(places, 2):
        assert not (dominates(a, b, judge) and dominates(b, a, judge))
    assert not any(dominates(a, a, judge) for a in places)


def test_a_point_cheaper_for_sure_and_alike_dominates_and_one_that_may_be_dearer_does_not() -> None:
    places = [Place("cheap", 1.0, 45.0), Place("dear", 1.2, 45.0)]
    assert dominated(places, Spread(places, cost=1.1)) == {"dear": "cheap"}
    assert not dominated(places, Spread(places, cost=1.3))
    assert not dominated(places, Spread(places, cost=1.1, quality=0.01))


def test_the_best_of_those_that_dominate_is_named() -> None:
    places = [Place("fast", 1.0, 2.0), Place("good", 2.0, 3.0), Place("poor", 4.0, 1.0)]
    assert dominated(places, Spread(places))["poor"] == "good"


def test_no_points_have_no_front() -> None:
    assert front([]) == ()
    assert not dominated([], Spread([]))
