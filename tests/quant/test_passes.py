"""Tests that passes keep the float network and have their effect on the INT8 network."""

from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from itertools import product
from unittest.mock import patch

import numpy as np
import onnx
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.model.progress import Step, progress, reporting
from beers_deploy.quant.core import IntConv
from beers_deploy.quant.gate import compare
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    Activation,
    Add,
    Concat,
    Conv,
    Graph,
    MaxPool,
    Op,
    Pointwise,
    Resize,
    Shuffle,
    Window,
    graph_to_onnx,
)
from beers_deploy.quant.host_part import FINE_MAX, GAIN, DualRange, Plain
from beers_deploy.quant.passes.dual_range import with_copies
from beers_deploy.quant.passes.effort import Stage, channel_groups
from beers_deploy.quant.passes.equalize import (
    FIRST_CROPS,
    FIRST_GUESSES,
    channel_ranges,
    equalize,
    first_guess,
    search,
)
from beers_deploy.quant.passes.residual_groups import (
    GROUP_FRAC_BITS,
    ResidualGroup,
    exceeds_six,
    n_factors,
    residual_groups,
)
from beers_deploy.quant.passes.selection import Passes
from beers_deploy.quant.passes.trial import Costs, CropTrials
from beers_deploy.quant.quantize import Quantized, quantize_model
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_session
from tests.quant.quick import image, in_float, patches_of, quickly, random_conv, run_model
from tests.quant.simplify.networks import parsed
from tests.quant.test_odd_networks import SAME, sketch

ENLARGING = Resize("resize", "deep", "up", 2)


def group_of(graph: Graph) -> ResidualGroup:
    (group,) = residual_groups(graph)
    return group


def correction(graph: Graph) -> np.ndarray:
    return in_float(graph, image(23, 31))


def test_equalizing_leaves_the_float_network_as_it_was(graph: Graph) -> None:
    factors = np.random.default_rng(1).uniform(0.2, 5, 8)
    scaled = equalize(graph, group_of(graph), factors)
    assert_allclose(correction(scaled), correction(graph), atol=2e-6)
    first_alone = (scaled[0], *graph[1:])
    assert np.abs(correction(first_alone) - correction(graph)).max() > 1e-3


def test_ranges_are_equalized_to_the_group_s_own(graph: Graph, patches: Patches) -> None:
    images = [image for image, _ in patches.pairs]
    group = group_of(graph)
    ranges = channel_ranges(graph, group, images)
    assert ranges.shape == (8,)
    factors = first_guess(ranges, 1.0, 1.0)
    assert_allclose(ranges * factors, 127 * 2.0**-GROUP_FRAC_BITS)
    new_ranges = channel_ranges(equalize(graph, group, factors), group, images)
    assert_allclose(new_ranges, ranges * factors, rtol=1e-4)
    # A channel that is dead but for rounding keeps a range, so that no factor amplifies it.
    dead = equalize(graph, group, np.where(np.arange(8) == 3, 1e-12, 1))
    dead_ranges = channel_ranges(dead, group, images[:1])
    assert dead_ranges[3] >= 1e-4 * dead_ranges.max()


def skipping(enlarging: Op = ENLARGING) -> Graph:
    """Build a graph that pools and enlarges a sum behind a ReLU6, and concatenates both."""
    conv = partial(random_conv, np.random.default_rng(0))
    deep = 8 if isinstance(enlarging, Shuffle) else 2
    return (
        conv(PLANES, "head", (3, 3, 1, 1), Activation.relu6),
        conv("head", "inner", (3, 3, 1, 1)),
        Add("add", ("head", "inner"), "sum"),
        MaxPool("max", "sum", "pooled", (2, 2), Window((2, 2))),
        conv("pooled", "deep", (deep, 3, 1, 1)),
        enlarging,
        Concat("join", ("up", "sum"), "both"),
        conv("both", CORRECTION, (1, 5, 1, 1)),
    )


@pytest.mark.parametrize(
    ("enlarging", "deep"),
    [
        (ENLARGING, [0, 1]),
        (Shuffle("shuffle", "deep", "up", 2), [0, 0, 0, 0, 1, 1, 1, 1]),
        (Shuffle("shuffle", "deep", "up", 2, columns_first=False), [0, 1] * 4),
    ],
)
def test_a_group_goes_through_what_passes_channels_on(enlarging: Op, deep: list[int]) -> None:
    graph = skipping(enlarging)
    group = group_of(graph)
    fine = [2, 3, 4]
    expected = {"head": fine, "inner": fine, "sum": fine, "pooled": fine}
    expected |= {"deep": deep, "up": [0, 1], "both": [0, 1, *fine]}
    assert {name: numbers.tolist() for name, numbers in group.items()} == expected
    assert_scales(graph, group)


def assert_scales(graph: Graph, group: ResidualGroup) -> None:
    """Check that factors change no result of the float network."""
    planes = {PLANES: np.random.default_rng(1).normal(0, 3, (1, 3, 6, 10)).astype(np.float32)}
    scaled = equalize(graph, group, np.random.default_rng(2).lognormal(-1, 1, n_factors(group)))
    before, after = (
        open_session(graph_to_onnx(each, [CORRECTION])).run(None, planes)[0]
        for each in (graph, scaled)
    )
    assert_allclose(after, before, atol=1e-4)


@pytest.mark.parametrize(
    ("activation", "passes"), [(Activation.leaky_relu, True), (Activation.hard_swish, False)]
)
def test_a_group_goes_through_activations_in_proportion_to_their_input(
    activation: Activation, passes: bool
) -> None:
    head, inner, add, *_ = skipping()
    last = Conv(
        "last", "active", CORRECTION, np.ones((1, 3, 1, 1), np.float32), np.zeros(1, np.float32)
    )
    graph = (head, inner, add, Pointwise("act", "sum", "active", activation), last)
    groups = residual_groups(graph)
    assert [set(group) for group in groups] == passes * [{"head", "inner", "sum", "active"}]
    for group in groups:
        scaled = equalize(graph, group, np.random.default_rng(2).lognormal(-1, 1, 3))
        assert_allclose(correction(scaled), correction(graph), atol=2e-6)


def test_a_tensor_with_two_positions_in_a_concat_has_the_same_factors_in_both() -> None:
    *before, join, last = skipping()
    assert isinstance(last, Conv)
    twice = replace(join, inputs=("sum", "sum"))  # type: ignore[type-var]
    graph = (*before, twice, replace(last, weight=np.ones((1, 6, 1, 1), np.float32)))
    group = group_of(graph)
    assert group["both"].tolist() == [0, 1, 2, 0, 1, 2]
    assert_scales(graph, group)


@pytest.mark.parametrize(("bits", "beyond"), [(5, False), (4, True)])
def test_the_scale_of_sums_shows_that_they_exceed_a_relu6(bits: int, beyond: bool) -> None:
    graph = skipping()
    frac_bits = dict.fromkeys(group_of(graph), 5) | {"sum": bits}
    assert exceeds_six(graph, group_of(graph), frac_bits) is beyond
    plain = tuple(
        replace(op, activation=Activation.relu) if op.output == "head" else op  # type: ignore[type-var]
        for op in graph
    )
    assert not exceeds_six(plain, group_of(plain), frac_bits)


CROPS = 5
RANGES = np.geomspace(1, 0.05, 8)


def searched(
    graph: Graph, weights: np.ndarray, most_groups: int = 8
) -> tuple[list[float], float, list[int]]:
    """Return the cost of each first guess, the final cost, and the number of crops of each trial.

    The cost on a crop is known: the distance of the channels' factors from given ones, times the
    crop's weight.
    """
    sizes = np.abs(graph[0].weight).sum((1, 2, 3))  # type: ignore[attr-defined]
    runs: list[int] = []

    def costs(candidate: Graph) -> np.ndarray:
        factors = np.abs(candidate[0].weight).sum((1, 2, 3)) / sizes  # type: ignore[attr-defined]
        return np.asarray(np.square(np.log(factors / np.geomspace(0.1, 3, 8))).sum() * weights)

    def trial(candidate: Graph) -> Costs:
        runs.append(0)

        def of(crops: np.ndarray | None) -> np.ndarray:
            crop_costs = costs(candidate) if crops is None else costs(candidate)[crops]
            runs[-1] += len(crop_costs)
            return crop_costs

        return of

    channels = channel_groups(RANGES, most_groups)
    factors = search(graph, group_of(graph), RANGES, trial, channels)
    pairs = product((0.5, 0.75, 1.0), (0.64, 0.8, 1.0, 1.25))
    guesses = [first_guess(RANGES, g, h) for g, h in pairs]
    ends = [
        float(costs(equalize(graph, group_of(graph), factor)).sum())
        for factor in (*guesses, factors)
    ]
    return ends[:-1], ends[-1], runs


def test_the_search_ends_below_its_best_guess_and_drops_a_trial_that_fails_on_its_first_crops(
    graph: Graph,
) -> None:
    guesses, cost, runs = searched(graph, np.arange(1.0, CROPS + 1))
    assert cost < min(guesses)
    # Every crop gives the same verdict here, so a trial fails on the first crops or not at all.
    assert set(runs) == {FIRST_CROPS, CROPS}
    assert runs[0] == CROPS
    assert runs.count(FIRST_CROPS) > len(runs) / 3


def test_more_groups_of_channels_try_more_and_never_end_higher(graph: Graph) -> None:
    """Without groups, the search ends with the best first guess."""
    stage = Stage(group_of(graph), FIRST_GUESSES, len(RANGES))
    guesses, best, runs = searched(graph, np.arange(1.0, CROPS + 1), 0)
    assert (best, len(runs)) == (min(guesses), FIRST_GUESSES)
    tried = len(runs)
    for most in (2, 4, 8):
        _, cost, runs = searched(graph, np.arange(1.0, CROPS + 1), most)
        assert cost <= best
        assert tried <= len(runs) <= stage.candidates(most)
        best = cost
        tried = len(runs)


def test_a_trial_that_the_costliest_crops_favour_still_has_to_win_on_all(graph: Graph) -> None:
    """A trial that wins on the first crops and loses on all is rejected, without any margin."""
    guesses, cost, _ = searched(graph, np.array([3.0, 2.0, -1.0, -2.0, -3.0]))
    assert cost <= guesses[0]


def test_a_shared_residual_scale_adds_without_rounding(quantized: Quantized) -> None:
    adds = [op for op in quantized.core.ops if isinstance(op, Add)]
    assert len(adds) == 3
    for op in adds:
        assert len({quantized.core.frac_bits[name] for name in (*op.inputs, op.output)}) == 1


def test_the_second_gain_is_the_same_correction_coarser(graph: Graph) -> None:
    both = correction(with_copies(graph, DualRange()))
    assert both.shape[1] == 2
    assert_allclose(both[:, 1:] * GAIN, correction(graph), atol=1e-6)


def test_the_fine_copy_is_used_until_it_saturates() -> None:
    scale = 2.0**-11
    fine = np.array([0, 126, -126, 127, -127, -128]) * scale
    coarse = np.array([50, 51, 52, 53, -54, -55]) * scale
    copies = np.stack([fine, coarse]).astype(np.float32)[None, :, None]
    values = DualRange().decode(copies, scale)[0, 0, 0]
    assert_array_equal(values / scale, [0, 126, -126, 53 * GAIN, -54 * GAIN, -55 * GAIN])
    assert FINE_MAX == 126
    one = np.full((1, 1, 2, 2), 127 * scale, np.float32)
    assert Plain().decode(one, scale) is one


def test_all_passes_lose_far_less_than_none(
    float_onnx: onnx.ModelProto, patches: Patches, quantized: Quantized
) -> None:
    def mae(int8: Quantized) -> float:
        return compare(open_session(float_onnx), open_session(int8.host), patches).mae

    few = Passes(dual_range=False, least_squares=False, equalization=False)
    rounded = quantize_model(float_onnx, patches, {}, passes=few)
    last = rounded.core.ops[-1]
    assert isinstance(last, IntConv)
    assert len(last.weight) == 1
    assert mae(quantized) < 0.6 * mae(rounded)


def test_each_step_is_named(float_onnx: onnx.ModelProto, patches: Patches) -> None:
    reported: list[Step] = []
    with reporting(reported.append), progress("calibrating"):
        quickly(float_onnx, patches_of(list(patches.degraded)[:2]))
    names = [step.what.removeprefix("calibrating: ") for step in reported]
    named = dict.fromkeys(name.split(" ")[0] for name in names)
    assert [*named] == ["scale", "float", "equalising", "first", "tensors"]


def test_tensors_next_to_a_group_are_equalised_only_if_that_is_clearly_better(
    float_onnx: onnx.ModelProto, patches: Patches, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ConvBEERS gains next to nothing from it."""
    results = []
    few = patches_of(list(patches.degraded)[:3])
    for share in (0.85, 0.0, 10.0):
        monkeypatch.setattr("beers_deploy.quant.plan.CLEARLY_LESS", share)
        results.append(run_model(quickly(float_onnx, few).host, image(23, 31)))
    usual, never, always = results
    assert_array_equal(usual, never)
    assert (usual != always).any()


def one_scale() -> AbstractContextManager[object]:
    """Force one scale for each residual group, even if separate scales err less."""
    return patch.object(CropTrials, "error", return_value=0.0)


def error_of(quantized: Quantized, model: onnx.ModelProto) -> float:
    """Return the mean error of an INT8 network against the float one, on one image."""
    shown = image(40, 40)
    expected = run_model(model, shown)
    return float(np.abs(run_model(quantized.host, shown) - expected).mean())


def test_sums_that_grow_by_far_have_scales_of_their_own(patches: Patches) -> None:
    model = sketch(
        f"""first = {SAME}(in, first_w, first_b) inner = {SAME}(first, inner_w, inner_b)
        one = Relu(inner) sum = Add(one, first) next = {SAME}(sum, next_w, next_b)
        two = Relu(next) end = Add(two, sum) out = {SAME}(end, last_w, last_b)""",
        sizes={"first": 0.01, "inner": 10, "next": 10},
        first=(8, 1, 3, 3),
        inner=(8, 8, 3, 3),
        next=(8, 8, 3, 3),
        last=(1, 8, 3, 3),
    )
    with one_scale():
        shared = quickly(model, patches)
    apart = quickly(model, patches)
    assert error_of(apart, model) < error_of(shared, model) / 2


def test_a_small_tensor_of_a_group_has_a_finer_scale(patches: Patches) -> None:
    """A layer that amplifies the tensor, as a normalisation does, would amplify its rounding."""
    generator = np.random.default_rng(0)
    weights = {
        "head_w": generator.normal(0, 0.1, (4, 1, 3, 3)),
        "large_w": generator.normal(0, 30, (4, 4, 1, 1)),
        "last_w": generator.normal(0, 0.01, (1, 4, 1, 1)),
    }
    model = parsed(
        """head = Conv<pads=[1,1,1,1]>(x, head_w) inner = Conv(head, large_w)
        sum = Add(head, inner) y = Conv(sum, last_w)""",
        "float[N,1,H,W] x => float[N,1,H,W] y",
        constants=weights,
    )
    finer = quickly(model, patches)
    with one_scale(), patch("beers_deploy.quant.plan.finer_members", return_value={}):
        plain = quickly(model, patches)
    assert finer.core.frac_bits["head"] > plain.core.frac_bits["head"]
    assert error_of(finer, model) < error_of(plain, model) / 2
