"""The sentence for a manager: what to take, how good it is, how long it takes, what the next step costs."""

import math
from collections.abc import Iterable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.tradeoff.advice import Recommendation, knee, recommendations, steps_of
from deploy.tradeoff.outcome import DIRECTIONS, Place, Results
from deploy.tradeoff.points import parse_demands
from deploy.tradeoff.study import difference_rows, fronts, held_against
from tests.deploy.tradeoff.made_results import Made, named, results

FAMILY = {
    "tiny": Made(44.0, 4, 16),
    "small": Made(45.3, 8, 32),
    "middle": Made(45.5, 16, 32),
    "papers": Made(45.6, 16, 64),
}
FEW = ("a", "a", "b", "c", "d", "d")


@pytest.fixture(scope="module")
def family() -> Results:
    return results(FAMILY)


def asked(found: Results, budget: str | None = None, need: str | None = None) -> Recommendation:
    """What is said of PSNR."""
    demands = parse_demands("--budget", budget), parse_demands("--need", need)
    return recommendations(found, *demands, "vck190")[0]


def taken(found: Recommendation) -> tuple[str, str]:
    """The methods of the point to take and of the next step."""
    return tuple(each.point.variant.method if each else "" for each in (found.taken, found.following))  # type: ignore[return-value]


def test_within_a_budget_the_best_is_taken_and_the_next_step_has_its_price(family: Results) -> None:
    latency = {key: family.outcomes[named(family, key)].value("board latency") or 0.0 for key in FAMILY}
    found = asked(family, budget=f"latency<={1.01 * latency['small']:.3f}s")
    assert taken(found) == ("small", "middle")
    gain, paid = found.figures["next gain"], found.figures["next cost"]
    assert gain.value == pytest.approx(0.2)
    assert gain.interval
    assert gain.interval[0] < 0.2 < gain.interval[1]
    assert paid.value == pytest.approx(latency["middle"] - latency["small"])
    assert (paid.mode, paid.unit) == ("predicted", "s")
    assert found.sentence.startswith("For board latency at most ")
    for words in ("take small INT8 legal (C32B3, tile 640, halo exact): PSNR 45.3 dB at ", "s on vck190 (predicted)"):
        assert words in found.sentence
    assert "; the next 0.2 dB [" in found.sentence
    assert found.sentence.count("more") == 1
    assert "but not the whole interval" in found.sentence


def test_where_nothing_fits_the_nearest_is_named_and_nothing_is_taken(family: Results) -> None:
    found = asked(family, budget="latency<=0.001s")
    assert taken(found) == ("", "")
    assert found.sentence.startswith("Nothing in this study fits board latency at most 0.001 s; nearest comes tiny")
    assert found.figures["PSNR"].value is None
    assert found.row.text["take"] == found.row.text["next"] == "none"
    assert "none has every figure" in asked(family, need="lpips<=0.1").sentence


def test_the_best_of_all_has_nothing_beyond_it(family: Results) -> None:
    found = asked(family, budget="latency<=1000s")
    assert taken(found) == ("papers", "")
    assert "nothing dearer in this study is shown to be better" in found.sentence
    assert found.figures["next cost"].value is None
    assert found.figures["next cost"].reason


def test_a_need_takes_the_cheapest_that_keeps_it(family: Results) -> None:
    assert taken(asked(family, need="psnr>=45")) == ("small", "middle")
    assert taken(asked(family, need="psnr>=45.4")) == ("middle", "papers")


def test_without_a_budget_it_is_the_knee(family: Results) -> None:
    """Eight tenths of the gain for the first step, a tenth and less for each further one."""
    found = asked(family)
    assert taken(found) == ("small", "middle")
    assert found.sentence.startswith("Without a budget take small INT8 legal (C32B3, tile 640, halo exact), the knee")
    two = asked(results({key: FAMILY[key] for key in ("tiny", "papers")}))
    assert taken(two) == ("tiny", "papers")
    assert "the cheapest on the front" in two.sentence


def test_of_two_that_cannot_be_told_apart_the_faster_is_taken_and_it_is_said() -> None:
    noisy = results({"small": Made(45.0, 8, 32), "papers": Made(45.1, 16, 64, scatter_db=2.0)})
    found = asked(noisy, budget="latency<=1000s")
    assert taken(found) == ("small", "")
    assert "papers INT8 legal (C32B3, tile 640, halo exact) is better by 0.1 dB [" in found.sentence
    assert found.sentence.endswith("but these images cannot tell the two apart: take the faster.")
    assert asked(noisy, budget="energy<=1e6J").sentence.endswith("take the thriftier.")
    (said,) = fronts(noisy)[0].alike
    assert "cannot be told apart on these images: 0.1 dB [" in said
    assert said.endswith("Take small INT8 legal, C32B3, tile 640, halo exact, the faster.")
    sure = results({"small": Made(45.0, 8, 32), "papers": Made(45.1, 16, 64, scatter_db=0.01)})
    assert taken(asked(sure, budget="latency<=1000s")) == ("papers", "")
    assert not fronts(sure)[0].alike


def test_the_same_pictures_are_not_called_indistinguishable() -> None:
    """A network on two configurations: the cheaper one is simply the best."""
    twice = results({"small": Made(45.0, 8, 32), "again": Made(45.0, 8, 32, tile_px=512, scatter_db=0.01)})
    same = {
        key: replace(each, scores=next(iter(twice.outcomes.values())).scores) for key, each in twice.outcomes.items()
    }
    found = asked(replace(twice, outcomes=same), budget="latency<=1000s")
    assert "cannot tell" not in found.sentence


def test_of_too_few_sites_values_decide_and_it_is_said(family: Results) -> None:
    few = replace(family, sites=FEW)
    found = asked(few, budget="latency<=1000s")
    assert taken(asked(few)) == taken(asked(family))
    assert "By value alone: of fewer than 5 sites no difference can be trusted." in asked(few).sentence
    assert "inf" not in found.sentence
    assert not any(each.alike for each in fronts(few))


def test_each_quality_has_its_sentence_and_its_row(family: Results) -> None:
    found = recommendations(family, [], [], "zcu104")
    assert [each.quality for each in found] == ["PSNR", "SSIM"]  # LPIPS is unavailable there
    for each in found:
        row = each.row
        assert row.name == f"{each.quality} on zcu104"
        assert row.text["sentence"] == each.sentence
        assert {each.quality, "board latency", "next gain", "next cost"} == set(row.figures)
        assert "on zcu104 (predicted)" in each.sentence


COSTS = st.lists(st.floats(0.01, 1e4), min_size=1, max_size=8, unique=True).map(sorted)


@st.composite
def steps(draw: st.DrawFn) -> list[Place]:
    """Steps of a front: dearer and better, one after the other."""
    costs = draw(COSTS)
    gains = draw(st.lists(st.floats(0.001, 5), min_size=len(costs), max_size=len(costs)))
    return [Place(f"p{k}", cost, 40 + sum(gains[: k + 1])) for k, cost in enumerate(costs)]


@given(steps(), st.floats(0.1, 10), st.floats(0.1, 10))
def test_a_knee_is_a_step_and_knows_no_units(found: list[Place], times: float, per: float) -> None:
    chosen = knee(found)
    assert chosen in found
    in_other_units = [Place(each.name, times * each.cost, per * each.quality) for each in found]
    low, high = found[0], found[-1]

    def above(each: Place) -> float:
        share = (each.quality - low.quality) / (high.quality - low.quality or 1)
        return share - math.log(each.cost / low.cost) / (math.log(high.cost / low.cost) or 1)

    other = next(each for each in found if each.name == knee(in_other_units).name)
    assert above(other) == pytest.approx(max(map(above, found)), abs=1e-6)


@given(steps())
def test_beyond_a_knee_a_doubling_buys_no_more_than_along_the_whole_front(found: list[Place]) -> None:
    at, (first, last) = knee(found), (found[0], found[-1])
    if at not in (first, last):
        mean = (last.quality - first.quality) / math.log(last.cost / first.cost)
        assert (last.quality - at.quality) / math.log(last.cost / at.cost) <= mean * (1 + 1e-6)


def test_steps_leave_out_what_images_cannot_tell(family: Results) -> None:
    assert [each.name.split()[0] for each in steps_of(family, "PSNR", "board latency")] == list(FAMILY)
    noisy = results({"tiny": Made(44.0, 4, 16), "small": Made(44.05, 8, 32, scatter_db=1.0)})
    assert [each.name.split()[0] for each in steps_of(noisy, "PSNR", "board latency")] == ["tiny"]


def methods(found: Iterable[str]) -> list[str]:
    return [name.split()[0] for name in found]


def test_differences_are_from_the_front_just_before_with_paired_intervals(family: Results) -> None:
    """Sites differ by 3 dB: a paired interval is a hundred times narrower."""
    found = next(each for each in fronts(family) if (each.x, each.y) == ("board latency", "PSNR"))
    assert methods(found.members) == list(FAMILY)
    assert methods(found.differences) == list(FAMILY)[1:]
    for name, difference in found.differences.items():
        before = found.members[found.members.index(name) - 1]
        assert difference.against == before
        values = [family.outcomes[each].value("PSNR") or 0.0 for each in (name, before)]
        assert difference.figure.value == pytest.approx(values[0] - values[1])
        low, high = difference.figure.interval or (0.0, 0.0)
        assert low < values[0] - values[1] < high < low + 0.1


def test_a_point_off_the_front_is_held_against_the_member_that_costs_no_more() -> None:
    found = results({"tiny": Made(44.0, 4, 16), "small": Made(45.3, 8, 32), "poor": Made(43.0, 16, 32)})
    each = fronts(found)[0]
    difference = each.differences[named(found, "poor")]
    assert difference.against == named(found, "small")
    assert (difference.figure.value or 0.0) == pytest.approx(-2.3)


def test_all_are_held_against_a_method_in_every_quality(family: Results) -> None:
    assert held_against(family, None) == ""  # no chain among them
    assert difference_rows(family, "") == ()
    against = held_against(family, "small")
    assert against == named(family, "small")
    rows = {row.name: row for row in difference_rows(family, against)}
    assert rows.keys() == family.outcomes.keys()
    tiny = rows[named(family, "tiny")].figures
    assert set(tiny) == {f"{key} difference" for key in DIRECTIONS if key != "mAP50"}
    assert tiny["PSNR difference"].value == pytest.approx(-1.3)
    assert tiny["PSNR difference"].unit == "dB"
    assert "paired" in tiny["PSNR difference"].source
    assert tiny["LPIPS-squeeze difference"].value is None
    assert "no LPIPS-squeeze of" in tiny["LPIPS-squeeze difference"].reason
    assert rows[against].figures["PSNR difference"].interval == (0.0, 0.0)


def test_a_difference_with_a_predicted_figure_is_predicted_and_without_sites_has_no_interval(family: Results) -> None:
    tiny, small = (named(family, name) for name in ("tiny", "small"))
    psnr = replace(family.outcomes[tiny].figures["PSNR"], mode="predicted")
    seamed = replace(family.outcomes[tiny], figures={**family.outcomes[tiny].figures, "PSNR": psnr})
    found = replace(family, outcomes={**family.outcomes, tiny: seamed})
    assert found.difference(tiny, small, "PSNR").mode == "predicted"
    assert family.difference(tiny, small, "PSNR").mode == "measured"
    few = replace(family, sites=FEW).difference(tiny, small, "PSNR")
    assert few.interval is None
    assert "fewer than 5 sites" in few.source
