"""Tests that the search announces a bound on its work and keeps it."""

import logging
import re

import numpy as np
import onnx
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.graph import Graph
from beers_deploy.quant.host_part import ONE_CHANNEL
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.quant.passes import effort as effort_module
from beers_deploy.quant.passes.effort import (
    LEAST_CROPS,
    MOST_GROUPS,
    Effort,
    Stage,
    bound,
    channel_groups,
    work_of,
)
from beers_deploy.quant.passes.residual_groups import residual_groups
from beers_deploy.quant.passes.trial import CropTrials
from beers_deploy.quant.quantize import Quantized, quantize_model
from beers_deploy.quant.session import open_session
from tests.quant.quick import image, patches_of, waves

EFFORTS = list(Effort)


@pytest.mark.parametrize("count", [1, 5, 16, 17, 100])
@pytest.mark.parametrize("most", [0, 1, 3, 16, 256])
def test_groups_of_channels_hold_each_channel_once_and_neighbours_in_range(
    count: int, most: int
) -> None:
    ranges = np.random.default_rng(count).lognormal(0, 1, count)
    groups = channel_groups(ranges, most)
    assert len(groups) == min(most, count)
    if most:
        assert_array_equal(np.sort(np.concatenate(groups)), np.arange(count))
    if 0 < most < count:
        widest = [ranges[group].max() for group in groups]
        narrowest = [ranges[group].min() for group in groups]
        assert all(low >= high for low, high in zip(narrowest[1:], widest[:-1], strict=True))


def stages(graph: Graph) -> list[Stage]:
    (group,) = residual_groups(graph)
    return [Stage(group, 12, 8)]


@pytest.mark.parametrize("size", [1, 30, 1000, 100_000])
def test_more_work_is_bounded_by_fewer_groups_and_crops(graph: Graph, size: int) -> None:
    work = [size * each for each in work_of(graph, ONE_CHANNEL, image())]
    limits = {each: bound(stages(graph), graph, work, 64, each) for each in EFFORTS}
    counts = [limits[each].candidates for each in EFFORTS]
    assert counts == sorted(counts)
    assert limits[Effort.best].crops == 64
    assert limits[Effort.best].groups == MOST_GROUPS[Effort.best]
    for each in (Effort.fast, Effort.normal):
        limit = limits[each]
        most = limit.candidates * limit.crops * sum(work)
        assert most <= effort_module.MOST_WORK or (limit.crops, limit.groups) == (LEAST_CROPS, 0)


def test_work_counts_multiply_accumulates(graph: Graph) -> None:
    small, large = (sum(work_of(graph, ONE_CHANNEL, image(*s))) for s in ((20, 30), (40, 30)))
    assert large == 2 * small
    # (O, I, kh, kw) weights are used once for each of 600 pixels, and each result is rounded.
    head = graph[0].weight.size + effort_module.RESULT * len(graph[0].weight)  # type: ignore[attr-defined]
    assert work_of(graph, ONE_CHANNEL, image(20, 30))[0] == 600 * head


def counted(
    model: onnx.ModelProto, level: Effort, monkeypatch: pytest.MonkeyPatch
) -> tuple[Quantized, int]:
    """Return the quantised network and the number of candidates that were measured."""
    measured: list[int] = []
    costs = CropTrials._costs

    def counting(self: CropTrials, *inner: object) -> object:
        measured.append(len(inner))
        return costs(self, *inner)  # type: ignore[arg-type]

    with monkeypatch.context() as patched:
        patched.setattr(CropTrials, "_costs", counting)
        return quantize_model(model, patches_of(waves()), {}, effort=level), len(measured)


def test_no_more_is_tried_than_is_announced_and_more_effort_tries_more(
    float_onnx: onnx.ModelProto, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # Few groups make this quick.
    monkeypatch.setitem(effort_module.MOST_GROUPS, Effort.normal, 1)
    monkeypatch.setitem(effort_module.MOST_GROUPS, Effort.best, 2)
    counts = []
    for level in EFFORTS:
        with caplog.at_level(logging.INFO):
            int8, count = counted(float_onnx, level, monkeypatch)
        announced = re.findall(r"tries at most (\d+) candidates, in about \d+ s", caplog.text)[-1]
        # One more is measured to estimate the time.
        assert count <= int(announced) + 1
        counts.append(count)
        assert metadata(int8.host)["effort"] == level
    assert counts == sorted(counts)


def test_running_only_changed_layers_gives_the_cost_of_running_all(
    float_onnx: onnx.ModelProto, monkeypatch: pytest.MonkeyPatch
) -> None:
    costs_of_both: list[tuple[np.ndarray, np.ndarray]] = []
    costs = CropTrials._costs

    def both(self: CropTrials, parts: list, values: list, core: IntCore):  # type: ignore[no-untyped-def,type-arg]
        cost = costs(self, parts, values, core)
        whole = open_session(host_model(core, {}), threads=1)
        errors = []
        for target, change in zip(self.targets, self.changes, strict=True):
            difference = whole.run(None, {"image": target.image})[0] - target.result
            error = np.linalg.norm(difference) / np.sqrt(difference.size) / change
            errors.append(target.weight * error)
        costs_of_both.append((cost(None), np.array(errors)))
        return cost

    monkeypatch.setattr(CropTrials, "_costs", both)
    quantize_model(float_onnx, patches_of(waves(2)), {}, effort=Effort.fast)
    assert len(costs_of_both) > 12
    for partial, whole in costs_of_both:
        assert_allclose(partial, whole, rtol=1e-6)
