"""Activations that a DPU lacks: replaced exactly or by others, compensated, measured, quantised."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import beers_deploy as bd
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.quant.adapt.adaptation import ADAPTED, NEAR_DB, adapt
from beers_deploy.quant.adapt.compensation import compensated
from beers_deploy.quant.adapt.replacements import EXACT, Kind, nodes_by_kind, replaced
from beers_deploy.quant.core import IntConv
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.graph import Activation, Add, Pointwise, Resize, read_network, read_planes
from beers_deploy.quant.onnx.graph import OnnxGraph
from beers_deploy.quant.onnx_file import GraphWriter, image_info, make_model, metadata
from beers_deploy.quant.passes.finetune import Tuning, finetune
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_session, result_of
from beers_deploy.quant.simplify.simplify import simplify
from beers_deploy.quant.structure import structure_checks
from tests.quant.quick import changed, image, one_guess, quickly

FEATURES = 6
Act = Callable[[GraphWriter, str, str], str]
"""Writes an activation: of a tensor, under a name."""


def silu(w: GraphWriter, x: str, name: str) -> str:
    """x * Sigmoid(x), as exporters write it."""
    return w.node("Mul", name, [x, w.node("Sigmoid", f"{name}.gate", [x])])


def quick_gelu(w: GraphWriter, x: str, name: str) -> str:
    """x * Sigmoid(1.702 x), as exporters write it."""
    factor = w.constant("1.702", np.array(1.702, np.float32))
    scaled = w.node("Mul", f"{name}.c", [x, factor])
    gate = w.node("Sigmoid", f"{name}.s", [scaled])
    return w.node("Mul", name, [gate, x])


def gated(w: GraphWriter, x: str, name: str) -> str:
    """A Sigmoid that multiplies another tensor."""
    other = conv(w, x, f"{name}.other")
    gate = w.node("Sigmoid", f"{name}.s", [x])
    return w.node("Mul", name, [other, gate])


def leaky(slope: float) -> Act:
    """LeakyReLU of a slope."""

    return lambda w, x, name: w.node("LeakyRelu", name, [x], alpha=slope)


def prelu(*slopes: float) -> Act:
    """PReLU of one slope, or one a channel."""

    def write(w: GraphWriter, x: str, name: str) -> str:
        values = np.array(slopes, np.float32).reshape(-1, 1, 1)
        return w.node("PRelu", name, [x, w.constant(f"{name}.slope", values)])

    return write


def hard_sigmoid(slope: float, offset: float) -> Act:
    """A HardSigmoid that multiplies another tensor."""

    def write(w: GraphWriter, x: str, name: str) -> str:
        gate = w.node("HardSigmoid", f"{name}.gate", [x], alpha=slope, beta=offset)
        return w.node("Mul", name, [conv(w, x, f"{name}.other"), gate])

    return write


def conv(w: GraphWriter, source: str, name: str, shape: tuple[int, ...] = ()) -> str:
    """A convolution with drawn weights and pads that keep the size."""
    shape = shape or (FEATURES, FEATURES, 3, 3)
    generator = np.random.default_rng(sum(map(ord, name)))
    bound = np.prod(shape[1:]) ** -0.5
    weight = w.constant(f"{name}.w", generator.normal(0, bound, shape).astype(np.float32))
    bias = w.constant(f"{name}.b", generator.normal(0, 0.1, shape[0]).astype(np.float32))
    pads = [shape[2] // 2, shape[3] // 2] * 2
    return w.node("Conv", name, [source, weight, bias], kernel_shape=list(shape[2:]), pads=pads)


def network(act: Act) -> onnx.ModelProto:
    """Three convolutions with an activation behind the first two, and one behind a sum."""
    w = GraphWriter()
    first = act(w, conv(w, "image", "a", (FEATURES, 1, 3, 3)), "first")
    second = act(w, conv(w, first, "b"), "second")
    summed = act(w, w.node("Add", "sum", [first, second]), "third")
    w.node("Add", "restored", ["image", conv(w, summed, "c", (1, FEATURES, 3, 3))])
    result = [image_info("restored", 1, None)]
    return simplify(make_model(w.graph("g", [image_info("image", 1, None)], result), {}), "g")


def patches(count: int, seed: int, px: int = 48) -> Patches:
    """Smooth images with noise, and the same without it."""
    generator = np.random.default_rng(seed)
    rows, columns = np.mgrid[:px, :px] / px
    pairs = []
    for phase in generator.uniform(0, 6, count):
        clean = 0.4 + 0.3 * np.sin(7 * rows + phase) * np.cos(5 * columns - phase)
        noisy = np.clip(clean + 0.03 * generator.standard_normal((px, px)), 0, 1)
        pairs.append(tuple(array[None, None].astype(np.float32) for array in (noisy, clean)))
    return Patches(pairs, [degraded for degraded, _ in pairs])


def attention_network(free: bool) -> onnx.ModelProto:
    """RLFN's attention behind a convolution, for images of 48 pixels or of any size."""
    w = GraphWriter()
    source = conv(w, "image", "a", (FEATURES, 1, 3, 3))
    weight = w.constant("s.w", np.random.default_rng(3).normal(0, 0.3, (FEATURES, FEATURES, 3, 3)))
    half = w.node("Conv", "half", [source, w.node("Cast", "s.f", [weight], to=1)], strides=[2, 2])
    largest = w.node("MaxPool", "largest", [half], kernel_shape=[7, 7], strides=[3, 3])
    inner = conv(w, w.node("Relu", "r", [conv(w, largest, "b")]), "c")
    sizes = w.constant("sizes", np.array([1, FEATURES, 48, 48]))
    if free:
        sizes = w.node("Shape", "shape", [source])
    wide = w.node("Resize", "wide", [inner, "", "", sizes], mode="linear")
    gate = w.node("Sigmoid", "gate", [conv(w, wide, "d", (FEATURES, FEATURES, 1, 1))])
    attended = w.node("Mul", "attended", [source, gate])
    w.node("Add", "restored", ["image", conv(w, attended, "e", (1, FEATURES, 3, 3))])
    px = None if free else 48
    graph = w.graph("g", [image_info("image", 1, px)], [image_info("restored", 1, px)])
    return simplify(make_model(graph, {}), "g")


SAMPLES = patches(8, 0)
HELD_OUT = patches(4, 1)
BARE = Patches([(x, np.empty(0, np.float32)) for x in HELD_OUT.degraded], HELD_OUT.degraded)
SLOPES = st.floats(-1, 2, width=32)


def assert_same(model: onnx.ModelProto, other: onnx.ModelProto) -> None:
    """Check that two networks are equal but for the rounding of float32, on odd sizes too."""
    for size in ((37, 53), (8, 5), (1, 3)):
        pixels = image(*size)
        expected, actual = (result_of(open_session(m), pixels) for m in (model, other))
        np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=2e-6)


@settings(max_examples=15, deadline=None)
@given(
    st.one_of(SLOPES.map(leaky), st.lists(SLOPES, min_size=6, max_size=6).map(lambda s: prelu(*s)))
)
def test_leaky_relu_and_prelu_are_two_branches_and_an_add_exactly(act: Act) -> None:
    model = network(act)
    exact = replaced(model, (), nodes_by_kind(OnnxGraph(model)).keys() & EXACT.keys())
    read_network(exact)
    assert_same(model, exact)


@settings(max_examples=10, deadline=None)
@given(st.floats(0.05, 2), st.floats(-1, 1))
def test_hard_sigmoid_of_any_slope_is_that_of_a_sixth_exactly(slope: float, offset: float) -> None:
    model = network(hard_sigmoid(slope, offset))
    exact = replaced(model, (), {Kind.hard_sigmoid})
    read_network(exact)
    assert_same(model, exact)


def test_one_slope_for_all_channels_and_a_twin_of_each_convolution() -> None:
    model = network(prelu(0.3))
    exact = replaced(model, (), {Kind.prelu})
    graph = read_network(exact).graph
    # Behind the sum there is no convolution to repeat, so two depthwise ones stand there.
    assert sum(op.name.endswith(".bent") for op in graph) == 2
    assert_same(model, exact)


REPLACED = {
    "SiLU": (silu, Kind.silu, 3),
    "quick GELU": (quick_gelu, Kind.silu, 3),
    "Sigmoid": (gated, Kind.sigmoid, 3),
    "LeakyReLU": (leaky(0.2), Kind.leaky_relu, 3),
    "PReLU": (prelu(*np.linspace(0.05, 0.3, FEATURES)), Kind.prelu, 3),
}


@pytest.mark.parametrize("name", REPLACED)
def test_compensation_comes_nearer_to_the_original_and_keeps_the_rest(name: str) -> None:
    act, kind, count = REPLACED[name]
    model = network(act)
    nodes = nodes_by_kind(OnnxGraph(model))
    assert {key: len(found) for key, found in nodes.items()} == {kind: count}
    before = replaced(model, {kind}, ())
    outputs = [node.outputs[0] for node in nodes[kind]]
    after = compensated(model, before, outputs, SAMPLES.degraded)
    read_network(after)
    errors = []
    for candidate in (before, after):
        sessions = open_session(model), open_session(candidate)
        results = [[result_of(s, x) for s in sessions] for x in HELD_OUT.degraded]
        errors.append(np.mean([np.square(a - b).mean() for a, b in results]))
    assert errors[1] < 0.3 * errors[0]
    # All other nodes and weights stay as they are.
    names = [{n.name: n for n in OnnxGraph(m).nodes if n.op_type == "Conv"} for m in (model, after)]
    assert names[0].keys() == names[1].keys()
    others = [
        [n.written() for n in OnnxGraph(m).nodes if n.op_type != "Conv"] for m in (before, after)
    ]
    assert others[0] == others[1]


@pytest.mark.parametrize(
    ("shape", "attributes"),
    [
        ((4, FEATURES, 3, 3), {"strides": [2, 2], "pads": [1, 0, 0, 1]}),
        ((4, FEATURES, 1, 3), {"dilations": [1, 2], "pads": [0, 2, 0, 2]}),
        ((FEATURES, 1, 3, 3), {"group": FEATURES, "pads": [1, 1, 1, 1]}),
        ((4, FEATURES // 2, 2, 2), {"group": 2, "strides": [1, 2]}),
    ],
)
def test_least_squares_find_the_weights_of_any_convolution(
    shape: tuple[int, ...], attributes: dict[str, Any]
) -> None:
    w = GraphWriter()
    w.node("Relu", "changed", [conv(w, "image", "a", (FEATURES, 1, 3, 3))])
    weight = np.random.default_rng(0).normal(0, 1, shape).astype(np.float32)
    names = [w.constant("w", weight), w.constant("b", np.arange(shape[0], dtype=np.float32))]
    w.node("Conv", "restored", ["changed", *names], kernel_shape=list(shape[2:]), **attributes)
    result = [onnx.helper.make_tensor_value_info("restored", onnx.TensorProto.FLOAT, None)]
    model = make_model(w.graph("g", [image_info("image", 1, None)], result), {})
    wrong = changed(changed(model, "w", np.zeros_like), "b", np.ones_like)
    fitted = compensated(model, wrong, ["changed"], SAMPLES.degraded)
    for pixels in HELD_OUT.degraded:
        expected, actual = (result_of(open_session(m), pixels) for m in (model, fitted))
        # The penalty holds back directions that the samples hardly have.
        assert np.square(actual - expected).mean() < 1e-4 * expected.var()


def test_an_exact_replacement_is_chosen_where_the_other_loses_too_much() -> None:
    near = adapt(network(leaky(0.1)), BARE, BARE)
    far = adapt(network(leaky(-0.9)), BARE, BARE)
    assert "compensated" in near.record
    assert "exactly" in far.record
    assert_same(network(leaky(-0.9)), far.model)
    (kind, together) = (row.figures["PSNR to the original, compensated"] for row in far.rows)
    assert kind.value is not None
    assert kind.value < NEAR_DB
    assert together.value is None or together.value > 100


def test_without_references_the_original_decides() -> None:
    figures = adapt(network(silu), BARE, BARE).rows[-1].figures
    assert figures["PSNR lost, compensated"].mode == "unavailable"
    values = [
        figures[f"PSNR to the original, {name}"].value for name in ("replaced", "compensated")
    ]
    assert (values[1] or 0) > (values[0] or 99) + 5


def test_what_a_dpu_has_and_what_nothing_replaces_stays() -> None:
    def tanh(w: GraphWriter, x: str, name: str) -> str:
        return w.node("Tanh", name, [x])

    for act in (leaky(26 / 256), tanh):
        model = network(act)
        assert adapt(model, SAMPLES, HELD_OUT).model is model
    with pytest.raises(ModelError, match="Tanh first"):
        read_network(network(tanh))
    # Refused before anything is fitted, next to what is replaced as well.
    with pytest.raises(ModelError, match="Tanh third"):
        adapt(
            network(lambda w, x, name: (tanh if name == "third" else silu)(w, x, name)), BARE, BARE
        )


def test_prelu_of_the_dpus_own_slope_becomes_its_leaky_relu() -> None:
    model = network(prelu(*[26 / 256] * FEATURES))
    adapted = adapt(model, BARE, BARE)
    assert "compensated" in adapted.record
    assert_same(model, adapted.model)


@pytest.mark.parametrize("act", [silu, leaky(0.2), prelu(0.2), hard_sigmoid(0.2, 0.5)])
def test_the_refusal_names_adapt(act: Act) -> None:
    with pytest.raises(ModelError, match=r"quantize --adapt"):
        read_network(network(act))


@pytest.mark.parametrize("name", ["SiLU", "LeakyReLU"])
def test_quantize_adapts_and_compares_with_the_original(name: str, tmp_path: Path) -> None:
    act, *_ = REPLACED[name]
    original = network(act)
    samples = [np.concatenate(arrays) for arrays in zip(*SAMPLES.pairs, strict=True)]
    with pytest.raises(ModelError, match="adapt"):
        bd.quantize(original, samples=tuple(samples), progress=False)
    with one_guess():
        int8 = bd.quantize(original, samples=tuple(samples), adapt=True, progress=False)
    assert int8.origin is not None
    assert {n.op_type for n in int8.origin.model.graph.node} & {"Sigmoid", "LeakyRelu"}
    assert name in metadata(int8.model)[ADAPTED]
    assert int8.table is not None
    rows = [row for row in int8.table.rows if row.table == ADAPTED]
    assert [row.name for row in rows] == ["3 " + REPLACED[name][1], "all"]
    held_out = [np.concatenate(arrays) for arrays in zip(*HELD_OUT.pairs, strict=True)]
    path = int8.save(tmp_path / "int8.onnx")
    verdict = bd.compare(original, path, samples=tuple(held_out), progress=False)
    assert verdict.result.psnr_between_db > 30


@pytest.mark.parametrize(
    ("act", "approximated", "exact"),
    [
        (leaky(0.3), (), {Kind.leaky_relu}),
        (leaky(0.3), {Kind.leaky_relu}, ()),
        (prelu(*np.linspace(0, 0.3, FEATURES)), (), {Kind.prelu}),
        (lambda w, x, name: silu(w, w.node("Relu", f"{name}.r", [x]), name), {Kind.silu}, ()),
        (gated, {Kind.sigmoid}, ()),
    ],
)
def test_the_gate_counts_the_relus_of_an_adapted_network(
    act: Act, approximated: Any, exact: Any
) -> None:
    """None is reported lost or added, unless one is, even where HardSwish is a ReLU's table."""
    model = network(act)
    # On scales of some hundreds all of HardSwish and HardSigmoid that bends is one unit.
    for values in model.graph.initializer:
        if values.name == "a.w":
            weight = 1e4 * onnx.numpy_helper.to_array(values)
            values.CopyFrom(onnx.numpy_helper.from_array(weight, "a.w"))
    int8 = quickly(replaced(model, approximated, exact), BARE)

    def relus_off(ops: Any) -> float:
        host = host_model(dataclasses.replace(int8.core, ops=tuple(ops)), {})
        return structure_checks(model, host)[0].value

    assert relus_off(int8.core.ops) == 0
    ops = list(int8.core.ops)
    for place, op in enumerate(ops):
        if isinstance(op, IntConv | Add | Pointwise) and op.activation is Activation.relu:
            lost = dataclasses.replace(op, activation=Activation.none)
            assert relus_off([*ops[:place], lost, *ops[place + 1 :]]) == 1
        if isinstance(op, IntConv) and op.activation is Activation.none:
            added = dataclasses.replace(op, activation=Activation.relu)
            assert relus_off([*ops[:place], added, *ops[place + 1 :]]) == 1


@pytest.mark.parametrize("free", [False, True])
def test_spatial_attention_is_aligned_and_compensated(free: bool) -> None:
    """The refusal names `adapt`, and the result is nearer than a network without attention."""
    model = attention_network(free)
    with pytest.raises(ModelError, match=r"no whole factor. 'quantize --adapt'"):
        read_network(model)
    adapted = adapt(model, SAMPLES, HELD_OUT)
    assert [row.name for row in adapted.rows] == ["1 spatial attention (ESA)", "1 Sigmoid", "all"]
    resizes = [op for op in read_network(adapted.model).graph if isinstance(op, Resize)]
    assert [op.factor for op in resizes] == [4, 2]
    even = [node.attributes.get("strides") for node in OnnxGraph(adapted.model).nodes]
    assert [4, 4] in even
    near = adapted.rows[-1].figures["PSNR to the original, compensated"].value
    assert near is not None
    assert near > 40


def test_finetuning_learns_from_the_original() -> None:
    model = network(silu)
    near = replaced(model, {Kind.silu}, ())
    int8 = quickly(near, BARE)
    errors = []
    for original in (None, model):
        tuning = Tuning(BARE.pairs, 40, rate=0.3, original=original)
        # One image a step, so that the steps are quick.
        with patch("beers_deploy.quant.passes.finetune.BATCH_PIXELS", 1):
            core, _ = finetune(int8.core, read_planes(read_network(near).graph), tuning)
        session = open_session(host_model(core, {}))
        sessions = session, open_session(model)
        results = [[result_of(s, x) for s in sessions] for x in BARE.degraded]
        errors.append(np.mean([np.square(a - b).mean() for a, b in results]))
    assert errors[1] < 0.8 * errors[0]


def test_nothing_to_replace_is_a_note_and_conditioned_weights_are_refused() -> None:
    samples = np.concatenate(SAMPLES.degraded)
    with one_guess():
        int8 = bd.quantize(network(leaky(26 / 256)), samples=samples, adapt=True, progress=False)
    assert int8.table is not None
    assert any("replaced nothing" in note for note in int8.table.notes)
    with pytest.raises(OptionError, match="`adapt` has no effect"):
        bd.quantize("convbeers-xs", adapt=True)
