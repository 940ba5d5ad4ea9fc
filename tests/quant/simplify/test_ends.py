"""Tests of channels-last networks (TensorFlow), of missing borders and of strided slices."""

from itertools import pairwise
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from onnx.reference import ReferenceEvaluator

from beers_deploy.quant.graph import read_network, refusal
from beers_deploy.quant.simplify.simplify import simplify
from tests.quant.quick import assert_same, fix_sizes, run_model
from tests.quant.simplify.networks import CHANNELS, SAME, network_from

IMAGE = np.random.default_rng(4).uniform(0, 1, (1, CHANNELS, 18, 23)).astype(np.float32)


def sized(model: onnx.ModelProto, rows: int, columns: int) -> onnx.ModelProto:
    """Return the network fixed to a size, with the sizes of its inner tensors, as exporters do."""
    fix_sizes(model.graph.input[0], rows, columns)
    model.graph.output[0].type.tensor_type.ClearField("shape")
    return onnx.shape_inference.infer_shapes(model)


def test_a_network_of_channels_last_becomes_one_of_channels_first() -> None:
    """TensorFlow's exporters leave a Transpose at either end."""
    sizes = f"[N,H,W,{CHANNELS}]"
    model = network_from(
        f"t = Transpose<perm=[0,3,1,2]>(x) c = {SAME}(t, w) y = Transpose<perm=[0,2,3,1]>(c)",
        ends=f"float{sizes} x => float{sizes} y",
    )
    short = simplify(model, "a.onnx")
    assert [n.op_type for n in short.graph.node] == ["Conv"]
    assert short.graph.input[0].type.tensor_type.shape.dim[1].dim_value == CHANNELS
    onnx.checker.check_model(short, full_check=True)
    before = run_model(model, np.moveaxis(IMAGE, 1, 3))
    after = run_model(short, IMAGE)
    assert_allclose(np.moveaxis(after, 1, 3), before, rtol=1e-5)


PARTS = (
    "Relu({})",
    "Add({}, image_last)",
    "Div(three, {})",
    "PRelu({}, image_last)",
    "MatMul({}, square)",
    "Concat<axis=-1>({}, u)",
    "Clip({}, , six)",
    "Pad({}, pads_last)",
    "ReduceMean<axes=[1,2]>({})",
)
"""Operators on a channels-last tensor; the braces stand for its name."""


@settings(max_examples=30)
@given(st.lists(st.sampled_from(PARTS), max_size=4), st.booleans())
def test_channels_that_are_last_between_other_layers_become_first(
    parts: list[str], image_last: bool
) -> None:
    """Torch's linear layers are exported like this, and so is Keras's scaling of an image."""
    to_first = "Transpose<perm=[0,3,1,2]>"
    to_last = "Transpose<perm=[0,2,3,1]>"
    tensors = ["u", *(f"t{k}" for k in range(1, len(parts) + 1))]
    inner = " ".join(
        f"{to} = {part.format(x)}" for part, (x, to) in zip(parts, pairwise(tensors), strict=True)
    )
    channels = CHANNELS * (1 + any("Concat" in part for part in parts))
    # Sizes and channels have to fit the layers behind.
    assume(not any("Concat" in part for part in parts[:-1]))
    is_sized = any(part.startswith(("Pad", "Reduce")) for part in parts)
    assume(channels == CHANNELS or not is_sized)
    first = f"u = {to_last}(x)"
    sizes = f"[N,{CHANNELS},H,W]"
    if image_last:
        first = "u = Identity(x)"
        sizes = f"[N,H,W,{CHANNELS}]"
    model = network_from(
        f"{first} {inner} v = {to_first}({tensors[-1]}) y = Conv(v, end)",
        ends=f"float{sizes} x => float[N,1,H2,W2] y",
        image_last=np.linspace(0.5, 1, CHANNELS),
        pads_last=[0, 1, 0, 0, 0, 0, 2, 0],
        end=np.ones((1, channels, 1, 1)),
    )
    short = simplify(model, "a.onnx")
    assert "Transpose" not in {n.op_type for n in short.graph.node}
    image = 1 + IMAGE
    before = run_model(model, np.moveaxis(image, 1, 3) if image_last else image)
    assert_allclose(run_model(short, image), before, rtol=1e-4)


@pytest.mark.parametrize(("sizes", "shape"), [("rows", (1, 4)), ("blocks", (1, 18, 46, 2))])
def test_only_a_map_of_channels_last_becomes_one_of_channels_first(
    sizes: str, shape: tuple[int, ...]
) -> None:
    """JAX reshapes the result of a network of channels last, and classifiers theirs."""
    pool = "p = GlobalAveragePool(t)" if sizes == "rows" else "p = Transpose<perm=[0,2,3,1]>(t)"
    model = network_from(
        f"t = Transpose<perm=[0,3,1,2]>(x) {pool} y = Reshape(p, {sizes})",
        ends=f"float[1,18,23,{CHANNELS}] x => float[{','.join(map(str, shape))}] y",
        blocks=[1, 18, 46, 2],
    )
    before = run_model(model, np.moveaxis(IMAGE, 1, 3))
    after = run_model(simplify(model, "a.onnx"), IMAGE)
    assert_allclose(np.moveaxis(after, 1, -1) if len(shape) == 4 else after, before, rtol=1e-5)


KERAS = {
    "half of the channels times the other": "s, t = Split<axis=-1>(u) m = Mul(s, t) v = Add(m, t)",
    "a dense layer": """f = Reshape(u, flat) p = MatMul(f, square) s = Shape(u)
        e = Gather(s, edges) t = Concat<axis=0>(e, four) r = Reshape(p, t) v = Relu(r)""",
    "squeeze and excite by dense layers": """p = GlobalAveragePool(x) q = Squeeze(p, axes)
        g = MatMul(q, square) a = Add(g, b) r = Reshape(a, pixel) v = Mul(u, r)""",
}
"""Layers of Keras on the tensor u, which has its channels last."""


@pytest.mark.parametrize("layer", KERAS)
def test_keras_layers_of_channels_last_become_first(layer: str) -> None:
    """The result has its channels last, the image has not, as with tf2onnx's inputs_as_nchw."""
    model = network_from(
        f"""u = Transpose<perm=[0,2,3,1]>(x) {KERAS[layer]}
        z = Transpose<perm=[0,3,1,2]>(v) c = Relu(z) y = Transpose<perm=[0,2,3,1]>(c)""",
        ends=f"float[N,{CHANNELS},H,W] x => float[N,H,W,C] y",
        flat=[-1, CHANNELS],
        edges=[0, 1, 2],
        pixel=[-1, 1, 1, CHANNELS],
    )
    short = simplify(model, "a.onnx")
    left = {node.op_type for node in short.graph.node}
    assert left <= {"Add", "Conv", "GlobalAveragePool", "Mul", "Relu"}
    before = np.moveaxis(run_model(model, IMAGE), 3, 1)
    assert_allclose(run_model(short, IMAGE), before, rtol=1e-4)


@pytest.mark.parametrize(
    ("axes", "pads"), [([1], [1, 2]), ([-2, -3], [0, 1, 2, 0]), ([2, 1, 0, 3], [1, 2, *[0] * 6])]
)
def test_pads_of_channels_last_may_name_their_axes(axes: list[int], pads: list[int]) -> None:
    model = network_from(
        "u = Transpose<perm=[0,2,3,1]>(x) p = Pad(u, pads, , axes) "
        "v = Transpose<perm=[0,3,1,2]>(p) y = Conv(v, end)",
        opset=18,
        pads=pads,
        axes=axes,
        end=np.ones((1, CHANNELS, 1, 1)),
    )
    short = simplify(model, "a.onnx")
    assert "Transpose" not in {n.op_type for n in short.graph.node}
    # onnxruntime moves such a Transpose and leaves the axes as they were, which is wrong, so that
    # ONNX's reference gives the expected result.
    (before,) = ReferenceEvaluator(model).run(None, {"x": IMAGE})
    assert_allclose(run_model(short, IMAGE), np.asarray(before), rtol=1e-4)


def test_a_crop_to_a_multiple_of_the_image_is_padding() -> None:
    """TensorFlow computes the stops of the crop behind a transposed convolution from the size."""
    model = network_from(
        """u = ConvTranspose<strides=[2,2]>(x, w) s = Shape(x) h = Slice(s, two, four)
        ends = Mul(h, doubled) d = Slice(u, starts, ends, axes) y = Relu(d)""",
        doubled=[2, 2],
        starts=[0, 1],
    )
    short = simplify(model, "a.onnx")
    assert [node.op_type for node in short.graph.node] == ["ConvTranspose", "Relu"]
    assert_same(model, short, IMAGE, rtol=1e-5)


def test_pads_that_follow_from_an_even_size_are_stated() -> None:
    """TensorFlow pads strided layers of images of any size at their end."""
    where = 'coordinate_transformation_mode="asymmetric", nearest_mode="floor"'
    same = 'auto_pad="SAME_UPPER", strides=[2,2]'
    model = network_from(
        f"""c = Conv<{same}>(x, w) m = MaxPool<{same}, kernel_shape=[3,3]>(c)
        y = Resize<{where}>(m, , fourfold)""",
        fourfold=[1.0, 1.0, 4.0, 4.0],
    )
    short = simplify(model, "a.onnx")
    assert refusal(short) == ""
    image = IMAGE[..., :16, :20]
    assert_same(model, short, image, rtol=1e-5)


@pytest.mark.parametrize("layers", [1, 2, 5])
@pytest.mark.parametrize("is_fixed", [False, True])
def test_the_image_of_a_network_without_padding_is_mirrored(layers: int, is_fixed: bool) -> None:
    """Inside the border the result stays the same, for a fixed size and for any size."""
    tensors = ["x", *(f"c{k}" for k in range(1, layers)), "y"]
    model = network_from(" ".join(f"{to} = Conv({source}, w)" for source, to in pairwise(tensors)))
    if is_fixed:
        model = sized(model, *IMAGE.shape[2:])
    short = simplify(model, "a.onnx")
    assert read_network(short).border_px == layers
    onnx.shape_inference.infer_shapes(short, strict_mode=True)
    inner = run_model(short, IMAGE)
    assert inner.shape[2:] == IMAGE.shape[2:]
    inner = inner[:, :, layers:-layers, layers:-layers]
    assert_allclose(inner, run_model(model, IMAGE), rtol=1e-4)


def test_a_network_that_pools_over_the_image_gets_no_border() -> None:
    """A larger image would change the mean, and with it the result inside the border."""
    nodes = "c = Conv(x, w) pooled = GlobalAveragePool(c) y = Mul(c, pooled)"
    model = sized(network_from(nodes), *IMAGE.shape[2:])
    short = simplify(model, "a.onnx")
    assert "Pad" not in {n.op_type for n in short.graph.node}
    assert_same(model, short, IMAGE)


@pytest.mark.parametrize("pads", ["pads=[1,1,1,1]", 'auto_pad="SAME_UPPER"'])
def test_layers_with_and_without_padding_together_are_refused(pads: str) -> None:
    """Zeros that a layer pads with would lie beyond a mirrored border."""
    model = network_from(f"c = Conv<{pads}>(x, w) y = Conv(c, w)")
    short = simplify(model, "a.onnx")
    assert [n.op_type for n in short.graph.node] == ["Conv", "Conv"]
    reason = refusal(short)
    assert "rows -2, columns -2" in reason


def test_slices_side_by_side_are_a_pixel_unshuffle() -> None:
    """YOLO's Focus layer has the columns of a block before its rows."""
    starts: dict[str, Any] = {"a": [0, 0], "b": [1, 0], "c": [0, 1], "d": [1, 1]}
    cuts = [f"cut_{name} = Slice(x, {name}, far, axes, by_two)" for name in starts]
    joined = f"j = Concat<axis=1>({', '.join(f'cut_{name}' for name in starts)})"
    weight = np.random.default_rng(0).normal(0, 1, (3, 4 * CHANNELS, 3, 3))
    model = network_from(
        f"{' '.join(cuts)} {joined} y = {SAME}(j, focus)",
        far=[999, 999],
        by_two=[2, 2],
        focus=weight,
        **starts,
    )
    short = simplify(model, "a.onnx")
    assert [n.op_type for n in short.graph.node] == ["SpaceToDepth", "Conv"]
    assert len(read_network(short).front) == 1
    image = IMAGE[..., :18, :22]
    assert_same(model, short, image, atol=1e-4)
