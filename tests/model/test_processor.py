"""The processor is asked by computing: its answers hold for larger computations of the same kind."""

import numpy as np
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

from model.processor import bfloat16_speed, decided, int8_adds_exactly


def convolved(image: np.ndarray, weight: np.ndarray, scale: float) -> np.ndarray:
    """A quantised 3 x 3 convolution (1, C, H, W) uint8 by (O, C, 3, 3) int8, as onnxruntime's kernels compute it."""
    constants = {
        "one": np.float32(1),
        "zero": np.uint8(0),
        "weight": weight,
        "no_offset": np.int8(0),
        "scale": np.float32(scale),
    }
    feeds = ["image", "one", "zero", "weight", "one", "no_offset", "scale", "zero"]
    ends = [helper.make_tensor_value_info(name, TensorProto.UINT8, None) for name in ("image", "result")]
    held = [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()]
    node = helper.make_node("QLinearConv", feeds, ["result"], pads=[1, 1, 1, 1])
    graph = helper.make_graph([node], "one", ends[:1], ends[1:], held)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, {"image": image})[0])


def test_the_answer_holds_for_convolutions() -> None:
    """The largest products: their sum at the middle of an image, in units of a two hundredth of it."""
    image, weight = np.full((1, 32, 9, 11), 255, np.uint8), np.full((32, 32, 3, 3), 127, np.int8)
    middle = convolved(image, weight, 32 * 9 * 255 * 127 / 200)[0, :, 1:-1, 1:-1]
    assert bool((middle == 200).all()) == int8_adds_exactly()


def test_what_was_asked_is_told_in_words() -> None:
    int8_adds_exactly()
    bfloat16_speed()
    assert set(decided()) == {"int8", "bfloat16"}
    assert "times the speed of float32" in decided()["bfloat16"]


def test_the_speed_of_bfloat16_is_measured_once_a_process() -> None:
    """Two answers could differ on a busy machine, and one run must not mix them."""
    assert bfloat16_speed() == bfloat16_speed() > 0
