"""Large kernels and crops become windows that every target computes, and stay what they were."""

from typing import Any

import numpy as np
import onnx
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from beers_deploy.quant.graph import read_network, refusal
from beers_deploy.quant.onnx.graph import OnnxGraph
from beers_deploy.quant.session import open_session, result_of
from beers_deploy.quant.simplify.large_kernels import LARGE_POSITIONS, MOST_POSITIONS
from beers_deploy.quant.simplify.simplify import simplify

CHANNELS = 3


def network(nodes: list[onnx.NodeProto], **constants: np.ndarray) -> onnx.ModelProto:
    """A network of `CHANNELS` channels from `x` to `y`."""
    initializers = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    sizes: dict[str, list[str | int | None]] = {
        "x": ["N", CHANNELS, "H", "W"],
        "y": ["N", "C", "h", "w"],
    }
    x, y = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, dims) for name, dims in sizes.items()
    )
    graph = helper.make_graph(nodes, "g", [x], [y], initializers)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def assert_same(model: onnx.ModelProto, short: onnx.ModelProto, rows: int, columns: int) -> None:
    """Check that two networks are equal but for the rounding of float32."""
    pixels = np.random.default_rng(rows).uniform(0, 1, (2, CHANNELS, rows, columns))
    before, after = (result_of(open_session(m), pixels.astype(np.float32)) for m in (model, short))
    np.testing.assert_allclose(after, before, atol=1e-5 * np.abs(before).max())


@settings(max_examples=40, deadline=None)
@given(
    kernel=st.tuples(st.integers(1, 16), st.integers(1, 16)),
    pads=st.lists(st.integers(0, 8), min_size=4, max_size=4),
    strides=st.tuples(st.integers(1, 3), st.integers(1, 3)),
    dilations=st.tuples(st.integers(1, 2), st.integers(1, 2)),
    outputs=st.integers(1, 4),
    size=st.tuples(st.integers(31, 40), st.integers(31, 40)),
)
def test_a_large_kernel_is_several_small_ones_and_their_sum(
    kernel: tuple[int, int],
    pads: list[int],
    strides: tuple[int, int],
    dilations: tuple[int, int],
    outputs: int,
    size: tuple[int, int],
) -> None:
    """Unless parts would begin inside the map."""
    generator = np.random.default_rng(kernel)
    weight = generator.normal(0, 1, (outputs, CHANNELS, *kernel)).astype(np.float32)
    bias = generator.normal(0, 1, outputs).astype(np.float32)
    windows: dict[str, Any] = {"pads": pads, "strides": strides, "dilations": dilations}
    node = helper.make_node("Conv", ["x", "w", "b"], ["y"], "large", kernel_shape=kernel, **windows)
    model = network([node], w=weight, b=bias)
    short = simplify(model, "a.onnx")
    convs = [n for n in OnnxGraph(short).nodes if n.op_type == "Conv"]
    steps = -(-kernel[0] // (MOST_POSITIONS // kernel[1]))
    may_split = kernel[0] * kernel[1] > LARGE_POSITIONS
    if may_split and min(pads[0], pads[2]) >= (steps - 1) * dilations[0]:
        assert len(convs) == steps + 1
        areas = [np.prod(OnnxGraph(short).constants[n.inputs[1]].shape[2:]) for n in convs]
        assert max(areas) <= MOST_POSITIONS
        assert_same(model, short, *size)
    elif any(pads):
        assert len(convs) == 1 or may_split


def test_srresnets_kernels_of_9_x_9_are_two_and_a_sum() -> None:
    weight = np.random.default_rng(0).normal(0, 1, (CHANNELS, CHANNELS, 9, 9)).astype(np.float32)
    conv = helper.make_node("Conv", ["x", "w"], ["c"], "head", pads=[4] * 4)
    model = network([conv, helper.make_node("Relu", ["c"], ["y"])], w=weight)
    short = simplify(model, "a.onnx")
    assert [op.name for op in read_network(short).graph] == [
        "head.rows_0",
        "head.rows_1",
        "head.rows",
        "head",
    ]
    assert_same(model, short, 9, 11)


@settings(max_examples=25, deadline=None)
@given(
    border=st.tuples(st.integers(0, 6), st.integers(0, 6)),
    size=st.tuples(st.integers(16, 22), st.integers(16, 22)),
    pad=st.integers(0, 1),
)
def test_a_crop_is_a_convolution_that_reads_one_pixel(
    border: tuple[int, int], size: tuple[int, int], pad: int
) -> None:
    cut = {axis: px for axis, px in zip((2, 3), border, strict=True) if px}
    assume(cut)
    weight = np.random.default_rng(0).normal(0, 1, (CHANNELS, CHANNELS, 3, 3)).astype(np.float32)
    nodes = [
        helper.make_node("Slice", ["x", "starts", "ends", "axes"], ["s"], "crop"),
        helper.make_node("Conv", ["s", "w"], ["y"], "conv", pads=[pad] * 4),
    ]
    places = np.array(list(cut.values()))
    model = network(nodes, w=weight, starts=places, ends=-places, axes=np.array(list(cut)))
    short = simplify(model, "a.onnx")
    kinds = [node.op_type for node in short.graph.node]
    assert "Slice" not in kinds
    if kinds[0] != "Pad":
        assert_same(model, short, *size)


def test_a_u_net_without_padding_crops_its_skip_and_gets_a_mirrored_border() -> None:
    """So do all published ones, such as waifu2x's; inside the border nothing changes."""
    generator = np.random.default_rng(0)
    tensors = {
        "w": generator.normal(0, 0.3, (CHANNELS, CHANNELS, 3, 3)),
        "half": generator.normal(0, 0.3, (CHANNELS, CHANNELS, 2, 2)),
        "double": generator.normal(0, 0.3, (CHANNELS, CHANNELS, 4, 4)),
    }
    constants = {name: value.astype(np.float32) for name, value in tensors.items()}
    constants |= {"four": np.array([4, 4]), "less": np.array([-4, -4]), "axes": np.array([2, 3])}
    nodes = [
        helper.make_node("Conv", ["x", "w"], ["a"], "a"),
        helper.make_node("Conv", ["a", "half"], ["b"], "b", strides=[2, 2]),
        helper.make_node("Conv", ["b", "w"], ["c"], "c"),
        helper.make_node(
            "ConvTranspose", ["c", "double"], ["d"], "d", strides=[2, 2], pads=[3] * 4
        ),
        helper.make_node("Slice", ["a", "four", "less", "axes"], ["s"], "s"),
        helper.make_node("Add", ["s", "d"], ["e"], "e"),
        helper.make_node("Conv", ["e", "w"], ["y"], "y"),
    ]
    model = network(nodes, **constants)
    short = simplify(model, "a.onnx")
    assert refusal(short) == ""
    assert read_network(short).border_px == 6
    pixels = generator.uniform(0, 1, (1, CHANNELS, 40, 44)).astype(np.float32)
    inner = result_of(open_session(short), pixels)[:, :, 6:-6, 6:-6]
    np.testing.assert_allclose(inner, result_of(open_session(model), pixels), atol=1e-5)
