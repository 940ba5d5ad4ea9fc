"""Advice: which point, why, and what it would take to do better; what is said of the paper's network."""

import math
from dataclasses import replace

import pytest

from deploy.tradeoff.advice import choose
from deploy.tradeoff.outcome import Results
from deploy.tradeoff.paper import as_good, at_a_glance, findings, papers_point
from deploy.tradeoff.points import parse_demands
from deploy.tradeoff.study import fronts, gain_words
from tests.deploy.tradeoff.made_results import Made, named, results

FAMILY = {
    "tiny": Made(44.0, 4, 16),
    "small": Made(45.3, 8, 32),
    "papers": Made(45.0, 16, 64),
    "tuned": Made(46.9, 8, 32, sensor="known"),
}


@pytest.fixture(scope="module")
def family() -> Results:
    return results(FAMILY)


def latency_s(found: Results, start: str) -> float:
    return found.outcomes[named(found, start)].figures["board latency"].value or 0.0


def asked(found: Results, budget: str | None = None, need: str | None = None) -> tuple[str, str]:
    """The name of the choice and the advice."""
    choice = choose(found, parse_demands("--budget", budget), parse_demands("--need", need))
    return choice.outcome.point.variant.method if choice.outcome else "", " ".join(choice.advice)


def test_a_budget_buys_the_best_picture_and_a_need_the_least_time(family: Results) -> None:
    between = (latency_s(family, "tiny") + latency_s(family, "small")) / 2
    assert asked(family, budget=f"latency<={between}s")[0] == "tiny"
    assert asked(family, budget="latency<=1000s")[0] == "tuned"
    assert asked(family, need="psnr>=43")[0] == "tiny"
    assert asked(family, need="psnr>=44.5")[0] == "small"
    assert asked(family, budget="latency<=1000s", need="psnr>=45")[0] == "tuned"


def test_advice_says_what_doing_better_asks_for(family: Results) -> None:
    between = (latency_s(family, "tiny") + latency_s(family, "small")) / 2
    words = asked(family, budget=f"latency<={between}s")[1]
    assert "highest PSNR of the 1 points" in words
    assert "give up board latency at most" in words
    assert "small INT8 legal" in words or "tuned INT8 legal" in words
    assert "No point that has the figures asked for has a higher PSNR" in asked(family, budget="latency<=1000s")[1]
    assert "has a lower board latency" in asked(family, need="psnr>=43")[1]


def test_an_interval_that_passes_the_limit_is_owned_up_to(family: Results) -> None:
    just = latency_s(family, "tiny") * 1.01
    assert "not the whole interval" in asked(family, budget=f"latency<={just}")[1]
    assert "not the whole interval" not in asked(family, budget="latency<=1000")[1]


def test_where_nothing_will_do_the_nearest_is_named(family: Results) -> None:
    name, words = asked(family, need="psnr>=50")
    assert not name
    assert "nearest comes tuned" in words
    assert "6.2 % off" in words
    name, words = asked(family, need="lpips<=0.1")
    assert not name
    assert "none has every figure" in words


def test_the_paper_is_matched_by_what_knows_no_more(family: Results) -> None:
    """The network trained for the sensor is better still, and does not compare."""
    paper = papers_point(family, lambda method: method == "papers", "C32B3")
    assert paper is not None
    for whole in (False, True):
        best = as_good(family, paper, whole_interval=whole)
        assert best is not None
        assert best.point.variant.method == "small"
    equal, tenth = findings(family, paper)
    assert "matched within 0.1 dB by small" in equal
    assert "0.3 dB" in equal
    assert "less than half the time over the whole interval" in equal
    assert "the best is tiny" in tenth
    assert "1 dB [" in tenth
    assert "of PSNR less" in tenth
    assert "small INT8 legal in tiles of 640" in at_a_glance(family, paper)


def test_where_nothing_matches_the_paper_it_is_said() -> None:
    worse = results({"tiny": Made(44.8, 4, 16), "papers": Made(45.0, 16, 64)})
    paper = papers_point(worse, lambda method: method == "papers", "C32B3")
    equal, tenth = findings(worse, paper)
    assert "no point that knows as much" in equal
    assert "the best is tiny" in tenth
    assert "papers" in at_a_glance(worse, paper)
    slower = results({"huge": Made(46.0, 32, 64), "papers": Made(45.0, 16, 64)})
    equal, tenth = findings(slower, papers_point(slower, lambda method: method == "papers", "C32B3"))
    assert "in less time" in equal
    assert "there is no point; the least takes huge" in tenth


def test_points_on_another_configuration_are_not_held_against_the_paper() -> None:
    found = results({"small": Made(45.3, 8, 32, configuration="C32B6"), "papers": Made(45.0, 16, 64)})
    paper = papers_point(found, lambda method: method == "papers", "C32B3")
    assert paper is not None
    assert as_good(found, paper, whole_interval=False) is None


def test_without_the_papers_network_there_is_no_finding(family: Results) -> None:
    assert papers_point(family, lambda _: False, "C32B3") is None
    assert "not among the networks" in findings(family, None)[0]
    assert "tuned" in at_a_glance(family, None)


def test_pairs_of_images_tell_apart_what_intervals_of_means_do_not(family: Results) -> None:
    """Means scatter by 3 dB from site to site; on the same sites half a decibel is sure."""
    small, papers = (named(family, name) for name in ("small", "papers"))
    low, high = family.gain(small, papers, "PSNR")
    assert 0 < low < 0.3 < high < 0.6
    assert family.gain(papers, small, "PSNR") == pytest.approx((-high, -low), abs=1e-6)
    assert family.gain(small, small, "PSNR") == (0.0, 0.0)


def test_below_five_sites_pictures_tell_no_two_points_apart(family: Results) -> None:
    """But for points that give the same pictures, of which the cheaper one is better on however many sites."""
    few = replace(family, sites=("a", "a", "b", "c", "d", "d"))
    small, papers = (named(few, name) for name in ("small", "papers"))
    assert few.gain(small, papers, "PSNR") == (-math.inf, math.inf)
    assert few.gain(small, small, "PSNR") == (0.0, 0.0)
    assert gain_words(few, small, papers, "PSNR") == "0.3 dB of PSNR"
    assert "[" in gain_words(family, small, papers, "PSNR")
    for front in fronts(few):
        assert not front.dominated
        assert not front.prices
    assert as_good(few, few.outcomes[papers], whole_interval=True) is None
    sentences = " ".join(findings(few, few.outcomes[papers]))
    assert "inf" not in sentences
    assert "over the whole interval: " not in sentences


def test_fronts_are_there_for_every_pair_of_figures_that_points_have(family: Results) -> None:
    found = fronts(family)
    assert {(front.x, front.y) for front in found} == {
        (x, y) for x in ("board latency", "board energy") for y in ("PSNR", "SSIM")
    }
    latency = next(front for front in found if (front.x, front.y) == ("board latency", "PSNR"))
    assert [name.split()[0] for name in latency.members] == ["tiny", "tuned"]
    assert latency.dominated[named(family, "papers")] == named(family, "tuned")
    assert len(latency.prices) == 1
    assert latency.prices[0].startswith("The last 2.9 dB")
    assert "times" in latency.prices[0]
    assert "board energy" in latency.prices[0]


def test_a_match_by_value_alone_is_followed_by_one_over_the_whole_interval() -> None:
    found = results(
        {
            "tiny": Made(44.95, 4, 16, scatter_db=0.3),
            "small": Made(45.3, 8, 32),
            "papers": Made(45.0, 16, 64),
        }
    )
    by_value, throughout, _ = findings(found, papers_point(found, lambda method: method == "papers", "C32B3"))
    assert "matched within 0.1 dB by tiny" in by_value
    assert "matched within 0.1 dB over the whole interval by small" in throughout


def test_a_step_that_images_cannot_tell_has_no_price() -> None:
    found = results(
        {"tiny": Made(45.0, 4, 16), "small": Made(45.01, 8, 32, scatter_db=0.5), "papers": Made(46, 16, 64)}
    )
    front = fronts(found)[0]
    assert len(front.members) == 3
    assert not front.dominated
    assert len(front.prices) == 1
    assert "from tiny" in front.prices[0]
    assert "to papers" in front.prices[0]


def test_of_points_that_cost_as_much_for_all_we_know_the_best_has_the_price() -> None:
    """A smaller tile is a little faster, by less than predictions are off."""
    found = results(
        {"tiny": Made(44.0, 4, 16, tile_px=512), "tall": Made(44.2, 4, 16), "papers": Made(45.0, 16, 64)},
    )
    front = fronts(found)[0]
    assert [name.split()[0] for name in front.members] == ["tiny", "tall", "papers"]
    assert len(front.prices) == 1
    assert "from tall" in front.prices[0]
    assert [name.split()[0] for name in front.steps] == ["tall", "papers"]


def test_of_points_that_images_cannot_tell_apart_the_cheaper_is_chosen() -> None:
    found = results({"small": Made(45.0, 8, 32), "papers": Made(45.01, 16, 64, scatter_db=0.5)})
    name, words = asked(found, budget="latency<=1000s")
    assert name == "small"
    assert "of papers INT8 legal" in words
    assert "is not distinguishable from it" in words
    far = results({"small": Made(45.0, 8, 32), "papers": Made(45.1, 16, 64, scatter_db=2.0)})
    assert asked(far, budget="latency<=1000s")[0] == "small"
    close = results({"small": Made(45.0, 8, 32), "papers": Made(45.01, 16, 64, scatter_db=0.001)})
    assert asked(close, budget="latency<=1000s")[0] == "papers"


def test_where_sites_are_too_few_to_tell_points_apart_values_decide_beyond_a_twentieth_of_a_decibel() -> None:
    few = ("a", "a", "b", "c", "d", "d")
    far = results({"small": Made(45.0, 8, 32), "papers": Made(45.1, 16, 64, scatter_db=2.0)})
    assert asked(replace(far, sites=few), budget="latency<=1000s")[0] == "papers"
    near = results({"small": Made(45.0, 8, 32), "papers": Made(45.04, 16, 64, scatter_db=2.0)})
    assert asked(replace(near, sites=few), budget="latency<=1000s")[0] == "small"
