"""Tests that activations which a DPU lacks are replaced, exactly or by others that are fitted."""

from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.adapt.compensation import Equations, compensated
from beers_deploy.quant.adapt.kinds import EXACT, Kind, nodes_by_kind
from beers_deploy.quant.adapt.replacements import replaced
from beers_deploy.quant.core import IntConv
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.graph import Activation, Add, Pointwise, read_network, read_planes
from beers_deploy.quant.onnx.graph import OnnxGraph
from beers_deploy.quant.passes.finetune import Tuning, finetune
from beers_deploy.quant.structure import structure_checks
from tests.quant.adapt.images import (
    BARE,
    HELD_OUT,
    SAMPLES,
    assert_same_on_any_size,
    squared_error,
)
from tests.quant.adapt.networks import (
    FEATURES,
    FROM_IMAGE,
    REPLACED,
    SAME,
    Act,
    gated,
    hard_sigmoid,
    leaky,
    mish,
    network,
    prelu,
    silu,
    silu_of_relu,
    tanh,
    weights,
)
from tests.quant.quick import change, changed, quickly, run_model
from tests.quant.simplify.networks import parsed

SLOPES = st.floats(-1, 2)
LEAKY = SLOPES.map(leaky)
PRELUS = st.lists(SLOPES, min_size=FEATURES, max_size=FEATURES).map(lambda each: prelu(*each))
HARD_SIGMOIDS = st.builds(hard_sigmoid, st.floats(0.05, 2), st.floats(-1, 1))


@settings(max_examples=25)
@given(st.one_of(LEAKY, PRELUS, HARD_SIGMOIDS))
def test_slopes_of_any_size_are_replaced_exactly(act: Act) -> None:
    """LeakyReLU and PReLU become two branches and an add, HardSigmoid one of a slope of a sixth.

    `adapt` promises this where the approximation loses too much.
    """
    model = network(act)
    kinds = nodes_by_kind(OnnxGraph(model)).keys()
    exact = replaced(model, (), kinds & EXACT.keys(), {})
    read_network(exact)
    assert_same_on_any_size(model, exact)


def test_one_slope_for_all_channels_and_a_twin_of_each_convolution() -> None:
    """A PReLU of a single slope is replaced exactly too.

    Its second branch repeats the convolution in front of it, or reads through depthwise ones.
    """
    model = network(prelu(0.3))
    exact = replaced(model, (), {Kind.prelu}, {})
    graph = read_network(exact).graph
    # Behind the sum there is no convolution to repeat, so two depthwise ones stand there.
    assert sum(op.name.endswith(".bent") for op in graph) == 2
    assert_same_on_any_size(model, exact)


@pytest.mark.parametrize("name", REPLACED)
def test_compensation_comes_nearer_to_the_original_and_keeps_the_rest(name: str) -> None:
    """Fitted weights remove most of the error of a replacement, on images that they were not fitted
    on.

    Nothing but weights of convolutions changes, so that a user finds the layers of the original
    again.
    """
    act, kind = REPLACED[name]
    model = network(act)
    nodes = nodes_by_kind(OnnxGraph(model))
    assert {key: len(found) for key, found in nodes.items()} == {kind: 3}
    before = replaced(model, {kind}, (), {})
    outputs = [node.outputs[0] for node in nodes[kind]]
    after = compensated(model, before, outputs, SAMPLES.degraded)
    read_network(after)
    assert squared_error(model, after) < 0.3 * squared_error(model, before)
    kinds_before, kinds_after = (
        [(node.op_type, node.name, node.outputs) for node in OnnxGraph(each).nodes]
        for each in (before, after)
    )
    assert kinds_before == kinds_after


ACTS = [*(act for act, _ in REPLACED.values()), prelu(0.2), hard_sigmoid(0.2, 0.5)]


@pytest.mark.parametrize("act", ACTS)
def test_the_refusal_names_adapt(act: Act) -> None:
    """The error about an activation that can be replaced names the option that replaces it."""
    with pytest.raises(ModelError, match=r"quantize --adapt"):
        read_network(network(act))


@pytest.mark.parametrize(
    ("shape", "window"),
    [
        ((4, FEATURES, 3, 3), "strides=[2,2], pads=[1,0,0,1]"),
        ((4, FEATURES, 1, 3), "dilations=[1,2], pads=[0,2,0,2]"),
        ((FEATURES, 1, 3, 3), f"group={FEATURES}, pads=[1,1,1,1]"),
        ((4, FEATURES // 2, 2, 2), "group=2, strides=[1,2]"),
    ],
)
def test_least_squares_find_the_weights_of_any_convolution(
    shape: tuple[int, ...], window: str
) -> None:
    """Weights and bias are found again from samples, for strides, dilations, groups and uneven
    pads.

    The same input is read, so the exact weights are the one best fit.
    """
    nodes = f"a = {SAME}(image, a_w, a_b) r = Relu(a) restored = Conv<{window}>(r, w, b)"
    values = np.random.default_rng(0).normal(0, 1, shape)
    constants = weights("a", FROM_IMAGE) | {"w": values, "b": np.arange(shape[0], dtype=float)}
    model = parsed(nodes, "float[N,1,H,W] image => float[N,C,P,Q] restored", constants=constants)
    wrong = changed(model, "w", np.zeros_like)
    wrong = changed(wrong, "b", np.ones_like)
    fitted = compensated(model, wrong, ["r"], SAMPLES.degraded)
    for pixels in HELD_OUT.degraded:
        expected = run_model(model, pixels)
        # The penalty shrinks directions that hardly occur in the samples.
        error = np.square(run_model(fitted, pixels) - expected).mean()
        assert error < 1e-4 * expected.var()


def test_a_gate_with_no_convolution_behind_it_is_fitted_by_its_scale() -> None:
    """A HardSigmoid over a scaled range is nearer to Sigmoid, even where no convolution behind it
    could take in a line.
    """
    nodes = f"""
        a = {SAME}(image, a_w, a_b) g = Sigmoid(a)
        b = {SAME}(image, b_w, b_b) restored = Mul(b, g)
    """
    constants = weights("a", FROM_IMAGE) | weights("b", FROM_IMAGE)
    model = parsed(nodes, "float[N,1,H,W] image => float[N,C,P,Q] restored", constants=constants)
    before = replaced(model, {Kind.sigmoid}, (), {})
    after = compensated(model, before, ["g"], SAMPLES.degraded)
    assert squared_error(model, after) < 0.7 * squared_error(model, before)


@given(st.integers(1, 20), st.integers(1, 3))
def test_few_results_do_not_fit_weights(unknowns: int, groups: int) -> None:
    """Fewer than eight results for each weight change the bias alone; eight find the weights."""
    generator = np.random.default_rng(unknowns)
    truth = generator.normal(0, 1, (groups, 2, unknowns))
    for count, is_fitted in ((8 * unknowns - 1, False), (8 * unknowns, True)):
        reads = generator.normal(0, 1, (count, groups * unknowns, 1, 1))
        grouped = reads.reshape(count, groups, 1, unknowns)
        errors = (truth * grouped).sum(3).reshape(count, -1) + 3
        equations = Equations(groups, unknowns, 2)
        equations.add(reads, errors)
        change, bias = equations.solved()
        expected = truth.reshape(-1, unknowns) if is_fitted else np.zeros_like(change)
        np.testing.assert_allclose(change, expected, atol=1e-3)
        np.testing.assert_allclose(bias, 3 if is_fitted else errors.mean(0), atol=1e-3)


@pytest.mark.parametrize(
    ("act", "approximated", "exact"),
    [
        (leaky(0.3), (), {Kind.leaky_relu}),
        (leaky(0.3), {Kind.leaky_relu}, ()),
        (prelu(*np.linspace(0, 0.3, FEATURES)), (), {Kind.prelu}),
        (silu_of_relu, {Kind.silu}, ()),
        (gated, {Kind.sigmoid}, ()),
        (tanh, {Kind.tanh}, ()),
        (mish, {Kind.silu}, ()),
    ],
)
def test_the_gate_counts_the_relus_of_an_adapted_network(
    act: Act, approximated: Any, exact: Any
) -> None:
    """The gate reports a ReLU that is lost or added, and none in the correct INT8 network.

    This holds even where HardSwish is computed by the table of a ReLU.
    """
    model = network(act)
    # With scales of some hundreds, the curved part of HardSwish and HardSigmoid is one unit.
    change(model, "a_w", lambda weight: 1e4 * weight)
    core = quickly(replaced(model, approximated, exact, {}), BARE).core
    assert structure_checks(model, host_model(core, {}))[0].value == 0
    for place, op in enumerate(core.ops):
        if op_with_other_relu := with_other_relu(op):
            ops = list(core.ops)
            ops[place] = op_with_other_relu
            host = host_model(replace(core, ops=tuple(ops)), {})
            assert structure_checks(model, host)[0].value == 1


def with_other_relu(op: Any) -> Any:
    """Return an operation with its ReLU removed, or with one added; None if neither is possible."""
    if not isinstance(op, IntConv | Add | Pointwise):
        return None
    if op.activation is Activation.relu:
        return replace(op, activation=Activation.none)
    if isinstance(op, IntConv) and op.activation is Activation.none:
        return replace(op, activation=Activation.relu)
    return None


def test_finetuning_learns_from_the_original() -> None:
    """Fine-tuning that is given the original ends nearer to it than without.

    The training that users ask for anyway then recovers the loss of a replacement.
    """
    model = network(silu)
    near = replaced(model, {Kind.silu}, (), {})
    int8 = quickly(near, BARE)
    graph = read_planes(read_network(near).graph)

    def error(original: onnx.ModelProto | None) -> float:
        tuning = Tuning(BARE.pairs, 40, rate=0.3, original=original)
        # One image a step keeps the steps quick.
        with patch("beers_deploy.quant.passes.finetune.BATCH_PIXELS", 1):
            core, _ = finetune(int8.core, graph, tuning)
        return squared_error(host_model(core, {}), model)

    assert error(model) < 0.8 * error(None)
