"""Filled with channels of zeros, an INT8 network gives the same numbers."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest

from beers_deploy.network import shipped_pair
from beers_deploy.quant.kernels import FEWEST_OUTPUTS, filled
from beers_deploy.quant.onnx_file import load_onnx

NETWORKS = [shipped_pair()[1], shipped_pair("convbeers-xs")[1]]


def weights(model: onnx.ModelProto) -> list[tuple[int, ...]]:
    """Shapes of the weights of integer convolutions."""
    shapes = {each.name: tuple(each.dims) for each in model.graph.initializer}
    return [shapes[node.input[3]] for node in model.graph.node if node.op_type == "QLinearConv"]


def as_written(model: onnx.ModelProto, image: np.ndarray) -> np.ndarray:
    """On a session of onnxruntime's own, which nobody rewrites a model for."""
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, {"image": image})[0])


@pytest.mark.parametrize("path", NETWORKS, ids=lambda path: path.stem)
@pytest.mark.parametrize("shape", [(4, 4), (37, 53), (64, 41)])
def test_the_numbers_are_the_same(path: Path, shape: tuple[int, int]) -> None:
    model = load_onnx(path)
    image = np.random.default_rng(0).random((1, 1, *shape), dtype=np.float32)
    assert np.array_equal(as_written(filled(model), image), as_written(model, image))


def test_no_convolution_stays_narrow_and_wide_ones_stay_as_they_are() -> None:
    before = load_onnx(shipped_pair()[1])
    after = filled(before)
    onnx.checker.check_model(after)
    for old, new in zip(weights(before), weights(after), strict=True):
        assert new[0] == max(old[0], FEWEST_OUTPUTS)
        assert new[1] % 4 == 0
        assert new[1] - old[1] < 4


def one_convolution(weight: np.ndarray, weight_zero: int, opset: int = 17) -> onnx.ModelProto:
    """Of weights (O, I, 1, 1), int8 or uint8, that someone else's quantiser might write."""
    tensors = {
        "scale": np.float32(0.5),
        "zero": np.uint8(128),
        "weight": weight,
        "weight_zero": weight.dtype.type(weight_zero),
        "bias": np.array([7], np.int32),
    }
    feeds = ["image", "scale", "zero", "weight", "scale", "weight_zero", "scale", "zero", "bias"]
    ends = [
        onnx.helper.make_tensor_value_info(n, onnx.TensorProto.UINT8, [1, c, 3, 5])
        for n, c in (("image", 2), ("y", 1))
    ]
    constants = [onnx.numpy_helper.from_array(np.asarray(value), name) for name, value in tensors.items()]
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("QLinearConv", feeds, ["y"])], "one", ends[:1], ends[1:], constants
    )
    return onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", opset)], ir_version=9)


def test_one_output_channel_is_filled_too() -> None:
    """Of a network with one gain: its bias has one number, as a scale for the whole tensor might."""
    model = one_convolution(np.array([[[[1]], [[-2]]]], np.int8), 0)
    image = np.random.default_rng(0).integers(0, 256, (1, 2, 3, 5)).astype(np.uint8)
    assert weights(filled(model)) == [(FEWEST_OUTPUTS, 4, 1, 1)]
    assert np.array_equal(as_written(filled(model), image), as_written(model, image))


@pytest.mark.parametrize(("zero", "opset"), [(128, 17), (0, 10)])
def test_where_a_stored_zero_is_no_weight_of_zero_nothing_is_filled(zero: int, opset: int) -> None:
    model = one_convolution(np.array([[[[130]], [[120]]]], np.uint8), zero, opset)
    image = np.random.default_rng(0).integers(0, 256, (1, 2, 3, 5)).astype(np.uint8)
    assert weights(filled(model)) == [(1, 2, 1, 1)]
    assert np.array_equal(as_written(filled(model), image), as_written(model, image))
