"""Tests of the Pareto front, the comparisons of points, constraints, and the recommended line."""

import math
import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Figure, measured, predicted, published, unavailable
from beers_deploy.studies.tradeoff.advice import (
    BETTER_LARGER,
    NAMES,
    Constraint,
    parse_constraints,
    recommend,
)
from beers_deploy.studies.tradeoff.front import (
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
from tests.deploy.studies.tradeoff.synthetic import COMPARE, DPU, family, question, synthetic

COST = "board latency"
PLACES = st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9)), min_size=1, max_size=12)


def at(number: int, cost: float, quality: float) -> Measured:
    figures = {COST: predicted(cost, "s", (cost, cost), ""), "PSNR": measured(quality, "dB", "")}
    return Measured(str(number), figures, {})


@given(PLACES)
def test_no_point_beats_a_member_and_a_member_is_as_good_as_each_point(
    places: list[tuple[int, int]],
) -> None:
    points = [at(number, *place) for number, place in enumerate(places)]
    front = pareto_front(points, COST)
    place_of = {point.name: place for point, place in zip(points, places, strict=True)}
    members = [place_of[point.name] for point in front]
    assert members == sorted(members)
    for cost, quality in members:
        assert not any(c <= cost and q >= quality and (c, q) != (cost, quality) for c, q in places)
    for cost, quality in places:
        assert any(c <= cost and q >= quality for c, q in members)


def test_points_without_a_figure_or_published_are_not_on_the_front() -> None:
    paper = Measured("paper", {COST: published(1, "s", ""), "PSNR": measured(99, "dB", "")}, {})
    lacking = Measured(
        "float", {COST: unavailable("s", "no board"), "PSNR": measured(99, "dB", "")}, {}
    )
    front = pareto_front([paper, lacking, at(1, 2, 3)], COST)
    assert [point.name for point in front] == ["1"]


def test_differences_are_paired_and_reach_less_far_than_the_sites_differ() -> None:
    small = synthetic("small", 45.0, 2.0)
    medium = synthetic("medium", 45.5, 4.0)
    difference = COMPARE.difference(medium, small)
    assert difference.interval is not None
    assert difference.value == pytest.approx(0.5)
    assert 0.4 < difference.interval[0] < 0.5 < difference.interval[1] < 0.6
    assert verdict(difference) == SIGNIFICANT
    assert significant(difference)
    assert not significant(COMPARE.difference(small, medium))


def test_equal_scores_do_not_differ_however_few_the_sites_are() -> None:
    one = synthetic("one", 45.0, 2.0)
    other = replace(synthetic("one", 45.0, 2.0), name="other")
    difference = Comparison(("a",) * 6, 0).difference(one, other)
    assert (difference.value, difference.interval) == (0.0, (0.0, 0.0))


def test_below_five_sites_values_decide_beyond_a_margin() -> None:
    few = Comparison(("a", "a", "b", "b", "c", "c"), 0)
    base = synthetic("one", 45.0, 2.0)
    better = synthetic("better", 45.2, 3.0)
    alike = synthetic("alike", 45.02, 3.0)
    difference = few.difference(better, base)
    assert difference.interval is None
    assert verdict(difference) == TOO_FEW
    assert significant(difference)
    assert not significant(few.difference(alike, base))


def test_a_ratio_of_latencies_on_a_board_has_the_width_of_pairs() -> None:
    cost = {**DPU.target.tables["cost"], "pair_width": Constant(0.2, "inferred", "a test")}
    target = replace(DPU.target, tables={**DPU.target.tables, "cost": cost})
    dpu = replace(DPU, target=target)
    points = [synthetic("small", 45.0, 2.0), synthetic("large", 45.5, 6.0)]
    cheap, costly = (
        replace(item, point=replace(item.point, board=target, dpu=dpu) if item.point else None)
        for item in points
    )
    ratio = cost_ratio(costly, cheap, COST)
    assert ratio.value == pytest.approx(3)
    assert ratio.interval == pytest.approx((3 / math.exp(0.2), 3 * math.exp(0.2)))
    # Points that differ in the halo alone differ by their number of tiles, which is exact.
    one, other = (synthetic(name, 45.0, 2.0, method="net") for name in ("one", "other"))
    assert cost_ratio(other, one, COST).interval == (1, 1)
    assert cost_ratio(other, one, "host p50").mode == "measured"


def test_front_rows_compare_each_member_with_the_next_cheaper_one() -> None:
    front = pareto_front(family(), COST)
    rows = front_rows(front, COST, COMPARE)
    assert [row.name for row in rows] == ["1. tiny", "2. small", "3. medium", "4. large"]
    verdicts = [row.text["gain over the next cheaper"] for row in rows]
    assert verdicts == ["cheapest", SIGNIFICANT, SIGNIFICANT, NOT_SIGNIFICANT]
    assert rows[2].figures["PSNR gain"].value == pytest.approx(0.5)
    assert rows[2].figures["board latency ratio"].value == pytest.approx(2)


def recommendation(budget: str | None = None, need: str | None = None) -> tuple[str | None, str]:
    """Return the name of the recommended point, and the line that recommends it."""
    point, line = recommend(family(), question(budget, need))
    return point.name if point else None, line


def having(key: str, figure: Figure) -> Measured:
    return Measured("a point", {key: figure}, {})


@pytest.mark.parametrize("name", NAMES)
def test_every_figure_can_be_limited_in_its_unit(name: str) -> None:
    key, unit = NAMES[name]
    sign = ">=" if name in BETTER_LARGER else "<="
    first, second = parse_constraints("budget", f"{name.upper()} {sign} 2.5e1 {unit},psnr>=44")
    assert first == Constraint(key, sign == "<=", 25.0, unit)
    assert str(second) == "PSNR >= 44 dB"
    assert math.isinf(first.violation(having(key, published(1, unit, "a paper"))))
    assert math.isinf(first.violation(having(key, unavailable(unit, "no board"))))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("latency<=1e999", "NAME<=NUMBER"),
        ("speed<=3", "one of psnr"),
        ("latency<=20ms", "in s, but its unit is 'ms'. Convert the number"),
        ("power>=20W", "Write power<=20W."),
        ("psnr<=40", "Write psnr>=40."),
        ("psnr>=44,", "NAME<=NUMBER"),
        ("latency<=-5s", "above 0, but it is board latency <= -5 s"),
        ("host<=0", "above 0, but it is host p50 <= 0 s/Mpx"),
    ],
)
def test_an_invalid_constraint_is_refused(text: str, words: str) -> None:
    with pytest.raises(OptionError, match=f"`budget` .*{re.escape(words)}"):
        parse_constraints("budget", text)


@given(st.floats(-100, 100), st.floats(0.1, 100), st.booleans())
def test_a_violation_is_0_where_the_value_meets_the_limit(
    value: float, limit: float, at_most: bool
) -> None:
    violation = Constraint("PSNR", at_most, limit, "dB").violation(
        having("PSNR", measured(value, "dB", ""))
    )
    assert (violation == 0) == (value <= limit if at_most else value >= limit)


@pytest.mark.parametrize(
    ("budget", "need", "name"),
    [
        ("latency<=3s", None, "small"),
        ("latency<=3s,energy<=20J", None, "tiny"),
        (None, "psnr>=44.4", "small"),
        ("latency<=60s", "psnr>=45.4", "medium"),
        (None, None, "medium"),
    ],
)
def test_the_best_within_a_budget_is_recommended_and_the_cheapest_for_a_need(
    budget: str | None, need: str | None, name: str
) -> None:
    assert recommendation(budget, need)[0] == name


def test_the_line_has_value_interval_and_mode_and_names_limits_that_only_the_value_meets() -> None:
    line = recommendation("latency<=20s")[1]
    assert line.startswith(
        "recommended for board latency <= 20 s: medium: PSNR 45.5 [42.5, 48.5] dB (measured), "
    )
    assert "board latency 4 [2.5, 6.4] s (predicted)" in line
    assert "not over" not in line
    assert "<= 5 s holds by value, not over the" in recommendation("latency<=5s")[1]
    assert "large has 0.003 [" in recommendation("latency<=60s")[1]


def test_if_no_point_meets_the_limits_the_nearest_is_named() -> None:
    name, line = recommendation("latency<=0.1s")
    assert name is None
    assert line.startswith(
        "nothing to recommend for board latency <= 0.1 s; nearest is tiny: board latency 0.6"
    )
    assert "no point has every figure" in recommendation("lpips<=0.1")[1]
