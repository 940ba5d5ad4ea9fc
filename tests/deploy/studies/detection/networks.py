"""Detectors whose answer is known, as ONNX files: what they answer is written into them."""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

NAMES = {0: "Storage Tank", 1: "ship"}


def detector(
    path: Path,
    answer: np.ndarray,
    *,
    size_px: int | str = 64,
    cut: float | None = None,
    outputs: int = 1,
    channels: int = 3,
    **about: object,
) -> Path:
    """A file that answers `answer` whatever the image, (1, 4 + classes, anchors) or (1, N, 6).

    Args:
        path: of the file.
        answer: what it answers.
        size_px: of the input; a text leaves it open.
        cut: of a suppression inside the file, its confidence.
        outputs: how many times the answer is given.
        channels: of the input.
        about: metadata; None leaves one out.
    """
    given = {"names": NAMES, "task": "detect", "stride": 32, "imgsz": [64, 64], **about}
    constants = {"answer": answer.astype(np.float32), "none": np.zeros(1, np.float32)}
    nodes = [
        helper.make_node("GlobalAveragePool", ["images"], ["mean"]),
        helper.make_node("ReduceMean", ["mean"], ["level"], keepdims=0),
        helper.make_node("Mul", ["level", "none"], ["nothing"]),
        helper.make_node("Add", ["answer", "nothing"], ["sum"]),
    ]
    last = "sum"
    if cut is not None:
        boxes, scores = np.array([[[0, 0, 1, 1]]], np.float32), np.array([[[0.5]]], np.float32)
        constants |= {"boxes": boxes, "scores": scores, "cut": np.array(cut, np.float32), "most": np.array([1])}
        nodes += [
            helper.make_node("Add", ["scores", "nothing"], ["score"]),
            helper.make_node("Greater", ["score", "cut"], ["kept"]),
            helper.make_node("Where", ["kept", "score", "none"], ["left"]),
            helper.make_node("NonMaxSuppression", ["boxes", "left", "most"], ["indices"]),
            helper.make_node("Cast", ["indices"], ["index"], to=TensorProto.FLOAT),
            helper.make_node("ReduceSum", ["index"], ["total"], keepdims=0),
            helper.make_node("Mul", ["total", "none"], ["nil"]),
            helper.make_node("Add", ["sum", "nil"], ["suppressed"]),
        ]
        last = "suppressed"
    names = [f"output{i}" for i in range(outputs)]
    nodes += [helper.make_node("Identity", [last], [name]) for name in names]
    graph = helper.make_graph(
        nodes,
        "detector",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, channels, size_px, size_px])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, list(answer.shape)) for name in names],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {key: str(value) for key, value in given.items() if value is not None})
    onnx.save_model(model, path)
    return path


def raw(*rows: tuple[float, ...], anchors: int = 20) -> np.ndarray:
    """Centre, size and a score of each class, a row a box, as (1, 4 + classes, anchors); the rest is nothing."""
    found = np.zeros((anchors, 4 + len(NAMES)), np.float32)
    found[: len(rows)] = np.reshape(rows, (-1, found.shape[1]))
    return found.T[None]


def final(*rows: tuple[float, ...], count: int = 300) -> np.ndarray:
    """Corners, score and class, a row a box, as (1, 300, 6), padded with zeros."""
    found = np.zeros((count, 6), np.float32)
    found[: len(rows)] = np.reshape(rows, (-1, found.shape[1]))
    return found[None]
