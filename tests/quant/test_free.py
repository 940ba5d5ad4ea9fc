from collections import Counter
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import numpy_helper

from beers_deploy.quant.free import BINS, best_scale, quantise_free, round_weight
from beers_deploy.quant.gate import compare
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    correction_graph,
    read_planes,
    relu_count,
    same,
)
from beers_deploy.quant.integer.arithmetic import convolve
from beers_deploy.quant.onnx_file import metadata, with_outputs
from beers_deploy.quant.passes.stream import OFFSETS, half_lsb_pair
from beers_deploy.quant.quantise import Quantised
from beers_deploy.quant.samples import Patches
from beers_deploy.quant.session import open_session, run, tensors_of
from tests.quant.quick import changed, image, in_float, one_guess
from tests.quant.tiling.small_networks import half_resolution

SIZES = [(37, 53), (16, 91), (5, 3)]


@pytest.fixture(scope="module")
def free(float_onnx: onnx.ModelProto, patches: Patches) -> onnx.ModelProto:
    return quantise_free(float_onnx, patches, {"seed": "5"})


def whole_numbers(model: onnx.ModelProto, planes: np.ndarray, around: str = "zeros") -> np.ndarray:
    """The correction as stored, in int64 arithmetic from the stored planes (N, 3, H, W).

    `around` each image are zeros, or the zero bytes that a kernel would take which forgot the zero point.
    """
    constant = {t.name: numpy_helper.to_array(t).astype(np.float64) for t in model.graph.initializer}
    found = {PLANES: planes.astype(np.int64)}
    for node in model.graph.node:
        if node.op_type == "QLinearConv":
            x, unit, zero, weight, scales, _, out_unit, out_zero, bias = node.input
            taps, offset = constant[weight].astype(np.int64), int(constant[zero])
            if around == "zeros":
                sums = convolve(found[x] - offset, taps, same(taps))
            else:
                sums = convolve(found[x], taps, same(taps)) - offset * taps.sum((1, 2, 3))[:, None, None]
            sums = sums + constant[bias][:, None, None]
            value = sums * (constant[unit] * constant[scales] / constant[out_unit])[:, None, None]
        elif node.op_type == "QLinearAdd":
            *terms, out_unit, out_zero = node.input
            values = [(found[q] - constant[z]) * constant[u] for q, u, z in (terms[:3], terms[3:])]
            value = (values[0] + values[1]) / constant[out_unit]
        else:
            continue
        found[node.output[0]] = np.clip(np.rint(value) + constant[out_zero], 0, 255).astype(np.int64)
    return found[CORRECTION]


def stored(model: onnx.ModelProto, seen: np.ndarray) -> list[np.ndarray]:
    """The planes and the correction, uint8."""
    names = [PLANES, CORRECTION]
    opened = with_outputs(model, dict.fromkeys(names, onnx.TensorProto.UINT8))
    return tensors_of(open_session(opened), names, seen)


@pytest.mark.parametrize("size", SIZES)
def test_it_computes_what_whole_numbers_say_zeros_around_the_image_optimised_or_not(
    free: onnx.ModelProto, size: tuple[int, int]
) -> None:
    planes, correction = stored(free, image(*size))
    expected = whole_numbers(free, planes)
    assert (expected == correction).mean() > 0.98  # float32 beside float64: a rare half rounds the other way
    np.testing.assert_allclose(expected, correction, atol=2)
    plain = open_session(free, optimise=False)
    np.testing.assert_array_equal(run(open_session(free), image(*size)), run(plain, image(*size)))


def test_padding_with_anything_but_zero_would_be_noticed(free: onnx.ModelProto) -> None:
    planes, correction = stored(free, image(37, 53))
    same = whole_numbers(free, planes, around="zero bytes") == correction
    assert same[..., 7:-7, 7:-7].mean() > 0.98
    assert same[..., 0, :].mean() < 0.5


def test_every_convolution_stays_an_integer_kernel(free: onnx.ModelProto, tmp_path: Path) -> None:
    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.optimized_model_filepath = str(tmp_path / "optimised.onnx")
    ort.InferenceSession(free.SerializeToString(), options, providers=["CPUExecutionProvider"])
    kinds = Counter(node.op_type for node in onnx.load(tmp_path / "optimised.onnx").graph.node)
    assert kinds["QLinearConv"] == 8  # seven, the head also as a half-LSB pair
    assert not [kind for kind in kinds if kind.endswith("Conv") and kind != "QLinearConv"]


def test_the_relus_are_kept(float_onnx: onnx.ModelProto, free: onnx.ModelProto) -> None:
    clipping = [n for n in free.graph.node if n.op_type == "QLinearConv" and n.input[7] == "zero_point_0"]
    assert len(clipping) == relu_count(correction_graph(float_onnx)) == 2


def test_free_scales_lose_less_than_legal_ones_on_patches_not_seen(
    float_onnx: onnx.ModelProto, quantised: Quantised, free: onnx.ModelProto, unseen: Patches
) -> None:
    session = open_session(float_onnx)
    legal, without = (compare(session, open_session(m), unseen.pairs) for m in (quantised.host, free))
    assert without.mae < legal.mae
    assert without.std < legal.std


def test_a_wrong_scale_loses_more(float_onnx: onnx.ModelProto, free: onnx.ModelProto, unseen: Patches) -> None:
    broken = changed(free, "head.weight_scale", lambda scale: scale * np.float32(1.1))
    sound, worse = (compare(open_session(float_onnx), open_session(m), unseen.pairs) for m in (free, broken))
    assert worse.mae > 1.3 * sound.mae


def test_the_file_says_what_it_is(free: onnx.ModelProto, patches: Patches) -> None:
    about = metadata(free)
    assert about["precision"] == "int8 free"
    assert about["calibration_sha256"] == patches.digest
    assert free.graph.input[0].name == "image"
    assert [output.name for output in free.graph.output] == ["restored"]


def test_the_same_patches_give_the_same_bytes(float_onnx: onnx.ModelProto, patches: Patches) -> None:
    with one_guess():
        once, again = (quantise_free(float_onnx, patches, {"seed": "5"}).SerializeToString() for _ in range(2))
    assert once == again


@given(st.integers(0, 2**32 - 1), st.sampled_from([127, 255]), st.floats(1.0, 4.0))
def test_a_least_squares_scale_loses_no_more_than_one_that_clips_nothing(seed: int, levels: int, tail: float) -> None:
    values = np.abs(np.random.default_rng(seed).standard_t(tail + 1, 4000))
    largest = float(values.max())
    counts = np.bincount(np.rint(values * (BINS / largest)).astype(int), minlength=BINS + 1)
    sizes = np.linspace(0, largest, BINS + 1)

    def error(scale: float) -> float:
        return float(counts @ (np.minimum(np.rint(sizes / scale), levels) * scale - sizes) ** 2)

    assert error(best_scale(counts, largest, levels)) <= error(largest / levels) * (1 + 1e-9)


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.sampled_from([1, 3]))
def test_each_output_channel_has_the_precision_of_its_own_size(seed: int, channels: int, side: int) -> None:
    generator = np.random.default_rng(seed)
    sizes = 10.0 ** generator.integers(-4, 3, (channels, 1, 1, 1))
    weight = generator.normal(0, 1, (channels, 3, side, side)) * sizes
    whole, scales = round_weight(weight.astype(np.float32), np.zeros(channels))
    found = whole * scales.astype(np.float64)[:, None, None, None]
    size = np.abs(weight).max((1, 2, 3), keepdims=True)
    assert whole.dtype == np.int8
    assert (np.square(found - weight).mean((1, 2, 3), keepdims=True) <= (size / 127 / 2) ** 2 * 1.01).all()


def test_a_channel_of_zeros_stays_zero_and_a_tiny_one_keeps_its_bias_in_reach() -> None:
    whole, scales = round_weight(np.array([[[[0.0]]], [[[1e-9]]]]), finest=np.array([0.0, 1e-3]))
    assert scales.tolist() == pytest.approx([1.0, 1e-3])
    assert not whole.any()


def test_the_half_lsb_pair_leave_the_float_network_as_it_was(float_onnx: onnx.ModelProto) -> None:
    graph = read_planes(correction_graph(float_onnx))
    twice = half_lsb_pair(graph, 2.0**-8)
    assert len(twice) == len(graph) + 1  # the head is also read by the first block, as it was
    found, wanted = (in_float(each, image(23, 31)) for each in (twice, graph))
    np.testing.assert_allclose(found, wanted, atol=2e-6)


def test_the_half_lsb_pair_need_an_add_of_two_convolutions_before_the_tail(float_onnx: onnx.ModelProto) -> None:
    graph = read_planes(correction_graph(float_onnx))
    for other in (graph[:-1], graph[-1:], graph[:3]):
        assert half_lsb_pair(other, 2.0**-8) == other


@given(st.floats(-100, 100))
def test_two_copies_hold_half_an_lsb(value: float) -> None:
    copies = np.rint(value + OFFSETS)
    assert abs(copies.mean() - value) <= 0.25 + 1e-9


def test_the_half_lsb_pair_lose_less(
    float_onnx: onnx.ModelProto, patches: Patches, unseen: Patches, monkeypatch: pytest.MonkeyPatch
) -> None:
    def mae() -> float:
        with one_guess():
            made = quantise_free(float_onnx, patches, {})
        return compare(open_session(float_onnx), open_session(made), unseen.pairs).mae

    apart = mae()
    monkeypatch.setattr("beers_deploy.quant.free.half_lsb_pair", lambda graph, _: half_lsb_pair(graph, 0.0))
    assert apart < 0.95 * mae()


def test_at_half_resolution_the_pixels_of_a_place_find_their_way_back(patches: Patches, unseen: Patches) -> None:
    """The same ends as in the legal regime around other numbers: a channel in another's place would be far off."""
    model = half_resolution()
    with one_guess():
        made = quantise_free(model, patches, {})
    assert {"SpaceToDepth", "DepthToSpace"} < {node.op_type for node in made.graph.node}
    session, in_int8 = open_session(model), open_session(made)
    found = compare(session, in_int8, unseen.pairs).mae
    corrections = [float(np.abs(run(session, degraded) - degraded).mean()) for degraded, _ in unseen.pairs]
    assert found < 0.05 * np.mean(corrections)
