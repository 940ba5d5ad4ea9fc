"""Networks of odd shapes, a few operations each: right in INT8 and without faults, or refused by
the node's name.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.graph import read_network
from beers_deploy.quant.integer.reference import agreement
from beers_deploy.quant.onnx_file import GraphWriter, make_model
from beers_deploy.quant.quantize import quantize_model
from beers_deploy.quant.session import open_session, result_of
from beers_deploy.quant.structure import saturated_shares, structure_checks
from tests.quant.quick import patches_of
from tests.quant.trained import hold_to_reference, moved

SLOPE = 26 / 256


class Sketch(GraphWriter):
    """Writes networks in few words; results have the names of their nodes."""

    def conv(
        self,
        name: str,
        source: str,
        shape: Sequence[int],
        size: float = 0.3,
        kind: str = "Conv",
        **attributes: Any,
    ) -> str:
        generator = np.random.default_rng(len(self.nodes))
        weight = (size * generator.standard_normal(tuple(shape))).astype(np.float32)
        outputs = shape[1] if kind == "ConvTranspose" else shape[0]
        bias = (0.1 * generator.standard_normal(outputs)).astype(np.float32)
        feeds = [source, self.constant(f"{name}.w", weight), self.constant(f"{name}.b", bias)]
        return self.node(kind, name, feeds, **attributes)

    def model(self, outputs: int, side_px: int | None = None) -> onnx.ModelProto:
        sides: list[str | int | None] = [side_px or "H", side_px or "W"]
        image = helper.make_tensor_value_info("in", TensorProto.FLOAT, ["N", 1, *sides])
        result = helper.make_tensor_value_info("out", TensorProto.FLOAT, None)
        result.type.tensor_type.shape.dim.add(dim_param="N")
        for size in (outputs, None, None):
            result.type.tensor_type.shape.dim.add(dim_value=size)
        return make_model(self.graph("sketch", [image], [result]), {})


def features_beside_the_image(w: Sketch) -> onnx.ModelProto:
    large = w.node("Relu", "r", [w.conv("large", "in", (3, 1, 3, 3), 4.0, pads=[1] * 4)])
    w.conv("out", w.node("Concat", "both", ["in", large], axis=1), (1, 4, 1, 1))
    return w.model(1)


def pooled_image(w: Sketch) -> onnx.ModelProto:
    pooled = w.node("MaxPool", "p", ["in"], kernel_shape=[3, 3], pads=[1] * 4)
    mean = w.node(
        "AveragePool", "mean", ["in"], kernel_shape=[3, 3], pads=[1] * 4, count_include_pad=1
    )
    w.conv("out", w.node("Add", "s", [pooled, mean]), (2, 1, 3, 3), pads=[1] * 4)
    return w.model(2)


def preactivation(w: Sketch) -> onnx.ModelProto:
    first = w.conv("first", "in", (4, 1, 3, 3), pads=[1] * 4)
    inner = w.conv("inner", w.node("Relu", "r", [first]), (4, 4, 3, 3), 0.1, pads=[1] * 4)
    last = w.conv("last", w.node("Add", "sum", [inner, first]), (1, 4, 3, 3), 0.1, pads=[1] * 4)
    w.node("Add", "out", ["in", last])
    return w.model(1)


def leaking_upwards(w: Sketch) -> onnx.ModelProto:
    down = w.conv("down", "in", (4, 1, 2, 2), strides=[2, 2])
    up = w.conv("up", down, (4, 3, 4, 4), kind="ConvTranspose", strides=[2, 2], pads=[1] * 4)
    w.conv("out", w.node("LeakyRelu", "leaky", [up], alpha=SLOPE), (1, 3, 1, 1))
    return w.model(1)


def one_tensor_twice(w: Sketch) -> onnx.ModelProto:
    first = w.conv("first", "in", (4, 1, 3, 3), pads=[1] * 4)
    last = w.conv("last", w.node("Add", "double", [first, first]), (1, 4, 3, 3), 0.05, pads=[1] * 4)
    w.node("Add", "out", ["in", last])
    return w.model(1)


def sum_of_two(w: Sketch) -> onnx.ModelProto:
    branches = [w.conv(name, "in", (1, 1, 3, 3), 0.05, pads=[1] * 4) for name in ("a", "b")]
    w.node("Add", "out", ["in", w.node("Add", "sum", branches)])
    return w.model(1)


def separable(w: Sketch) -> onnx.ModelProto:
    rows = w.node("Relu", "r", [w.conv("rows", "in", (4, 1, 1, 3), pads=[0, 1, 0, 1])])
    w.node("Add", "out", ["in", w.conv("columns", rows, (1, 4, 3, 1), 0.1, pads=[1, 0, 1, 0])])
    return w.model(1)


def names_of_ours(w: Sketch) -> onnx.ModelProto:
    first = w.node("Relu", "image", [w.conv("planes", "in", (4, 1, 3, 3), pads=[1] * 4)])
    second = w.node("Relu", "correction", [w.conv("restored", first, (4, 4, 3, 3), pads=[1] * 4)])
    w.node("Add", "out", ["in", w.conv("host_back.both", second, (1, 4, 1, 1), 0.1)])
    return w.model(1)


def thirds(w: Sketch) -> onnx.ModelProto:
    down = w.conv("down", "in", (4, 1, 3, 3), strides=[3, 3])
    w.node(
        "Add", "out", ["in", w.conv("up", down, (4, 1, 3, 3), 0.1, "ConvTranspose", strides=[3, 3])]
    )
    return w.model(1)


def products(w: Sketch) -> onnx.ModelProto:
    first, second = (w.conv(name, "in", (3, 1, 3, 3), pads=[1] * 4) for name in ("a", "b"))
    gate = w.node("HardSigmoid", "gate", [second], alpha=1 / 6, beta=0.5)
    w.conv(
        "out", w.node("Relu", "r", [w.node("Mul", "m", [first, gate])]), (2, 3, 3, 3), pads=[1] * 4
    )
    return w.model(2)


def skip_past_a_pool(w: Sketch) -> onnx.ModelProto:
    first = w.conv("first", "in", (3, 1, 3, 3), pads=[1] * 4)
    limits = [w.constant(f"limit_{end}", np.array(end, np.float32)) for end in (0, 6)]
    head = w.node("Clip", "head", [first, *limits])
    inner = w.conv("inner", head, (3, 1, 3, 3), 0.2, pads=[1] * 4, group=3)
    fine = w.node(
        "Add", "fine", [head, w.conv("point", w.node("Relu", "r", [inner]), (3, 3, 1, 1))]
    )
    deep = w.conv(
        "deep", w.node("MaxPool", "down", [fine], kernel_shape=[2, 2], strides=[2, 2]), (2, 3, 1, 1)
    )
    sizes = w.constant("twice", np.array([1, 1, 2, 2], np.float32))
    how = {
        "mode": "nearest",
        "coordinate_transformation_mode": "asymmetric",
        "nearest_mode": "floor",
    }
    up = w.node("Resize", "up", [deep, "", sizes], **how)
    last = w.conv(
        "last", w.node("Concat", "both", [up, fine], axis=1), (1, 5, 3, 3), 0.1, pads=[1] * 4
    )
    w.node("Add", "out", ["in", last])
    return w.model(1)


def dead_channels(w: Sketch) -> onnx.ModelProto:
    first = w.node("Relu", "r", [w.conv("first", "in", (5, 1, 3, 3), 0.6, pads=[1] * 4)])
    w.constant("inner.b", np.array([0.1, -9, 0.2, -9, 0.1], np.float32))
    inner = w.node("Relu", "s", [w.conv("inner", first, (5, 1, 3, 3), 0.6, pads=[1] * 4, group=5)])
    w.conv(
        "out",
        w.node("Relu", "t", [w.conv("point", inner, (4, 5, 1, 1))]),
        (1, 4, 3, 3),
        pads=[1] * 4,
    )
    return w.model(1)


def many_classes(w: Sketch) -> onnx.ModelProto:
    w.conv("out", "in", (1200, 1, 3, 3), 40.0, strides=[3, 3])
    return w.model(1200)


def squeezed(w: Sketch) -> onnx.ModelProto:
    inner = w.node("Relu", "r", [w.conv("c", "in", (4, 1, 3, 3), pads=[1] * 4)])
    gate = w.conv("g", w.node("GlobalAveragePool", "mean", [inner]), (4, 4, 1, 1), 1.0)
    w.conv("out", w.node("Mul", "gated", [gate, inner]), (1, 4, 1, 1), 1.0)
    return w.model(1, 36)


SOUND = [
    features_beside_the_image,
    pooled_image,
    preactivation,
    leaking_upwards,
    one_tensor_twice,
    sum_of_two,
    separable,
    names_of_ours,
    thirds,
    products,
    skip_past_a_pool,
    dead_channels,
    many_classes,
    squeezed,
]


@pytest.mark.parametrize("make", SOUND)
def test_near_float_equal_to_the_reference_and_without_faults(
    make: Callable[[Sketch], onnx.ModelProto],
) -> None:
    model = make(Sketch())
    # A network that pools over the whole image has one size.
    height_px = model.graph.input[0].type.tensor_type.shape.dim[2].dim_value or 48
    rows, columns = np.mgrid[:height_px, :36] / 40
    samples = [
        (0.4 + 0.3 * np.sin(7 * rows + k) * np.cos(5 * columns)).astype(np.float32)[None, None]
        for k in range(3)
    ]
    patches = patches_of(samples)
    int8 = quantize_model(model, patches, {})
    expected = int8.core.host_part.clip(result_of(open_session(model), samples[1]))
    actual = result_of(open_session(int8.host), samples[1])
    assert np.abs(actual - expected).mean() < 0.06 * expected.std()
    assert not any(layer.unequal for layer in agreement(int8.core, int8.host, samples[2]).layers)
    hold_to_reference(moved(int8.core), int8.core.host_part.encode(samples[2]))
    assert [str(check) for check in structure_checks(model, int8.host) if not check.passed] == []
    assert saturated_shares(int8.host, samples).get("correction", 0) < 0.01


def unshuffled_inside(w: Sketch) -> onnx.ModelProto:
    inner = w.conv("c", "in", (4, 1, 1, 1))
    five = w.node("Reshape", "five", [inner, w.constant("s5", np.array([0, 4, 18, 2, 18, 2]))])
    w.node("Transpose", "moved", [five], perm=[0, 1, 3, 5, 2, 4])
    w.conv(
        "out",
        w.node("Reshape", "four", ["moved", w.constant("s4", np.array([0, 16, 18, 18]))]),
        (1, 16, 1, 1),
    )
    return w.model(1, 36)


def column_by_column(w: Sketch) -> onnx.ModelProto:
    w.node(
        "Mul",
        "out",
        [w.conv("c", "in", (36, 1, 1, 1)), w.constant("each", np.ones(36, np.float32))],
    )
    return w.model(36, 36)


def classes(w: Sketch) -> onnx.ModelProto:
    pooled = w.node("GlobalAveragePool", "mean", [w.conv("c", "in", (4, 1, 1, 1))])
    w.node("Flatten", "out", [pooled], axis=1)
    return w.model(4, 36)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (unshuffled_inside, "pixel unshuffle of several channels within the network"),
        (column_by_column, "Mul out must have a constant of one number for each channel, got 36"),
        (classes, "cut the network in front of it. 'check' and 'bench' read any network"),
    ],
)
def test_what_would_be_computed_wrongly_is_refused(
    make: Callable[[Sketch], onnx.ModelProto], message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        read_network(make(Sketch()))
