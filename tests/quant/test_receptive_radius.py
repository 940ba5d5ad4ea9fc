"""The receptive radius: exact where the same is computed at every pixel, refused elsewhere."""

from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper, numpy_helper

from profiles.errors import ModelError
from quant.onnx_file import image_info, make_model, receptive_radius_px


def constant(name: str, *shape: int) -> onnx.TensorProto:
    values = np.random.default_rng(len(name)).normal(size=shape)
    return numpy_helper.from_array(values.astype(np.float32), name)


def graph(nodes: list[onnx.NodeProto], *constants: onnx.TensorProto) -> onnx.ModelProto:
    ends = [image_info("image", 1, None)], [image_info("restored", 1, None)]
    model = make_model(helper.make_graph(nodes, "one", *ends, list(constants)), {})
    onnx.checker.check_model(model)
    return model


def one(kind: str, *constants: onnx.TensorProto, **attributes: Any) -> onnx.ModelProto:
    feeds = ["image", *(c.name for c in constants)]
    return graph([helper.make_node(kind, feeds, ["restored"], **attributes)], *constants)


LOCAL = {
    "3 x 3": (one("Conv", constant("w", 1, 1, 3, 3), pads=[1] * 4), 1),
    "5 x 3": (one("Conv", constant("w", 1, 1, 5, 3), pads=[2, 1, 2, 1]), 2),
    "dilated": (one("Conv", constant("w", 1, 1, 3, 3), pads=[4] * 4, dilations=[4, 4]), 4),
    "one-sided": (one("Conv", constant("w", 1, 1, 3, 3), pads=[2, 0, 0, 2]), 2),
    "same": (one("Conv", constant("w", 1, 1, 4, 4), auto_pad="SAME_UPPER"), 2),
    "pool": (one("MaxPool", kernel_shape=[5, 5], pads=[2] * 4), 2),
    "mean": (one("AveragePool", kernel_shape=[3, 3], pads=[1] * 4), 1),
    "gain": (one("Mul", constant("gain", 1, 1, 1)), 0),
}


@pytest.mark.parametrize("name", LOCAL)
def test_no_pixel_depends_on_one_beyond_the_radius(name: str) -> None:
    model, radius_px = LOCAL[name]
    assert receptive_radius_px(model) == radius_px
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    image = np.zeros((2, 1, 21, 23), np.float32)
    image[1, 0, 10, 11] = 9
    still, moved = session.run(None, {"image": image})[0][:, 0]
    rows, columns = np.nonzero(still != moved)
    assert max(np.abs(rows - 10).max(), np.abs(columns - 11).max()) == radius_px


ELSEWHERE = {
    "GlobalAveragePool": one("GlobalAveragePool"),
    "InstanceNormalization": one("InstanceNormalization", constant("scale", 1), constant("bias", 1)),
    "Softmax": one("Softmax", axis=3),
    "ReduceMean": one("ReduceMean", axes=[2, 3]),
    "Resize": graph(
        [helper.make_node("Resize", ["image", "", "sizes"], ["restored"])],
        numpy_helper.from_array(np.array([1, 1, 2, 2], np.float32), "sizes"),
    ),
    "DynamicQuantizeLinear": graph(
        [
            helper.make_node("DynamicQuantizeLinear", ["image"], ["q", "s", "z"]),
            helper.make_node("DequantizeLinear", ["q", "s", "z"], ["restored"]),
        ]
    ),
    "Conv without its padding": one("Conv", constant("w", 1, 1, 3, 3)),
    "Conv with stride": one("Conv", constant("w", 1, 1, 3, 3), pads=[1] * 4, strides=[2, 2]),
    "MaxPool with stride": one("MaxPool", kernel_shape=[2, 2], strides=[2, 2]),
    "Add of a map": one("Add", constant("map", 1, 1, 40, 40)),
    "Mul along the rows": one("Mul", constant("ramp", 40)),
    "Concat of rows": graph([helper.make_node("Concat", ["image", "image"], ["restored"], axis=2)]),
    "MaxPool's places": graph(
        [
            helper.make_node("MaxPool", ["image"], ["max", "places"], kernel_shape=[3, 3], pads=[1] * 4),
            helper.make_node("Cast", ["places"], ["restored"], to=TensorProto.FLOAT),
        ]
    ),
}


@pytest.mark.parametrize("name", ELSEWHERE)
def test_what_depends_on_the_place_or_the_whole_image_is_refused(name: str) -> None:
    with pytest.raises(ModelError, match=name.split()[0].removesuffix("'s")):
        receptive_radius_px(ELSEWHERE[name])


def test_constants_in_the_graph_are_followed() -> None:
    weight = helper.make_node("Constant", [], ["w"], value=constant("w", 1, 1, 7, 7))
    conv = helper.make_node("Conv", ["image", "w"], ["restored"], pads=[3] * 4)
    assert receptive_radius_px(graph([weight, conv])) == 3
