"""Tests that small unusual networks are correct in INT8, or refused by the node's name."""

from collections.abc import Mapping

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.graph import read_network
from beers_deploy.quant.integer.agreement import agreement
from beers_deploy.quant.quantize import quantize_model
from beers_deploy.quant.structure import saturated_shares, structure_checks
from tests.quant.quick import patches_of, run_model
from tests.quant.simplify.networks import parsed, single
from tests.quant.trained import assert_equals_reference, moved

NUMBERS = {
    "zero": 0.0,
    "six": 6.0,
    "twice": [1.0, 1.0, 2.0, 2.0],
    "ones": np.ones(36),
    "second_axis": [1],
    "split": [0, 4, 18, 2, 18, 2],
    "around": [0, 0, 1, 1, 0, 0, 1, 1],
    "joined": [0, 16, 18, 18],
}
DEAD = np.array([0.1, -9.0, 0.2, -9.0, 0.1])
SAME = "Conv<pads=[1,1,1,1]>"
SQUEEZED = """r = Relu(c)
        mean = GlobalAveragePool(r)
        g = Conv(mean, g_w, g_b)
        gated = Mul(g, r)
        out = Conv(gated, out_w, out_b)"""
WHERE = 'coordinate_transformation_mode="asymmetric", nearest_mode="floor"'


def sketch(
    nodes: str,
    outputs: int = 1,
    side: str | int = "H",
    sizes: Mapping[str, float] | None = None,
    **shapes: tuple[int, ...],
) -> onnx.ModelProto:
    """Return a network from `in` (N, 1, H, W) to `out`, with random weights.

    Args:
        nodes: in ONNX's text format; layer a reads the weights a_w and the bias a_b.
        outputs: the number of channels of the result.
        side: the image's side in pixels, if it is fixed.
        sizes: the standard deviation of a layer's weights, if it is not 0.3.
        shapes: the shape of each layer's weights; `up` is a transposed convolution.
    """
    ends = f"float[N,1,{side},{side}] in => float[N,{outputs},P,Q] out"
    model = parsed(nodes, ends, constants=NUMBERS)
    stored = model.graph.initializer
    for number, node in enumerate(model.graph.node):
        if len(node.input) > 1 and node.input[1].endswith("_w"):
            name = node.input[1].removesuffix("_w")
            generator = np.random.default_rng(number)
            weight = (sizes or {}).get(name, 0.3) * generator.standard_normal(shapes[name])
            bias = 0.1 * generator.standard_normal(shapes[name][name == "up"])
            # The second and the fourth channel of such a layer never exceed zero.
            bias = DEAD if node.input[2] == "dead_b" else bias
            values = zip(node.input[1:], (weight, bias), strict=True)
            stored.extend(
                numpy_helper.from_array(single(value), tensor) for tensor, value in values
            )
    return model


VALID = {
    "features next to the image": sketch(
        f"""large = {SAME}(in, large_w, large_b)
        r = Relu(large)
        both = Concat<axis=1>(in, r)
        out = Conv(both, out_w, out_b)""",
        sizes={"large": 4.0},
        large=(3, 1, 3, 3),
        out=(1, 4, 1, 1),
    ),
    "pooled image": sketch(
        f"""p = MaxPool<kernel_shape=[3,3], pads=[1,1,1,1]>(in)
        mean = AveragePool<kernel_shape=[3,3], pads=[1,1,1,1], count_include_pad=1>(in)
        s = Add(p, mean)
        out = {SAME}(s, out_w, out_b)""",
        2,
        out=(2, 1, 3, 3),
    ),
    "preactivation": sketch(
        f"""first = {SAME}(in, first_w, first_b)
        r = Relu(first)
        inner = {SAME}(r, inner_w, inner_b)
        sum = Add(inner, first)
        last = {SAME}(sum, last_w, last_b)
        out = Add(in, last)""",
        sizes={"inner": 0.1, "last": 0.1},
        first=(4, 1, 3, 3),
        inner=(4, 4, 3, 3),
        last=(1, 4, 3, 3),
    ),
    "leaky ReLU behind a transposed convolution": sketch(
        """down = Conv<strides=[2,2]>(in, down_w, down_b)
        up = ConvTranspose<strides=[2,2], pads=[1,1,1,1]>(down, up_w, up_b)
        leaky = LeakyRelu<alpha=0.1015625>(up)
        out = Conv(leaky, out_w, out_b)""",
        down=(4, 1, 2, 2),
        up=(4, 3, 4, 4),
        out=(1, 3, 1, 1),
    ),
    "one tensor twice": sketch(
        f"""first = {SAME}(in, first_w, first_b)
        double = Add(first, first)
        last = {SAME}(double, last_w, last_b)
        out = Add(in, last)""",
        sizes={"last": 0.05},
        first=(4, 1, 3, 3),
        last=(1, 4, 3, 3),
    ),
    "sum of two": sketch(
        f"""a = {SAME}(in, a_w, a_b)
        b = {SAME}(in, b_w, b_b)
        sum = Add(a, b)
        out = Add(in, sum)""",
        sizes={"a": 0.05, "b": 0.05},
        a=(1, 1, 3, 3),
        b=(1, 1, 3, 3),
    ),
    "separable": sketch(
        """rows = Conv<pads=[0,1,0,1]>(in, rows_w, rows_b)
        r = Relu(rows)
        columns = Conv<pads=[1,0,1,0]>(r, columns_w, columns_b)
        out = Add(in, columns)""",
        sizes={"columns": 0.1},
        rows=(4, 1, 1, 3),
        columns=(1, 4, 3, 1),
    ),
    "names that the quantiser uses": sketch(
        f"""[planes] planes = {SAME}(in, first_w, first_b)
        [image] image = Relu(planes)
        [restored] restored = {SAME}(image, inner_w, inner_b)
        [correction] correction = Relu(restored)
        ["host_back.both"] "host_back.both" = Conv(correction, last_w, last_b)
        out = Add(in, "host_back.both")""",
        sizes={"last": 0.1},
        first=(4, 1, 3, 3),
        inner=(4, 4, 3, 3),
        last=(1, 4, 1, 1),
    ),
    "strides of three": sketch(
        """down = Conv<strides=[3,3]>(in, down_w, down_b)
        up = ConvTranspose<strides=[3,3]>(down, up_w, up_b)
        out = Add(in, up)""",
        sizes={"up": 0.1},
        down=(4, 1, 3, 3),
        up=(4, 1, 3, 3),
    ),
    "products": sketch(
        f"""a = {SAME}(in, a_w, a_b)
        b = {SAME}(in, b_w, b_b)
        gate = HardSigmoid<alpha=0.16666667, beta=0.5>(b)
        m = Mul(a, gate)
        r = Relu(m)
        out = {SAME}(r, out_w, out_b)""",
        2,
        a=(3, 1, 3, 3),
        b=(3, 1, 3, 3),
        out=(2, 3, 3, 3),
    ),
    "skip past a pool": sketch(
        f"""first = {SAME}(in, first_w, first_b)
        head = Clip(first, zero, six)
        inner = Conv<pads=[1,1,1,1], group=3>(head, inner_w, inner_b)
        r = Relu(inner)
        point = Conv(r, point_w, point_b)
        fine = Add(head, point)
        half = MaxPool<kernel_shape=[2,2], strides=[2,2]>(fine)
        deep = Conv(half, deep_w, deep_b)
        wide = Resize<{WHERE}>(deep, , twice)
        both = Concat<axis=1>(wide, fine)
        last = {SAME}(both, last_w, last_b)
        out = Add(in, last)""",
        sizes={"inner": 0.2, "last": 0.1},
        first=(3, 1, 3, 3),
        inner=(3, 1, 3, 3),
        point=(3, 3, 1, 1),
        deep=(2, 3, 1, 1),
        last=(1, 5, 3, 3),
    ),
    "dead channels": sketch(
        f"""first = {SAME}(in, first_w, first_b)
        r = Relu(first)
        inner = Conv<pads=[1,1,1,1], group=5>(r, inner_w, dead_b)
        s = Relu(inner)
        point = Conv(s, point_w, point_b)
        t = Relu(point)
        out = {SAME}(t, out_w, out_b)""",
        sizes={"first": 0.6, "inner": 0.6},
        first=(5, 1, 3, 3),
        inner=(5, 1, 3, 3),
        point=(4, 5, 1, 1),
        out=(1, 4, 3, 3),
    ),
    "many classes": sketch(
        "out = Conv<strides=[3,3]>(in, out_w, out_b)",
        1200,
        sizes={"out": 40.0},
        out=(1200, 1, 3, 3),
    ),
    "weights of zeros": sketch(
        f"""c = {SAME}(in, c_w, c_b)
        r = Relu(c)
        correction = {SAME}(r, last_w, last_b)
        out = Add(in, correction)""",
        sizes={"c": 0.0},
        c=(4, 1, 3, 3),
        last=(1, 4, 3, 3),
    ),
    "squeezed behind a mirrored border": sketch(
        f"""wide = Pad<mode="reflect">(in, around)
        c = Conv(wide, c_w, c_b)
        {SQUEEZED}""",
        side=36,
        sizes={"out": 1.0},
        c=(5, 1, 3, 3),
        g=(5, 5, 1, 1),
        out=(1, 5, 1, 1),
    ),
    "squeezed": sketch(
        f"""c = {SAME}(in, c_w, c_b)
        {SQUEEZED}""",
        side=36,
        sizes={"g": 1.0, "out": 1.0},
        c=(4, 1, 3, 3),
        g=(4, 4, 1, 1),
        out=(1, 4, 1, 1),
    ),
}


@pytest.mark.parametrize("name", VALID)
def test_int8_is_near_float_equals_the_reference_and_has_no_faults(name: str) -> None:
    model = VALID[name]
    # A network that pools over the whole image has one size.
    height_px = model.graph.input[0].type.tensor_type.shape.dim[2].dim_value or 48
    rows, columns = np.mgrid[:height_px, :36] / 40
    samples = [
        (0.4 + 0.3 * np.sin(7 * rows + k) * np.cos(5 * columns)).astype(np.float32)[None, None]
        for k in range(3)
    ]
    patches = patches_of(samples)
    int8 = quantize_model(model, patches, {})
    expected = int8.core.host_part.clip(run_model(model, samples[1]))
    actual = run_model(int8.host, samples[1])
    assert np.abs(actual - expected).mean() < 0.06 * expected.std()
    assert not any(layer.unequal for layer in agreement(int8.core, int8.host, samples[2]).layers)
    assert_equals_reference(moved(int8.core), int8.core.host_part.encode(samples[2]))
    assert [str(check) for check in structure_checks(model, int8.host) if not check.passed] == []
    assert saturated_shares(int8.host, samples).get("correction", 0) < 0.01


REFUSED = {
    "pixel unshuffle of several channels within the network": sketch(
        """c = Conv(in, c_w, c_b)
        blocks = Reshape(c, split)
        moved = Transpose<perm=[0,1,3,5,2,4]>(blocks)
        places = Reshape(moved, joined)
        out = Conv(places, out_w, out_b)""",
        side=36,
        c=(4, 1, 1, 1),
        out=(1, 16, 1, 1),
    ),
    "Mul out must have a constant of one number for each channel, got 36": sketch(
        "c = Conv(in, c_w, c_b) out = Mul(c, ones)", 36, 36, c=(36, 1, 1, 1)
    ),
    "without self-attention": sketch("c = Conv(in, c_w, c_b) out = MatMul(c, c)", c=(1, 1, 1, 1)),
    "Stack maps along the channels": sketch(
        """c = Conv(in, c_w, c_b) deep = Unsqueeze(c, second_axis) r = Exp(deep)
        out = Squeeze(r, second_axis)""",
        c=(1, 1, 1, 1),
    ),
    "Concat rows must concatenate along the channels": sketch(
        "[rows] rows = Concat<axis=2>(in, in) mean = ReduceMax(rows) out = Mul(in, mean)"
    ),
    "Let convolutions pad by zeros, and train the network again.$": sketch(
        "padded = Pad(in, around) out = Relu(padded)"
    ),
    "cut the network in front of it. 'check' and 'bench' read any network": sketch(
        "c = Conv(in, c_w, c_b) mean = GlobalAveragePool(c) out = Flatten(mean)",
        4,
        36,
        c=(4, 1, 1, 1),
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_networks_that_would_be_computed_wrongly_are_refused(message: str) -> None:
    with pytest.raises(ModelError, match=message):
        read_network(REFUSED[message])
