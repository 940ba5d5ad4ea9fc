"""Constraints, and the one recommended line."""

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Figure, measured, published, unavailable
from beers_deploy.studies.tradeoff.advice import NAMES, Constraint, Measured, parse_constraints, recommend
from tests.deploy.studies.tradeoff.made import COMPARE, family


def asked(budget: str | None = None, need: str | None = None) -> tuple[str | None, str]:
    """The name of the point to take, and the line that says so."""
    limits = [parse_constraints(f"--{name}", text) for name, text in (("budget", budget), ("need", need))]
    point, line = recommend(family(), limits[0], limits[1], COMPARE)
    return point.name if point else None, line


def having(key: str, figure: Figure) -> Measured:
    return Measured("a point", {key: figure}, {})


@pytest.mark.parametrize("name", NAMES)
def test_every_figure_can_be_limited_in_its_unit(name: str) -> None:
    key, unit = NAMES[name]
    (found,) = parse_constraints("--budget", f"{name.upper()} <= 2.5e1 {unit}")
    assert found == Constraint(key, True, 25.0, unit)


def test_several_constraints_stand_with_commas() -> None:
    first, second = parse_constraints("--budget", "latency<=20s, psnr>=44")
    assert (str(first), str(second)) == ("board latency <= 20 s", "PSNR >= 44 dB")
    assert parse_constraints("--budget", None) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "NAME<=NUMBER"),
        ("latency<20", "NAME<=NUMBER"),
        ("latency<=1e999", "NAME<=NUMBER"),
        ("speed<=3", "one of psnr"),
        ("latency<=20ms", "board latency in s"),
        ("psnr>=44,", "NAME<=NUMBER"),
    ],
)
def test_what_is_no_constraint_is_refused(text: str, words: str) -> None:
    with pytest.raises(OptionError, match=re.escape(words)):
        parse_constraints("--budget", text)


@given(st.floats(-100, 100), st.floats(0.1, 100), st.booleans())
def test_a_violation_is_0_where_the_value_keeps_the_limit(value: float, limit: float, at_most: bool) -> None:
    found = Constraint("PSNR", at_most, limit, "dB").violation(having("PSNR", measured(value, "dB", "")))
    assert (found == 0) == (value <= limit if at_most else value >= limit)


def test_no_figure_keeps_no_limit_and_a_published_one_compares_with_none() -> None:
    limit = Constraint("board latency", True, 9, "s")
    for figure in (unavailable("s", "no board"), published(1, "s", "a paper")):
        assert math.isinf(limit.violation(having("board latency", figure)))
    assert math.isinf(limit.violation(having("PSNR", measured(1, "dB", ""))))


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
def test_the_best_within_a_budget_is_taken_and_the_cheapest_for_a_need(
    budget: str | None, need: str | None, name: str
) -> None:
    assert asked(budget, need)[0] == name


def test_what_is_not_significantly_better_is_not_paid_for() -> None:
    name, line = asked("latency<=60s")
    assert name == "medium"
    assert "; large has 0.003 [" in line
    assert "dB more, not significant" in line


def test_the_line_has_value_interval_and_mode_and_says_what_only_the_value_keeps() -> None:
    line = asked("latency<=20s")[1]
    assert line.startswith("recommended for board latency <= 20 s: medium: PSNR 45.5 [42.5, 48.5] dB (measured), ")
    assert "board latency 4 [2.5, 6.4] s (predicted)" in line
    assert "not over" not in line
    assert "board latency <= 5 s holds by value, not over the whole interval" in asked("latency<=5s")[1]


def test_where_nothing_keeps_the_limits_the_nearest_is_named() -> None:
    name, line = asked("latency<=0.1s")
    assert name is None
    assert line.startswith("nothing to recommend for board latency <= 0.1 s; nearest is tiny: board latency 0.6")
    assert "no point has every figure" in asked("map50>=50")[1]
