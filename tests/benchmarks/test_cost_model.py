"""Tests of the cost model's fit, and of our descriptions of the published networks."""

import math

import pytest

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.cost.latency import predict
from beers_deploy.dpu.cost.model import Constants, Structure
from benchmarks.cost_model.builder import Builder
from benchmarks.cost_model.fit import Cases, fit, rounded
from benchmarks.cost_model.published import (
    NETWORKS,
    boards,
    network_case,
    published_cases,
    published_rates,
    written,
)
from benchmarks.cost_model.validation import SHARE, tolerance_rank

# Numbers of parameters, from the papers or their repositories, without biases and batch norms.
WEIGHTS = {"resnet-18": 11.68e6, "vgg-16": 138.34e6, "inception v3": 23.80e6, "yolo v5 n": 1.86e6}


@pytest.mark.slow
@pytest.mark.parametrize("board", boards())
def test_the_profile_has_the_constants_of_the_fit(board: str) -> None:
    dpu = load_dpu(board)
    assert rounded(fit(Cases(published_cases(board), Structure.of(dpu)))) == Constants.of(dpu)


@pytest.mark.slow
def test_every_network_is_the_published_one_and_passes_the_rules_of_its_boards() -> None:
    """AMD compiled them for these boards. If a rule refuses one, the rule or our description of
    the network is wrong.
    """
    for name, entry in NETWORKS.items():
        net = written(name).network
        assert sum(op.operations for op in net.operations) == pytest.approx(
            entry.operations, rel=0.05
        ), name
        if name in WEIGHTS:
            assert sum(op.weight_bytes for op in net.operations) == pytest.approx(
                WEIGHTS[name], rel=0.01
            ), name
        consumed = set(net.outputs).union(*(op.inputs for op in net.operations))
        assert [op.name for op in net.operations if op.output not in consumed] == [], name
        rated = {rate["board"] for rate in published_rates() if rate["network"] == name}
        dpus = map(load_dpu, rated)
        # Boards of one DPU have its rules.
        for dpu in {dpu.target.documents["operators"]: dpu for dpu in dpus}.values():
            failed = [node.op.name for node in place(net, dpu).failed]
            assert failed == [], (name, dpu.target.name)


@pytest.mark.parametrize(
    ("board", "name"), [("vck190", "resnet-50"), ("zcu102", "rcan"), ("vek280", "erfnet")]
)
def test_the_fit_and_the_prediction_are_one_formula(board: str, name: str) -> None:
    dpu = load_dpu(board)
    case = Cases((network_case(name, dpu, (1.0,)),), Structure.of(dpu))
    times = case.times(Constants.of(dpu))
    prediction = predict(place(written(name).network, dpu), dpu, NETWORKS[name].host)
    assert prediction.dpu.handlers / prediction.latency_s == pytest.approx(
        1 / float(times.alone_s[0] + times.host_s[0])
    )
    assert prediction.fps == pytest.approx(math.exp(float(case.predicted(times)[0])))


def test_the_fitted_range_ends_with_the_largest_network() -> None:
    dpu = load_dpu("vck190")
    assert predict(place(written("rcan").network, dpu), dpu).outside == ()
    b = Builder(1280, 1280, 1)
    assert predict(place(b.written(b.conv(b.image, 64)).network, dpu), dpu).outside


def test_the_papers_network_is_in_no_fit() -> None:
    assert not [name for name in NETWORKS if "beers" in name]
    assert not [rate for rate in published_rates() if float(rate["fps"]) == 7.2]


@pytest.mark.parametrize("count", [3, 14, 30, 57])
def test_the_rank_of_a_tolerance_is_the_smallest_that_is_sure_enough(count: int) -> None:
    def sure(rank: int) -> float:
        """Return the probability that fewer than `rank` of the draws fall among SHARE."""
        return math.fsum(
            math.comb(count, k) * SHARE**k * (1 - SHARE) ** (count - k) for k in range(rank)
        )

    rank = tolerance_rank(count)
    assert sure(rank) >= 0.75 or rank == count
    assert sure(rank - 1) < 0.75


def test_shapes_that_do_not_fit_are_refused() -> None:
    b = Builder(8, 8, 4)
    with pytest.raises(ValueError, match="shapes differ"):
        b.add(b.conv(b.image, 8), b.image)
