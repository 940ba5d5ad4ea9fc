"""The front and the comparisons of points."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.figures import measured, predicted, published, unavailable
from beers_deploy.studies.tradeoff.advice import (
    NOT_SIGNIFICANT,
    SIGNIFICANT,
    TOO_FEW,
    Comparison,
    Measured,
    cost_ratio,
    front_rows,
    pareto_front,
    significant,
    verdict,
)
from tests.deploy.studies.tradeoff.made import COMPARE, DPU, family, made

COST = "board latency"
PLACES = st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9)), min_size=1, max_size=12)


def at(number: int, cost: float, quality: float) -> Measured:
    figures = {COST: predicted(cost, "s", (cost, cost), ""), "PSNR": measured(quality, "dB", "")}
    return Measured(str(number), figures, {})


@given(PLACES)
def test_no_point_beats_a_member_and_a_member_is_as_good_as_each_point(places: list[tuple[int, int]]) -> None:
    points = [at(number, *place) for number, place in enumerate(places)]
    front = pareto_front(points, COST)
    known = {point.name: place for point, place in zip(points, places, strict=True)}
    members = [known[point.name] for point in front]
    assert members == sorted(members)
    for cost, quality in members:
        assert not any(c <= cost and q >= quality and (c, q) != (cost, quality) for c, q in places)
    for cost, quality in places:
        assert any(c <= cost and q >= quality for c, q in members)


def test_what_lacks_a_figure_or_was_published_is_not_on_the_front() -> None:
    printed = Measured("paper", {COST: published(1, "s", ""), "PSNR": measured(99, "dB", "")}, {})
    lacking = Measured("float", {COST: unavailable("s", "no board"), "PSNR": measured(99, "dB", "")}, {})
    found = pareto_front([printed, lacking, at(1, 2, 3)], COST)
    assert [point.name for point in found] == ["1"]


def test_differences_are_paired_and_reach_less_far_than_the_sites_differ() -> None:
    small, medium = made("small", 45.0, 2.0), made("medium", 45.5, 4.0)
    found = COMPARE.difference(medium, small)
    assert found.interval is not None
    assert found.value == pytest.approx(0.5)
    assert 0.4 < found.interval[0] < 0.5 < found.interval[1] < 0.6
    assert verdict(found) == SIGNIFICANT
    assert significant(found)
    assert not significant(COMPARE.difference(small, medium))


def test_the_same_pictures_do_not_differ_on_however_few_sites() -> None:
    one, other = made("one", 45.0, 2.0), replace(made("one", 45.0, 2.0), name="other")
    found = Comparison(("a",) * 6, 0).difference(one, other)
    assert (found.value, found.interval) == (0.0, (0.0, 0.0))


def test_below_five_sites_values_decide_beyond_a_margin() -> None:
    few = Comparison(("a", "a", "b", "b", "c", "c"), 0)
    one, better, alike = made("one", 45.0, 2.0), made("better", 45.2, 3.0), made("alike", 45.02, 3.0)
    found = few.difference(better, one)
    assert found.interval is None
    assert verdict(found) == TOO_FEW
    assert significant(found)
    assert not significant(few.difference(alike, one))


def test_a_ratio_of_latencies_on_a_board_has_the_width_of_pairs() -> None:
    cost = {**DPU.target.tables["cost"], "pair_width": Constant(0.2, "inferred", "a test")}
    target = replace(DPU.target, tables={**DPU.target.tables, "cost": cost})
    dpu = replace(DPU, target=target)
    points = [made("small", 45.0, 2.0), made("large", 45.5, 6.0)]
    one, other = (
        replace(each, point=replace(each.point, board=target, dpu=dpu) if each.point else None) for each in points
    )
    found = cost_ratio(other, one, COST)
    assert found.value == pytest.approx(3)
    assert found.interval == pytest.approx((3 / math.exp(0.2), 3 * math.exp(0.2)))


def test_tiles_of_one_network_differ_by_their_count_alone() -> None:
    one = made("one", 45.0, 2.0, method="net")
    found = cost_ratio(made("other", 45.0, 3.0, method="net"), one, COST)
    assert found.interval == (found.value, found.value)
    apart = cost_ratio(made("third", 45.0, 3.0, tile_px=176, method="net"), one, COST)
    assert apart.interval is not None
    assert apart.interval[0] < 1.5 < apart.interval[1]


def test_a_ratio_of_host_times_is_measured() -> None:
    assert cost_ratio(made("a", 45.0, 4.0), made("b", 45.0, 2.0), "host p50").mode == "measured"


def test_front_rows_compare_each_member_with_the_next_cheaper_one() -> None:
    front = pareto_front(family(), COST)
    rows = front_rows(front, COST, COMPARE)
    assert [row.name for row in rows] == ["1. tiny", "2. small", "3. medium", "4. large"]
    verdicts = [row.text["gain over the next cheaper"] for row in rows]
    assert verdicts == ["cheapest", SIGNIFICANT, SIGNIFICANT, NOT_SIGNIFICANT]
    assert rows[2].figures["PSNR gain"].value == pytest.approx(0.5)
    assert rows[2].figures["board latency ratio"].value == pytest.approx(2)
