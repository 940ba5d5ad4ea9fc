"""The fit finds what made the rates, and each network weighs the same."""

import math
from dataclasses import replace

import numpy as np
import pytest

from deploy.dpu.board import load_dpu
from deploy.dpu.cost.constants import NAMES, Constants, Structure
from deploy.dpu.cost.fit import FIRM_PRIOR, START, Cases, fit
from deploy.dpu.cost.published import boards, published_cases

BOARDS = boards()


@pytest.fixture(scope="module")
def cases() -> Cases:
    return published_cases("zcu102", Structure.of(load_dpu("zcu102")))


def made(cases: Cases, truth: Constants) -> Cases:
    """The same networks with the rates that these constants give."""
    times = cases.times(truth)
    several, single = np.exp(cases.predicted(times)), 1 / (times.alone_s + times.host_s)
    rows = zip(cases.rows, several.tolist(), single.tolist(), strict=True)
    return Cases(tuple(replace(row, fps=(a,), fps_single=(b,)) for row, a, b in rows), cases.structure)


@pytest.mark.parametrize("board", BOARDS)
def test_the_profile_holds_what_the_fit_finds(board: str) -> None:
    dpu = load_dpu(board)
    found, stored = fit(published_cases(board, Structure.of(dpu))), Constants.of(dpu)
    assert found.rounded() == stored


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_fit_does_not_depend_on_where_it_begins(cases: Cases, factor: float) -> None:
    near, far = fit(cases), fit(cases, near=Constants.from_logs(START.logs + math.log(factor)))
    assert np.abs(cases.errors(near) - cases.errors(far)).max() < 0.05


def test_the_fit_finds_the_rates_that_constants_made(cases: Cases) -> None:
    truth = replace(START, array_efficiency=0.7, memory_efficiency=0.5, layer_s=8e-6, argmax_values_per_s=0.2e9)
    wanted = made(cases, truth)
    found = fit(wanted)
    assert np.abs(wanted.errors(found)).max() < 0.05
    assert found.array_efficiency == pytest.approx(0.7, rel=0.05)


def test_slopes_are_those_of_the_residuals(cases: Cases) -> None:
    """The shortcut that does not compute the DPU again for the host's constants changes nothing."""
    times = cases.times(START)
    residuals = cases.residuals(times)
    slopes = cases.slopes(START.logs, times, residuals)
    for index in range(len(NAMES)):
        moved = Constants.from_logs(START.logs + 1e-5 * np.eye(len(NAMES))[index])
        there = cases.residuals(cases.times(moved))
        assert slopes[:, index] == pytest.approx((there - residuals) / 1e-5, abs=1e-4)


def test_a_network_weighs_the_same_however_many_rates_it_has(cases: Cases) -> None:
    first = cases.rows[0]
    doubled = Cases((*cases.rows, *[replace(first, configuration=f"copy {k}") for k in range(5)]), cases.structure)
    once, often = fit(cases), fit(doubled)
    assert np.abs(cases.errors(once) - cases.errors(often)).max() < 0.01


def test_the_papers_network_is_in_no_fit() -> None:
    for board in BOARDS:
        rows = published_cases(board, Structure.of(load_dpu(board))).rows
        assert not [row for row in rows if "beers" in row.network or 7.2 in row.fps]


def test_a_firm_prior_holds_what_the_rows_do_not_tell(cases: Cases) -> None:
    """One row of a network that the DPU bounds says next to nothing of how the host sorts."""
    old = Constants.of(load_dpu("zcu102"))
    one = cases.only(np.array([row.network == "resnet-50" for row in cases.rows]))
    half = math.exp(one.predicted(one.times(old))[0]) / 2
    slow = Cases((replace(one.rows[0], fps=(half,), fps_single=()),), cases.structure)
    new = fit(slow, old, FIRM_PRIOR)
    assert new.sort_values_per_s == pytest.approx(old.sort_values_per_s)
    assert abs(slow.errors(new)[0]) < 0.7 * math.log(2)
