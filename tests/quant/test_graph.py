import numpy as np
import onnx
import pytest
from numpy.testing import assert_array_equal
from onnx import helper

from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.adapt.kinds import nodes_by_kind
from beers_deploy.quant.graph import (
    CORRECTION,
    IMAGE,
    QUARTER,
    STEP,
    Add,
    Conv,
    Pointwise,
    Resize,
    correction_graph,
    read_network,
    same,
)
from beers_deploy.quant.host_part import IMAGE_SLICES
from beers_deploy.quant.onnx.graph import OnnxGraph
from beers_deploy.quant.onnx.image_input import require_image
from tests.quant.quick import behind_conv, run_model, uniform
from tests.quant.simplify.networks import parsed


def test_no_digital_number_is_lost_in_planes_nor_wrapped() -> None:
    dn = np.arange(MAX_DN + 1, dtype=np.float32).reshape(1, 1, 64, 64)
    planes = IMAGE_SLICES.encode(dn / np.float32(MAX_DN)).astype(np.int32)
    assert_array_equal(STEP * planes[:, :1] + planes[:, 1:2], dn.astype(np.int32))
    assert np.abs(QUARTER * planes[:, 2:] - planes[:, 1:2]).max() <= QUARTER / 2
    low, high = (
        IMAGE_SLICES.encode(np.full((1, 1, 1, 1), v, np.float32)).ravel().tolist()
        for v in (-3.0, 7.0)
    )
    assert low == [0, 0, 0]
    assert STEP * high[0] + high[1] == MAX_DN


def test_a_plain_network_keeps_its_weights_and_relus_and_leaves_the_global_add(
    float_onnx: onnx.ModelProto,
) -> None:
    graph = correction_graph(float_onnx)
    assert graph[0].inputs == (IMAGE,)
    assert graph[-1].output == CORRECTION
    assert isinstance(graph[0], Conv)
    assert isinstance(graph[-1], Conv)
    stored = next(t for t in float_onnx.graph.initializer if t.name == "head.weight")
    assert_array_equal(graph[0].weight, onnx.numpy_helper.to_array(stored))
    assert sum(isinstance(op, Add) for op in graph) == 3


@pytest.mark.parametrize("kind", ["Sigmoid", "Tanh"])
def test_other_operators_are_refused_by_name(kind: str) -> None:
    model = parsed(
        f"x = {kind}(image) restored = Add(image, x)",
        "float[N,1,H,W] image => float[N,1,H,W] restored",
    )
    with pytest.raises(ModelError, match=kind):
        correction_graph(model)


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ("restored = Conv(x, two)", "global add"),
        ("y = Conv<strides=[2,2]>(x, two) restored = Add(y, image)", "needs tensors of one size"),
    ],
)
def test_networks_of_other_kinds_are_refused(nodes: str, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        correction_graph(behind_conv(nodes, two=np.ones((1, 2, 1, 1))))


def test_a_rounded_slope_of_hard_sigmoid_is_the_dpus() -> None:
    """A network is read as it is where `adapt` finds nothing to replace."""
    model = behind_conv("restored = HardSigmoid<alpha=0.16667, beta=0.50002>(x)")
    assert nodes_by_kind(OnnxGraph(model)) == {}
    assert isinstance(read_network(model).graph[-1], Pointwise)


@pytest.mark.parametrize("kind", ["Add", "Sub", "Mul"])
@pytest.mark.parametrize("shape", [(1, 2, 1, 1), (2, 1, 1), ()])
def test_one_number_a_channel_behind_an_activation_is_a_convolution(
    kind: str, shape: tuple[int, ...]
) -> None:
    value = np.random.default_rng(0).normal(size=shape).astype(np.float32)

    nodes = f"y = LeakyRelu<alpha=0.1015625>(x) restored = {kind}(y, own)"
    last = read_network(behind_conv(nodes, own=value)).graph[-1]
    assert isinstance(last, Conv)
    per_channel = np.broadcast_to(value.ravel(), 2)
    factor, offset = {"Add": (1, per_channel), "Sub": (1, -per_channel), "Mul": (per_channel, 0)}[
        kind
    ]
    assert (last.weight.ravel() == factor).all()
    assert (last.bias == offset).all()


@pytest.mark.parametrize("factor", [2, 3, 4])
@pytest.mark.parametrize("rounding", ["floor", "ceil", "round_prefer_floor", "round_prefer_ceil"])
@pytest.mark.parametrize(
    "where", ["asymmetric", "half_pixel", "pytorch_half_pixel", "align_corners"]
)
def test_a_nearest_resize_is_accepted_where_it_makes_blocks(
    where: str, rounding: str, factor: int
) -> None:
    how = f'coordinate_transformation_mode="{where}", nearest_mode="{rounding}"'
    sizes = [1.0, 1.0, factor, factor]
    model = behind_conv(f'restored = Resize<mode="nearest", {how}>(x, , sizes)', sizes=sizes)
    pixels = uniform(1, 1, 5, 7)
    result = run_model(model, pixels)[:, :1]
    # With aligned corners the positions depend on the image's size, so a match proves nothing.
    if where != "align_corners" and np.array_equal(
        result, pixels.repeat(factor, 2).repeat(factor, 3)
    ):
        last = read_network(model).graph[-1]
        assert isinstance(last, Resize)
        assert last.factor == factor
    else:
        with pytest.raises(ModelError, match="a block of each pixel"):
            read_network(model)


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ("strides=[2,1]", "one stride.*got strides \\[2, 1\\]"),
        ("strides=[2,2], dilations=[2,2]", "no dilation, got dilations \\[2, 2\\]"),
        ("strides=[2,2], output_padding=[1,1]", "output padding, got \\[1, 1\\]"),
        ('strides=[2,2], auto_pad="SAME_UPPER"', "auto_pad SAME_UPPER"),
        ("strides=[2,2], output_shape=[9,9]", "output_shape \\[9, 9\\]"),
    ],
)
def test_transposed_convolutions_that_the_dpu_lacks_are_refused(
    attributes: str, message: str
) -> None:
    nodes = f"[up] restored = ConvTranspose<{attributes}>(x, t)"
    with pytest.raises(ModelError, match=f"ConvTranspose up must .*{message}"):
        read_network(behind_conv(nodes, t=np.ones((2, 2, 2, 2))))


@pytest.mark.parametrize(
    ("end", "name", "channels", "message"),
    [
        ("output", "x", 2, "one output, but it has 2: restored, x.*as `output`"),
        ("input", "level", 1, r"has 2: image, level\. Export it with the others"),
    ],
)
def test_two_inputs_or_outputs_are_refused_by_name(
    end: str, name: str, channels: int, message: str
) -> None:
    model = behind_conv(f"restored = Add(x, {name})")
    info = helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["N", channels, "H", "W"])
    getattr(model.graph, end).append(info)
    with pytest.raises(ModelError, match=message):
        read_network(model)


@pytest.mark.parametrize("sizes", [(1, 3, 8), (2, 3, 8, 8), (1, 1, 3, 8, 8)])
def test_an_input_of_several_images_or_other_dimensions_is_refused(sizes: tuple[int, ...]) -> None:
    with pytest.raises(ModelError, match="one image"):
        require_image("image", sizes)
    require_image("image", (1, 3, 8, 8))


def test_the_window_of_an_oblong_kernel_keeps_the_size() -> None:
    window = same(np.zeros((1, 1, 3, 7)))
    sides = [window.output_size(axis, side, 20) for axis, side in enumerate((3, 7))]
    assert sides == [20, 20]
