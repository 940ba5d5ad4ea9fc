"""Tests that normalisations by a map's own statistics are replaced, fitted and quantised."""

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.adapt.adaptation import adapt
from beers_deploy.quant.graph import read_network
from beers_deploy.quant.graph.normalization import InverseDeviation, Normalization
from beers_deploy.quant.onnx.graph import OnnxGraph
from beers_deploy.quant.session import open_session, result_of
from beers_deploy.quant.simplify.simplify import simplify
from beers_deploy.quant.structure import structure_checks
from tests.quant.adapt.images import HELD_OUT, SAMPLES, assert_near, squared_error
from tests.quant.quick import changed, quickly
from tests.quant.simplify.networks import parsed

CHANNELS = 6
PX = 48
MEAN = "m = ReduceMean <axes = [1], keepdims = 1> (h)\nd = Sub (h, m)\n"
"""Differences d of a map h from the mean of its channels."""
SQUARES = "q = Mul (d, d)\nv = ReduceMean <axes = [1], keepdims = 1> (q)\ns = Add (v, epsilon)\n"
"""The variance s of d over the channels, with what is added to it."""
LAYER = """t = Transpose <perm = [0, 2, 3, 1]> (h)
l = LayerNormalization <axis = -1, epsilon = 0.001> (t, gain, offset)
n = Transpose <perm = [0, 3, 1, 2]> (l)
"""
INSTANCE = "n = InstanceNormalization <epsilon = 0.001> (h, gain, offset)"
IMAGE_BY_HAND = """m = GlobalAveragePool (h)
d = Sub (h, m)
q = Mul (d, d)
v = GlobalAveragePool (q)
s = Add (v, epsilon)
r = Sqrt (s)
k = Div (d, r)
n = Mul (k, gains)
"""
GELU = """z = Div (k, root_of_two)
e = Erf (z)
g = Add (e, one)
w = Mul (k, g)
n = Mul (w, half)
"""
SPELLINGS = {
    "layer by hand, as NAFNet": MEAN + SQUARES + "r = Sqrt (s)\nk = Div (d, r)\nn = Mul (k, gains)",
    "layer by hand, scaled first": MEAN + SQUARES + "r = Pow (s, half)\nw = Mul (d, gains)\n"
    "n = Div (w, r)",
    "without centring, as Restormer": MEAN + SQUARES + "r = Sqrt (s)\nn = Div (h, r)",
    "layer by hand, by rsqrt": MEAN + SQUARES + "r = Sqrt (s)\ni = Reciprocal (r)\nn = Mul (i, d)",
    "layer by hand, by torch's variance": MEAN
    + SQUARES.replace("keepdims = 1> (q)", "keepdims = 0> (q)\na = Reshape (v, size)").replace(
        "Add (v", "Add (a"
    )
    + "r = Sqrt (s)\nn = Div (d, r)",
    "layer by hand, GELU behind": MEAN + SQUARES + "r = Sqrt (s)\nk = Div (d, r)\n" + GELU,
    "layer": LAYER,
    "instance": INSTANCE,
    "instance by hand": IMAGE_BY_HAND,
    "instance by hand, added to the root": IMAGE_BY_HAND.replace(
        "s = Add (v, epsilon)\nr = Sqrt (s)", "s = Sqrt (v)\nr = Add (s, small)"
    ),
}
OF_PIXELS = {name for name in SPELLINGS if "layer" in name or "centring" in name}


LAST = "c = Conv <pads = [1, 1, 1, 1]> (n, last)"


def network(
    spelling: str, opset: int = 17, px: int | None = PX, last: str = LAST
) -> onnx.ModelProto:
    """Return a network whose only nonlinear part is a normalisation, simplified.

    Args:
        spelling: a key of SPELLINGS.
        opset: of the file, 17 or more.
        px: the sides of the image; None for any size.
        last: the nodes from the normalised map `n` to the correction `c`.
    """
    generator = np.random.default_rng(0)
    gain = generator.uniform(0.5, 2, CHANNELS)
    offset = generator.normal(0, 0.3, CHANNELS)
    constants = {
        "first": generator.normal(0, 0.4, (CHANNELS, 1, 3, 3)),
        "bias": generator.normal(0, 0.3, CHANNELS),
        "last": generator.normal(0, 0.05, (1, CHANNELS, 3, 3)),
        "gain": gain,
        "offset": offset,
        "gains": gain.reshape(-1, 1, 1),
        "epsilon": np.array(0.001),
        "small": np.array(1e-6),
        "half": np.array(0.5),
        "one": np.array(1.0),
        "root_of_two": np.sqrt(2),
        "size": np.array([1, 1, PX, PX]),
        "axes": np.array([1]),
        "border": np.array([0, 0, 1, 1, 0, 0, 1, 1]),
    }
    nodes = f"""h = Conv <pads = [1, 1, 1, 1]> (image, first, bias)
        {SPELLINGS[spelling]}
        {last}
        restored = Add (image, c)"""
    if opset > 17:
        nodes = nodes.replace("axes = [1], ", "").replace("> (h)", "> (h, axes)")
        nodes = nodes.replace("> (q)", "> (q, axes)")
    size = "N,1,H,W" if px is None else f"1,1,{px},{px}"
    ends = f"float[{size}] image => float[{size}] restored"
    return simplify(parsed(nodes, ends, opset, constants), "g")


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_each_spelling_is_replaced_near_to_the_original(spelling: str) -> None:
    """The refusal names `adapt`, and the gate counts the network's ReLUs in INT8."""
    model = network(spelling)
    with pytest.raises(ModelError, match=r"normalization .* 'quantize --adapt'"):
        read_network(model)
    adapted = adapt(model, SAMPLES, HELD_OUT)
    assert adapted.rows[0].name == "1 normalization of pixels or channels"
    assert_near(adapted, 30)
    int8 = quickly(adapted.model, SAMPLES)
    assert structure_checks(model, int8.host)[0].value == 0


@pytest.mark.parametrize("spelling", ["layer", "instance by hand, added to the root"])
def test_maps_without_contrast_become_zeros(spelling: str) -> None:
    """As those of dead channels do, whatever is added to their variance."""
    model = changed(network(spelling), "first", lambda weight: 0 * weight)
    model = changed(model, "bias", lambda bias: 0 * bias)
    adapted = adapt(model, SAMPLES, HELD_OUT)
    int8 = quickly(adapted.model, SAMPLES)
    assert squared_error(model, int8.host) < 1e-5


@pytest.mark.parametrize("opset", [18, 19])
@pytest.mark.parametrize("spelling", ["layer", "layer by hand, as NAFNet"])
def test_layer_normalisations_of_later_opsets_are_recognised(spelling: str, opset: int) -> None:
    """From opset 18 on the axes of a mean are an input."""
    adapted = adapt(network(spelling, opset), SAMPLES, HELD_OUT)
    assert_near(adapted, 30)


@settings(max_examples=20)
@given(
    st.sampled_from([*SPELLINGS]), st.floats(-2, 2), st.floats(0.05, 1), st.integers(0, 2**32 - 1)
)
def test_only_the_deviation_is_approximated(
    spelling: str, level: float, contrast: float, seed: int
) -> None:
    """With the inverse deviation of that image as a constant the nodes compute the original."""
    model = network(spelling)
    image = level + contrast * np.random.default_rng(seed).normal(size=(1, 1, PX, PX))
    image = image.astype(np.float32)
    graph = OnnxGraph(model)
    graph.infer_shapes()
    (normalization,) = (each for node in graph.nodes if (each := Normalization.of(graph, node)))
    assert normalization.is_of_pixels == (spelling in OF_PIXELS)
    if normalization.is_of_pixels:
        # One pixel stands for all, so that its inverse deviation is a constant.
        image = np.full_like(image, level)
    values = tensor(model, normalization.source, image)[0].astype(np.float64)
    n_features = CHANNELS
    unit = np.linspace(1, 2, CHANNELS)
    variances = values.var((1, 2))
    if normalization.is_of_pixels:
        variances = values[:, PX // 2, PX // 2].var()
        n_features = 2 * CHANNELS
        unit = np.ones(CHANNELS)
    deviations = np.sqrt(variances + normalization.epsilon)
    inverse = InverseDeviation(
        unit=unit,
        inner_weight=np.zeros((1, n_features)),
        inner_bias=np.zeros(1),
        weight=np.zeros((CHANNELS, 1)),
        bias=unit / deviations,
    )
    nodes = normalization.nodes(graph, inverse)
    expected = tensor(model, normalization.last.result, image)
    graph.rewrite(lambda _, node: nodes if node is normalization.last else None)
    graph.save()
    computed = tensor(model, normalization.last.result, image)
    middle = np.s_[..., 4:-4, 4:-4]
    np.testing.assert_allclose(computed[middle], expected[middle], rtol=1e-3, atol=2e-3)


def tensor(model: onnx.ModelProto, name: str, image: np.ndarray) -> np.ndarray:
    """Return a tensor (1, C, H, W) that a network computes for an image."""
    part = onnx.ModelProto()
    part.CopyFrom(model)
    del part.graph.output[:]
    part.graph.output.append(onnx.helper.make_tensor_value_info(name, 1, None))
    return result_of(open_session(part), image)


def test_a_size_and_zeros_around_maps_are_needed_for_statistics_of_the_image() -> None:
    """The sentences say what to do about a network of any size, and about reflecting padding."""
    with pytest.raises(ModelError, match=r"any size, .* whose size must be known"):
        read_network(network("instance", px=None))
    mirrored = 'p = Pad <mode = "reflect"> (n, border)\nc = Conv (p, last)'
    model = network("instance", last=mirrored)
    with pytest.raises(ModelError, match="Pad by zeros, and train the network again"):
        adapt(model, SAMPLES, HELD_OUT)
