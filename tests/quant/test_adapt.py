"""Tests that activations which a DPU lacks are replaced, compensated, measured and quantised."""

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
from beers_deploy.quant.adapt.adaptation import ADAPTED, NEAR_DB, Adapted, adapt
from beers_deploy.quant.adapt.compensation import Equations, compensated
from beers_deploy.quant.adapt.kinds import EXACT, Kind, nodes_by_kind
from beers_deploy.quant.adapt.replacements import replaced
from beers_deploy.quant.core import IntConv
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.graph import Activation, Add, Pointwise, Resize, read_network, read_planes
from beers_deploy.quant.onnx.graph import OnnxGraph
from beers_deploy.quant.onnx.image_input import image_info
from beers_deploy.quant.onnx_file import GraphWriter, make_model, metadata
from beers_deploy.quant.passes.finetune import Tuning, finetune
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_session, result_of
from beers_deploy.quant.simplify.simplify import simplify
from beers_deploy.quant.structure import structure_checks
from tests.quant.quick import change, changed, image, one_guess, patches_of, quickly
from tests.quant.tiling.small_networks import check_tiles

FEATURES = 6
IMAGE_WEIGHTS = (FEATURES, 1, 3, 3)
RESULT_WEIGHTS = (1, FEATURES, 3, 3)
DPU_SLOPE = 26 / 256
"""The one slope of a LeakyReLU that a DPU computes."""
TO_ORIGINAL = "PSNR to the original, compensated"
Act = Callable[[GraphWriter, str, str], str]
"""A function that writes an activation of a tensor under a name."""


def silu(w: GraphWriter, x: str, name: str) -> str:
    """Write x * Sigmoid(x) as exporters do."""
    gate = w.node("Sigmoid", f"{name}.gate", [x])
    return w.node("Mul", name, [x, gate])


def mish(w: GraphWriter, x: str, name: str) -> str:
    """Write x * Tanh(Softplus(x)) as exporters do."""
    gate = w.node("Tanh", f"{name}.t", [w.node("Softplus", f"{name}.s", [x])])
    return w.node("Mul", name, [x, gate])


def quick_gelu(w: GraphWriter, x: str, name: str) -> str:
    """Write x * Sigmoid(1.702 x) as exporters do."""
    factor = w.constant("1.702", np.array(1.702, np.float32))
    scaled = w.node("Mul", f"{name}.c", [x, factor])
    gate = w.node("Sigmoid", f"{name}.s", [scaled])
    return w.node("Mul", name, [gate, x])


def gelu(divides: bool) -> Act:
    """Return the GELU as exporters write it: they divide by sqrt(2), or multiply."""

    def write(w: GraphWriter, x: str, name: str) -> str:
        """Write the operators in the order of the exporter."""
        half = w.constant("half", np.array(0.5, np.float32))
        one = w.constant("one", np.array(1, np.float32))
        root = 2**0.5 if divides else 2**-0.5
        scale = w.constant("root", np.array(root, np.float32))
        scaled = w.node("Div" if divides else "Mul", f"{name}.scaled", [x, scale])
        gate = w.node("Add", f"{name}.gate", [w.node("Erf", f"{name}.erf", [scaled]), one])
        if divides:
            return w.node("Mul", name, [w.node("Mul", f"{name}.both", [x, gate]), half])
        return w.node("Mul", name, [w.node("Mul", f"{name}.half", [half, x]), gate])

    return write


def halved_gelu(w: GraphWriter, x: str, name: str) -> str:
    """Write the GELU as x * ((1 + Erf(x / sqrt(2))) / 2), as torch does for opset 19."""
    half, one, root = (
        w.constant(key, np.array(value, np.float32))
        for key, value in {"half": 0.5, "one": 1, "root": 2**0.5}.items()
    )
    erf = w.node("Erf", f"{name}.erf", [w.node("Div", f"{name}.scaled", [x, root])])
    gate = w.node("Add", f"{name}.gate", [erf, one])
    return w.node("Mul", name, [x, w.node("Mul", f"{name}.half", [half, gate])])


def tanh_gelu(half_first: bool) -> Act:
    """Return the GELU of Tanh: torch multiplies the half last, or first, by hand."""

    def write(w: GraphWriter, x: str, name: str) -> str:
        """Write the operators in the order of the exporter."""
        half, one, three, small, root = (
            w.constant(key, np.array(value, np.float32))
            for key, value in {
                "half": 0.5,
                "one": 1,
                "three": 3,
                "small": 0.044715,
                "root": (2 / np.pi) ** 0.5,
            }.items()
        )
        cube = w.node("Pow", f"{name}.cube", [x, three])
        total = w.node("Add", f"{name}.sum", [x, w.node("Mul", f"{name}.small", [small, cube])])
        tanh = w.node("Tanh", f"{name}.tanh", [w.node("Mul", f"{name}.scaled", [root, total])])
        gate = w.node("Add", f"{name}.gate", [tanh, one])
        if half_first:
            return w.node("Mul", name, [w.node("Mul", f"{name}.half", [x, half]), gate])
        return w.node("Mul", name, [half, w.node("Mul", f"{name}.both", [x, gate])])

    return write


def tanh(w: GraphWriter, x: str, name: str) -> str:
    return w.node("Tanh", name, [x])


def gated(w: GraphWriter, x: str, name: str) -> str:
    """Write a Sigmoid that multiplies another tensor."""
    other = conv(w, x, f"{name}.other")
    gate = w.node("Sigmoid", f"{name}.s", [x])
    return w.node("Mul", name, [other, gate])


def leaky(slope: float) -> Act:
    """Return a LeakyReLU of a slope."""
    return lambda w, x, name: w.node("LeakyRelu", name, [x], alpha=slope)


def prelu(*slopes: float) -> Act:
    """Return a PReLU of one slope, or of one for each channel."""

    def write(w: GraphWriter, x: str, name: str) -> str:
        """Write the slopes and the PRelu that reads them."""
        values = np.array(slopes, np.float32).reshape(-1, 1, 1)
        slope = w.constant(f"{name}.slope", values)
        return w.node("PRelu", name, [x, slope])

    return write


def hard_sigmoid(slope: float, offset: float) -> Act:
    """Return a HardSigmoid that multiplies another tensor."""

    def write(w: GraphWriter, x: str, name: str) -> str:
        """Write the gate, another tensor, and their product."""
        gate = w.node("HardSigmoid", f"{name}.gate", [x], alpha=slope, beta=offset)
        other = conv(w, x, f"{name}.other")
        return w.node("Mul", name, [other, gate])

    return write


def conv(w: GraphWriter, source: str, name: str, shape: tuple[int, ...] = ()) -> str:
    """Write a convolution with random weights and pads that keep the size."""
    shape = shape or (FEATURES, FEATURES, 3, 3)
    generator = np.random.default_rng(sum(map(ord, name)))
    bound = np.prod(shape[1:]) ** -0.5
    weights = generator.normal(0, bound, shape).astype(np.float32)
    biases = generator.normal(0, 0.1, shape[0]).astype(np.float32)
    weight = w.constant(f"{name}.w", weights)
    bias = w.constant(f"{name}.b", biases)
    kernel = list(shape[2:])
    pads = [side // 2 for side in kernel] * 2
    return w.node("Conv", name, [source, weight, bias], kernel_shape=kernel, pads=pads)


def finished(w: GraphWriter, px: int | None = None) -> onnx.ModelProto:
    """Return the network from `image` to `restored`, simplified, for images of `px` pixels or any
    size.
    """
    image_in = image_info("image", 1, px)
    image_out = image_info("restored", 1, px)
    graph = w.graph("g", [image_in], [image_out])
    return simplify(make_model(graph, {}), "g")


def network(act: Act) -> onnx.ModelProto:
    """Build three convolutions, with activations behind the first two and behind a sum."""
    w = GraphWriter()
    a = conv(w, "image", "a", IMAGE_WEIGHTS)
    first = act(w, a, "first")
    b = conv(w, first, "b")
    second = act(w, b, "second")
    added = w.node("Add", "sum", [first, second])
    third = act(w, added, "third")
    correction = conv(w, third, "c", RESULT_WEIGHTS)
    w.node("Add", "restored", ["image", correction])
    return finished(w)


def one_image(pixels: np.ndarray) -> np.ndarray:
    """Return pixels (H, W) as a batch of one image of one channel."""
    return pixels[None, None].astype(np.float32)


def patches(count: int, seed: int, px: int = 48) -> Patches:
    """Return smooth images with noise, and the same without it as references."""
    generator = np.random.default_rng(seed)
    rows, columns = np.mgrid[:px, :px] / px
    pairs = []
    for phase in generator.uniform(0, 6, count):
        clean = 0.4 + 0.3 * np.sin(7 * rows + phase) * np.cos(5 * columns - phase)
        noise = generator.standard_normal((px, px))
        noisy = np.clip(clean + 0.03 * noise, 0, 1)
        pairs.append((one_image(noisy), one_image(clean)))
    return Patches(pairs, [degraded for degraded, _ in pairs])


def attention_network(free: bool) -> onnx.ModelProto:
    """Build RLFN's attention behind a convolution, for images of 48 pixels or of any size."""
    w = GraphWriter()
    source = conv(w, "image", "a", IMAGE_WEIGHTS)
    values = np.random.default_rng(3).normal(0, 0.3, (FEATURES, FEATURES, 3, 3))
    doubles = w.constant("s.w", values)
    weight = w.node("Cast", "s.f", [doubles], to=1)
    half = w.node("Conv", "half", [source, weight], strides=[2, 2])
    largest = w.node("MaxPool", "largest", [half], kernel_shape=[7, 7], strides=[3, 3])
    b = conv(w, largest, "b")
    relu = w.node("Relu", "r", [b])
    inner = conv(w, relu, "c")
    sizes = w.constant("sizes", np.array([1, FEATURES, 48, 48]))
    if free:
        sizes = w.node("Shape", "shape", [source])
    wide = w.node("Resize", "wide", [inner, "", "", sizes], mode="linear")
    mixed = conv(w, wide, "d", (FEATURES, FEATURES, 1, 1))
    gate = w.node("Sigmoid", "gate", [mixed])
    attended = w.node("Mul", "attended", [source, gate])
    correction = conv(w, attended, "e", RESULT_WEIGHTS)
    w.node("Add", "restored", ["image", correction])
    return finished(w, None if free else 48)


def contrast_network(px: int, factor: float) -> onnx.ModelProto:
    """Build IMDN's attention (CCA) behind a convolution: its variance is scaled by a factor."""
    w = GraphWriter()
    source = conv(w, "image", "a", IMAGE_WEIGHTS)
    rows, columns = (w.constant(f"axis{axis}", np.array([axis])) for axis in (2, 3))
    count = w.constant("count", np.array(px**2, np.float32))
    exponents = [w.constant(f"e{n}", np.array(n, np.float32)) for n in (2, 0.5)]

    def mean(x: str, name: str) -> str:
        inner = w.node("ReduceSum", f"{name}.s", [x, columns])
        return w.node("Div", name, [w.node("ReduceSum", f"{name}.t", [inner, rows]), count])

    average = mean(source, "mean")
    difference = w.node("Sub", "difference", [source, average])
    variance = mean(w.node("Pow", "square", [difference, exponents[0]]), "variance")
    if factor != 1:
        scale = w.constant("factor", np.array(factor, np.float32))
        variance = w.node("Mul", "scaled", [variance, scale])
    contrast = w.node("Add", "contrast", [w.node("Pow", "root", [variance, exponents[1]]), average])
    gate = w.node("Sigmoid", "gate", [conv(w, contrast, "d", (FEATURES, FEATURES, 1, 1))])
    attended = w.node("Mul", "attended", [source, gate])
    correction = conv(w, attended, "e", RESULT_WEIGHTS)
    w.node("Add", "restored", ["image", correction])
    return finished(w, px)


SAMPLES = patches(8, 0)
HELD_OUT = patches(4, 1)
BARE = Patches([(x, np.empty(0, np.float32)) for x in HELD_OUT.degraded], HELD_OUT.degraded)
SLOPES = st.floats(-1, 2, width=32)


def assert_same(model: onnx.ModelProto, other: onnx.ModelProto) -> None:
    """Check that two networks are equal but for the rounding of float32, on odd sizes too."""
    for size in ((37, 53), (8, 5), (1, 3)):
        pixels = image(*size)
        expected = result_of(open_session(model), pixels)
        actual = result_of(open_session(other), pixels)
        np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=2e-6)


def assert_near(adapted: Adapted, least_db: float) -> None:
    """Check the PSNR of an adapted network to the original one."""
    near = adapted.rows[-1].figures[TO_ORIGINAL].value
    assert near is not None
    assert near > least_db


def squared_error(model: onnx.ModelProto, other: onnx.ModelProto) -> float:
    """Return the mean squared difference between two networks on the held-out images."""
    session = open_session(model)
    other_session = open_session(other)
    errors = []
    for pixels in HELD_OUT.degraded:
        difference = result_of(session, pixels) - result_of(other_session, pixels)
        errors.append(np.square(difference).mean())
    return float(np.mean(errors))


LEAKY = SLOPES.map(leaky)
SLOPE_OF_EACH = st.lists(SLOPES, min_size=FEATURES, max_size=FEATURES)
PRELUS = SLOPE_OF_EACH.map(lambda slopes: prelu(*slopes))


@settings(max_examples=15, deadline=None)
@given(st.one_of(LEAKY, PRELUS))
def test_leaky_relu_and_prelu_are_two_branches_and_an_add_exactly(act: Act) -> None:
    """Any slopes are replaced without a loss, by operators that the quantizer reads.

    `adapt` promises this where the approximation loses too much.
    """
    model = network(act)
    kinds = nodes_by_kind(OnnxGraph(model)).keys()
    exact = replaced(model, (), kinds & EXACT.keys(), {})
    read_network(exact)
    assert_same(model, exact)


@settings(max_examples=10, deadline=None)
@given(st.floats(0.05, 2), st.floats(-1, 1))
def test_hard_sigmoid_of_any_slope_becomes_one_of_a_sixth_exactly(
    slope: float, offset: float
) -> None:
    """A HardSigmoid of any slope and offset becomes one of a slope of a sixth without a loss.

    The slope of a sixth is the one that a DPU computes.
    """
    model = network(hard_sigmoid(slope, offset))
    exact = replaced(model, (), {Kind.hard_sigmoid}, {})
    read_network(exact)
    assert_same(model, exact)


def test_one_slope_for_all_channels_and_a_twin_of_each_convolution() -> None:
    """A PReLU of a single slope is replaced exactly too.

    Its second branch repeats the convolution in front of it, or reads through depthwise ones.
    """
    model = network(prelu(0.3))
    exact = replaced(model, (), {Kind.prelu}, {})
    graph = read_network(exact).graph
    # Behind the sum there is no convolution to repeat, so two depthwise ones stand there.
    assert sum(op.name.endswith(".bent") for op in graph) == 2
    assert_same(model, exact)


REPLACED = {
    "SiLU": (silu, Kind.silu, 3),
    "quick GELU": (quick_gelu, Kind.silu, 3),
    "GELU, divided": (gelu(divides=True), Kind.silu, 3),
    "GELU, multiplied": (gelu(divides=False), Kind.silu, 3),
    "Sigmoid": (gated, Kind.sigmoid, 3),
    "GELU, halved in the gate": (halved_gelu, Kind.silu, 3),
    "GELU of Tanh": (tanh_gelu(half_first=False), Kind.silu, 3),
    "GELU of Tanh, half first": (tanh_gelu(half_first=True), Kind.silu, 3),
    "Mish": (mish, Kind.silu, 3),
    "Tanh": (tanh, Kind.tanh, 3),
    "LeakyReLU": (leaky(0.2), Kind.leaky_relu, 3),
    "PReLU": (prelu(*np.linspace(0.05, 0.3, FEATURES)), Kind.prelu, 3),
}


@pytest.mark.parametrize("name", REPLACED)
def test_compensation_comes_nearer_to_the_original_and_keeps_the_rest(name: str) -> None:
    """Fitted weights remove most of the error of a replacement, on images that they were not fitted
    on.

    Nothing but weights of convolutions changes, so that a user finds the layers of the original
    again.
    """
    act, kind, count = REPLACED[name]
    model = network(act)
    nodes = nodes_by_kind(OnnxGraph(model))
    assert {key: len(found) for key, found in nodes.items()} == {kind: count}
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
    """Weights and bias are found again from samples, for strides, dilations, groups and uneven
    pads.

    The same input is read, so the exact weights are the one best fit.
    """
    w = GraphWriter()
    a = conv(w, "image", "a", IMAGE_WEIGHTS)
    w.node("Relu", "changed", [a])
    values = np.random.default_rng(0).normal(0, 1, shape).astype(np.float32)
    weight = w.constant("w", values)
    bias = w.constant("b", np.arange(shape[0], dtype=np.float32))
    inputs = ["changed", weight, bias]
    w.node("Conv", "restored", inputs, kernel_shape=list(shape[2:]), **attributes)
    # Some of these convolutions give a map of another size and number of channels.
    result = onnx.helper.make_tensor_value_info("restored", onnx.TensorProto.FLOAT, None)
    graph = w.graph("g", [image_info("image", 1, None)], [result])
    model = make_model(graph, {})
    wrong = changed(model, "w", np.zeros_like)
    wrong = changed(wrong, "b", np.ones_like)
    fitted = compensated(model, wrong, ["changed"], SAMPLES.degraded)
    for pixels in HELD_OUT.degraded:
        expected = result_of(open_session(model), pixels)
        actual = result_of(open_session(fitted), pixels)
        # The penalty shrinks directions that hardly occur in the samples.
        assert np.square(actual - expected).mean() < 1e-4 * expected.var()


def test_an_exact_replacement_is_chosen_where_the_other_loses_too_much() -> None:
    """A slope near the DPU's own is approximated, one far from it is replaced exactly.

    Exact replacements take more operations, so they are worth it for the second alone.
    """
    near = adapt(network(leaky(0.1)), BARE, BARE)
    assert "compensated" in near.record
    assert near.rows[-1].figures["PSNR lost, compensated"].mode == "unavailable"
    steep = network(leaky(-0.9))
    far = adapt(steep, BARE, BARE)
    assert "exactly" in far.record
    assert_same(steep, far.model)
    kind, together = (row.figures[TO_ORIGINAL] for row in far.rows)
    assert kind.value is not None
    assert kind.value < NEAR_DB
    assert together.value is None or together.value > 100


def elu(w: GraphWriter, x: str, name: str) -> str:
    """Write an ELU, which nothing replaces."""
    return w.node("Elu", name, [x])


def silu_but_elu_third(w: GraphWriter, x: str, name: str) -> str:
    """Write SiLU twice, and an ELU in the place of the third activation."""
    act = elu if name == "third" else silu
    return act(w, x, name)


def test_activations_that_are_supported_or_irreplaceable_stay() -> None:
    """A network without anything to replace is returned as it is.

    An operator without a replacement is refused by its name before time is spent on a fit.
    """
    for act in (leaky(DPU_SLOPE), elu):
        model = network(act)
        assert adapt(model, SAMPLES, HELD_OUT).model is model
    with pytest.raises(ModelError, match="Elu first"):
        read_network(network(elu))
    # The refusal comes before any fit, even if other activations can be replaced.
    with pytest.raises(ModelError, match="Elu third"):
        adapt(network(silu_but_elu_third), BARE, BARE)


@pytest.mark.parametrize("act", [prelu(0.2), hard_sigmoid(0.2, 0.5), gelu(True), mish])
def test_the_refusal_names_adapt(act: Act) -> None:
    """The error about an activation that can be replaced names the option that replaces it."""
    with pytest.raises(ModelError, match=r"quantize --adapt"):
        read_network(network(act))


def batches(pairs: Patches) -> tuple[np.ndarray, np.ndarray]:
    """Return degraded images and references, each as one array (N, 1, H, W)."""
    degraded = np.concatenate([image for image, _ in pairs.pairs])
    references = np.concatenate([reference for _, reference in pairs.pairs])
    return degraded, references


@pytest.mark.parametrize("name", ["SiLU", "LeakyReLU"])
def test_quantize_adapts_and_compares_with_the_original(name: str, tmp_path: Path) -> None:
    """`quantize` refuses the network without `adapt`, and with it reports what was replaced.

    The INT8 file is compared with the original and not with its replacement, so that no loss is
    hidden.
    """
    act, kind, count = REPLACED[name]
    original = network(act)
    samples = batches(SAMPLES)
    with pytest.raises(ModelError, match="adapt"):
        bd.quantize(original, samples=samples, progress=False)
    with one_guess():
        int8 = bd.quantize(original, samples=samples, adapt=True, progress=False)
    assert int8.origin is not None
    original_kinds = {node.op_type for node in int8.origin.model.graph.node}
    assert original_kinds & {"Sigmoid", "LeakyRelu"}
    assert name in metadata(int8.model)[ADAPTED]
    assert int8.table is not None
    rows = [row.name for row in int8.table.rows if row.table == ADAPTED]
    assert rows == [f"{count} {kind}", "all"]
    path = int8.save(tmp_path / "int8.onnx")
    verdict = bd.compare(original, path, samples=batches(HELD_OUT), progress=False)
    assert verdict.result.psnr_between_db > 30


def silu_of_relu(w: GraphWriter, x: str, name: str) -> str:
    """Write SiLU behind a ReLU."""
    relu = w.node("Relu", f"{name}.r", [x])
    return silu(w, relu, name)


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
    change(model, "a.w", lambda weight: 1e4 * weight)
    int8 = quickly(replaced(model, approximated, exact, {}), BARE)

    def relus_off(ops: Any) -> float:
        """Return the number of ReLUs that the gate finds lost or added."""
        host = host_model(dataclasses.replace(int8.core, ops=tuple(ops)), {})
        return structure_checks(model, host)[0].value

    assert relus_off(int8.core.ops) == 0
    for place, op in enumerate(int8.core.ops):
        ops = list(int8.core.ops)
        if isinstance(op, IntConv | Add | Pointwise) and op.activation is Activation.relu:
            ops[place] = dataclasses.replace(op, activation=Activation.none)
            assert relus_off(ops) == 1
        if isinstance(op, IntConv) and op.activation is Activation.none:
            ops[place] = dataclasses.replace(op, activation=Activation.relu)
            assert relus_off(ops) == 1


@pytest.mark.parametrize("free", [False, True])
def test_spatial_attention_is_aligned_and_compensated(free: bool) -> None:
    """The refusal names `adapt`, and the adapted network is near to the original.

    Its resize becomes two of powers of two, for images of one size and of any size.
    """
    model = attention_network(free)
    with pytest.raises(ModelError, match=r"no whole factor. 'quantize --adapt'"):
        read_network(model)
    adapted = adapt(model, SAMPLES, HELD_OUT)
    assert [row.name for row in adapted.rows] == ["1 spatial attention (ESA)", "1 Sigmoid", "all"]
    graph = read_network(adapted.model).graph
    assert [op.factor for op in graph if isinstance(op, Resize)] == [4, 2]
    strides = [node.attributes.get("strides") for node in OnnxGraph(adapted.model).nodes]
    assert [4, 4] in strides
    assert_near(adapted, 40)


@pytest.mark.parametrize("factor", [1, 4])
def test_a_standard_deviation_becomes_the_mean_absolute_deviation(factor: float) -> None:
    """The refusal names `adapt`, the network stays near, and the gate counts the ReLU for it."""
    model = contrast_network(48, factor)
    with pytest.raises(ModelError, match=r"standard deviation .* 'quantize --adapt'"):
        read_network(model)
    adapted = adapt(model, BARE, BARE)
    assert adapted.rows[0].name == "1 standard deviation over the image"
    assert_near(adapted, 50)
    int8 = quickly(adapted.model, BARE)
    assert structure_checks(model, int8.host)[0].value == 0


def enlarging(mode: str, where: str, factor: int, adds: str = "") -> onnx.ModelProto:
    """Build convolutions of the enlarged image, to which the "result" or a map "within" is added if
    asked.
    """
    w = GraphWriter()
    scales = w.constant("scales", np.array([1, 1, factor, factor], np.float32))
    attributes: dict[str, Any] = {
        "mode": mode,
        "coordinate_transformation_mode": where,
        "cubic_coeff_a": -0.75,
    }
    wide = w.node("Resize", "wide", ["image", "", scales], **attributes)
    first = w.node("Relu", "first", [conv(w, wide, "a", IMAGE_WEIGHTS)])
    correction = conv(w, first, "b", RESULT_WEIGHTS)
    total = w.node("Add", "sum", [correction, wide if adds else correction])
    if adds == "within":
        total = conv(w, total, "c", (1, 1, 3, 3))
    w.node("Identity", "restored", [total])
    return finished(w)


@pytest.mark.parametrize(
    ("where", "factor"), [("align_corners", 2), ("asymmetric", 4), ("half_pixel", 8)]
)
def test_bilinear_enlargement_has_half_pixel_centres(where: str, factor: int) -> None:
    """It is near to the original, and of the network's sizes."""
    model = enlarging("linear", where, factor)
    with pytest.raises(ModelError, match=r"half-pixel centres.*'quantize --adapt'"):
        read_network(model)
    adapted = adapt(model, BARE, BARE)
    assert adapted.rows[0].name == "1 other bilinear enlargement"
    assert_near(adapted, 30)
    resizes = [op for op in read_network(adapted.model).graph if isinstance(op, Resize)]
    assert all(op.bilinear for op in resizes)
    assert [op.factor for op in resizes] == ([4, 2] if factor == 8 else [factor])


@pytest.mark.parametrize(("factor", "adds"), [(2, "result"), (4, "result"), (2, "within"), (2, "")])
def test_bicubic_enlargement_is_a_convolution_of_the_mirrored_image(factor: int, adds: str) -> None:
    """Only the border differs, and the host enlarges what is added to the result."""
    model = enlarging("cubic", "half_pixel", factor, adds)
    with pytest.raises(ModelError, match="'quantize --adapt'"):
        read_network(model)
    kinds = nodes_by_kind(OnnxGraph(model))
    assert {kind: len(nodes) for kind, nodes in kinds.items()} == {Kind.cubic: 1}
    near = replaced(model, {Kind.cubic}, (), {})
    # As bright as the samples that INT8 is calibrated on.
    pixels = BARE.degraded[0][..., :20, :28]
    expected, actual = (result_of(open_session(network), pixels) for network in (model, near))
    border_px = 4 * factor
    inner = np.s_[..., border_px:-border_px, border_px:-border_px]
    np.testing.assert_allclose(actual[inner], expected[inner], atol=2e-5)
    split = read_network(near)
    assert (split.base.factor, split.border_px) == (factor if adds == "result" else 1, 2)
    int8 = quickly(near, BARE)
    error = np.abs(result_of(open_session(int8.host), pixels) - expected).mean()
    assert error < 0.02
    check_tiles(int8.host, pixels, (12, 16))


def test_finetuning_learns_from_the_original() -> None:
    """Fine-tuning that is given the original ends nearer to it than without.

    The training that users ask for anyway then recovers the loss of a replacement.
    """
    model = network(silu)
    near = replaced(model, {Kind.silu}, (), {})
    int8 = quickly(near, BARE)
    graph = read_planes(read_network(near).graph)
    errors = []
    for original in (None, model):
        tuning = Tuning(BARE.pairs, 40, rate=0.3, original=original)
        # One image a step keeps the steps quick.
        with patch("beers_deploy.quant.passes.finetune.BATCH_PIXELS", 1):
            core, _ = finetune(int8.core, graph, tuning)
        errors.append(squared_error(host_model(core, {}), model))
    assert errors[1] < 0.8 * errors[0]


def test_nothing_to_replace_is_a_note_and_conditioned_weights_are_refused() -> None:
    """`adapt` without an effect is a note for a user's network, and an error for a shipped one."""
    samples, _ = batches(SAMPLES)
    with one_guess():
        int8 = bd.quantize(network(leaky(DPU_SLOPE)), samples=samples, adapt=True, progress=False)
    assert int8.table is not None
    assert any("replaced nothing" in note for note in int8.table.notes)
    with pytest.raises(OptionError, match="`adapt` has no effect"):
        bd.quantize("convbeers-xs", adapt=True)


@given(st.integers(1, 20), st.integers(1, 3))
def test_few_results_do_not_fit_weights(unknowns: int, groups: int) -> None:
    """Fewer than eight results for each weight change the bias alone; more find the weights."""
    generator = np.random.default_rng(unknowns)
    truth = generator.normal(0, 1, (groups, 2, unknowns))
    for count, is_fitted in ((8 * unknowns - 1, False), (64 * unknowns + 64, True)):
        reads = generator.normal(0, 1, (count, groups * unknowns, 1, 1))
        grouped = reads.reshape(count, groups, 1, unknowns)
        errors = (truth * grouped).sum(3).reshape(count, -1) + 3
        equations = Equations(groups, unknowns, 2)
        equations.add(reads, errors)
        change, bias = equations.solved()
        expected = truth.reshape(-1, unknowns) if is_fitted else np.zeros_like(change)
        np.testing.assert_allclose(change, expected, atol=1e-3)
        np.testing.assert_allclose(bias, 3 if is_fitted else errors.mean(0), atol=1e-3)


@pytest.mark.parametrize("mode", ["edge", "reflect"])
def test_zeros_around_the_mirrored_image_change_the_border_alone(mode: str) -> None:
    writer = GraphWriter()
    source = "image"
    around = writer.constant("around", np.array([0, 0, 1, 1] * 2))
    for k, shape in enumerate([IMAGE_WEIGHTS, (FEATURES, FEATURES, 3, 3), RESULT_WEIGHTS]):
        padded = writer.node("Pad", f"p{k}", [source, around], mode=mode)
        weight = np.random.default_rng(k).normal(0, 0.2, shape).astype(np.float32)
        source = writer.node("Conv", f"c{k}", [padded, writer.constant(f"w{k}", weight)])
        source = writer.node("Relu", f"r{k}", [source]) if k < 2 else source
    writer.node("Add", "restored", ["image", source])
    ends = [image_info(name, 1, None) for name in ("image", "restored")]
    original = make_model(writer.graph("g", ends[:1], ends[1:]), {})
    with pytest.raises(ModelError, match="--adapt"):
        read_network(original)
    images = [image(48, 64, seed) for seed in range(4)]
    held_out = patches_of(images)
    adapted = adapt(original, held_out, held_out)
    assert list(adapted.rows[0].text.values()) == [
        "zeros around the mirrored image, not compensated: no fit is nearer"
    ]
    expected, actual = (
        result_of(open_session(model), images[0]) for model in (original, adapted.model)
    )
    assert actual.shape == expected.shape
    np.testing.assert_allclose(actual[..., 3:-3, 3:-3], expected[..., 3:-3, 3:-3], atol=1e-6)
    int8 = quickly(adapted.model, held_out)
    restored = result_of(open_session(int8.host), images[0])
    assert np.abs(restored - actual).mean() < 0.02
    check_tiles(int8.host, images[0], (24, 32))
