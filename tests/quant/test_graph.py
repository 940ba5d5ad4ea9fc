import numpy as np
import onnx
import pytest
from onnx import helper

from profiles.errors import ModelError
from quant.graph import CORRECTION, IMAGE, Add, Conv, correction_graph, relu_count
from quant.onnx_file import image_info, make_model


def test_the_global_add_is_left_to_the_host(float_onnx: onnx.ModelProto) -> None:
    graph = correction_graph(float_onnx)
    assert graph[0].inputs == (IMAGE,)
    assert graph[-1].output == CORRECTION
    assert isinstance(graph[-1], Conv)
    assert sum(isinstance(op, Add) for op in graph) == 3


def test_every_relu_is_kept(float_onnx: onnx.ModelProto) -> None:
    assert relu_count(correction_graph(float_onnx)) == sum(n.op_type == "Relu" for n in float_onnx.graph.node) == 2


@pytest.mark.parametrize("kind", ["Sigmoid", "Tanh"])
def test_other_operators_are_refused_by_name(kind: str) -> None:
    nodes = [helper.make_node(kind, ["image"], ["x"]), helper.make_node("Add", ["image", "x"], ["restored"])]
    graph = helper.make_graph(nodes, "g", [image_info("image", 1, None)], [image_info("restored", 1, None)])
    with pytest.raises(ModelError, match=kind):
        correction_graph(make_model(graph, {}))


def test_a_network_without_a_global_add_is_refused(float_onnx: onnx.ModelProto) -> None:
    model = onnx.ModelProto()
    model.CopyFrom(float_onnx)
    model.graph.node.pop()
    model.graph.output[0].name = "tail"
    with pytest.raises(ModelError, match="global add"):
        correction_graph(model)


def test_a_strided_convolution_is_refused(float_onnx: onnx.ModelProto) -> None:
    model = onnx.ModelProto()
    model.CopyFrom(float_onnx)
    model.graph.node[0].attribute.append(helper.make_attribute("strides", [2, 2]))
    with pytest.raises(ModelError, match="stride 1, ReLU and adds, got head"):
        correction_graph(model)


def test_weights_are_read_as_stored(float_onnx: onnx.ModelProto) -> None:
    first = correction_graph(float_onnx)[0]
    assert isinstance(first, Conv)
    stored = next(t for t in float_onnx.graph.initializer if t.name == "head.weight")
    np.testing.assert_array_equal(first.weight, onnx.numpy_helper.to_array(stored))
