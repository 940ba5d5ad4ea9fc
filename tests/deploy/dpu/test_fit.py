"""The fit finds what is stored, and the model keeps to the errors that it claims."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from deploy.dpu.board import load_dpu
from deploy.dpu.cost.fit import FIRM_PRIOR, START, Cases, fit
from deploy.dpu.cost.layers import Array, Constants
from deploy.dpu.cost.validation import (
    beyond,
    coverage,
    fitted_ranges,
    leave_out,
    published_cases,
    quantile,
    rank_correlation,
    relative,
)

DPU = load_dpu("vck190")


@pytest.fixture(scope="module")
def cases() -> Cases:
    return published_cases()


@pytest.fixture(scope="module")
def names(cases: Cases) -> list[str]:
    return [row.network for row in cases.rows]


@pytest.fixture(scope="module")
def errors(cases: Cases, names: list[str]) -> Array:
    return leave_out(cases, names)


def test_the_profile_holds_what_the_fit_finds(cases: Cases) -> None:
    found, stored = fit(cases), Constants.of(DPU)
    for field in fields(Constants):
        assert getattr(found, field.name) == pytest.approx(getattr(stored, field.name), rel=2e-3)


def test_the_profile_holds_the_errors_and_ranges(cases: Cases, names: list[str], errors: Array) -> None:
    inside = quantile(errors, names)
    assert DPU.value("cost", "error_inside") == pytest.approx(inside, abs=1e-3)
    outside = max(inside, quantile(*beyond(cases)))
    assert DPU.value("cost", "error_outside") == pytest.approx(outside, abs=1e-3)
    for key, ends in fitted_ranges(cases, fit(cases)).items():
        assert DPU.limit("cost", f"fitted_{key}").value == pytest.approx(ends, rel=1e-2)


@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_the_fit_does_not_depend_on_where_it_begins(cases: Cases, factor: float) -> None:
    start = Constants.from_logs(START.logs + math.log(factor))
    near, far = fit(cases), fit(cases, start)
    for field in fields(Constants):
        assert getattr(far, field.name) == pytest.approx(getattr(near, field.name), rel=0.1)


def test_the_fit_finds_constants_that_made_the_rates(cases: Cases) -> None:
    truth = replace(START, efficiency=0.5, map_bytes_per_s=25e9, batch_s=3e-4, layer_s=8e-6)
    rates = np.exp(cases.predicted(truth))
    made = Cases(tuple(replace(row, fps=float(r)) for row, r in zip(cases.rows, rates, strict=True)), cases.serial)
    found = fit(made)
    for field in fields(Constants):
        assert getattr(found, field.name) == pytest.approx(getattr(truth, field.name), rel=0.02)


def test_left_out_networks_are_predicted_as_well_as_the_docs_say(
    cases: Cases, names: list[str], errors: Array
) -> None:
    assert len(set(names)) >= 20
    assert len(names) >= 60
    assert np.median(relative(errors)) <= 0.10
    assert relative(errors).mean() <= 0.20
    assert rank_correlation(cases, errors) >= 0.95
    assert coverage(errors, names) >= 0.85


def test_the_papers_network_is_in_no_fit(cases: Cases) -> None:
    assert not [row for row in cases.rows if "beers" in row.network or math.isclose(row.fps, 7.2)]


def test_a_firm_prior_holds_what_the_rows_do_not_tell(cases: Cases) -> None:
    """One row of a network that the DPU bounds says nothing of the host."""
    keep = np.arange(len(cases.rows)) == 0
    old = Constants.of(DPU)
    one = cases.only(keep)
    row = replace(one.rows[0], fps=math.exp(one.predicted(old)[0]) / 2)
    new = fit(Cases((row,), cases.serial), old, FIRM_PRIOR)
    assert new.host_out_bytes_per_s == pytest.approx(old.host_out_bytes_per_s, rel=1e-3)
    assert abs(Cases((row,), cases.serial).errors(new)[0]) < 0.5 * math.log(2)


def test_a_quantile_counts_each_name_once() -> None:
    errors, names = np.array([0.1] * 50 + [0.4]), ["many"] * 50 + ["one"]
    assert quantile(errors, names, 0.5) == pytest.approx(0.1)
    assert quantile(errors, names) == pytest.approx(0.4)


def test_the_rates_do_not_tell_how_much_is_hidden(cases: Cases) -> None:
    """Why `serial` is assumed: from a quarter to all of the shorter part, the fit is as good."""
    means = [relative(c.errors(fit(c))).mean() for c in (replace(cases, serial=s) for s in (0.25, 0.5, 0.75, 1.0))]
    assert max(means) - min(means) < 0.01
