"""ONNX files of detectors that return a fixed answer, which is stored in the file."""

from pathlib import Path

import numpy as np
import onnx
from onnx import helper

from tests.quant.simplify.networks import parsed

NAMES = {0: "Storage Tank", 1: "ship"}
SUPPRESSION = """
        score = Add(scores, nothing)
        kept = Greater(score, cut)
        left = Where(kept, score, none)
        indices = NonMaxSuppression(boxes, left, most)
        index = Cast<to=1>(indices)
        total = ReduceSum<keepdims=0>(index)
        nil = Mul(total, none)
        suppressed = Add(sum, nil)
"""


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
    """Write a detector that returns `answer` for any image.

    Args:
        path: the file to write.
        answer: the result, (1, 4 + classes, anchors) or (1, N, 6).
        size_px: the side of the input; a text leaves it open.
        cut: the confidence threshold of a suppression inside the file, None for no suppression.
        outputs: the number of outputs, which all have the answer.
        channels: the number of channels of the input.
        about: metadata; None omits an entry.
    """
    metadata = {"names": NAMES, "task": "detect", "stride": 32, "imgsz": [64, 64], **about}
    sizes = ",".join(map(str, answer.shape))
    names = [f"output{i}" for i in range(outputs)]
    last = "sum" if cut is None else "suppressed"
    results = "".join(f"{name} = Identity({last})\n" for name in names)
    nodes = f"""
        mean = GlobalAveragePool(images)
        level = ReduceMean<keepdims=0>(mean)
        nothing = Mul(level, none)
        sum = Add(answer, nothing)
        {"" if cut is None else SUPPRESSION}
        {results}
    """
    image = f"float[1,{channels},{size_px},{size_px}] images"
    constants = {
        "answer": answer,
        "none": [0.0],
        "boxes": [[[0.0, 0.0, 1.0, 1.0]]],
        "scores": [[[0.5]]],
        "cut": cut,
        "most": [1],
    }
    ends = ", ".join(f"float[{sizes}] {name}" for name in names)
    model = parsed(nodes, f"{image} => {ends}", constants=constants)
    helper.set_model_props(
        model, {key: str(value) for key, value in metadata.items() if value is not None}
    )
    onnx.save_model(model, path)
    return path


def raw(*rows: tuple[float, ...], anchors: int = 20) -> np.ndarray:
    """Return boxes in the raw layout (1, 4 + classes, anchors), padded with zeros.

    Each row is a box: centre, size and a score for each class.
    """
    answer = np.zeros((anchors, 4 + len(NAMES)), np.float32)
    answer[: len(rows)] = np.reshape(rows, (-1, answer.shape[1]))
    return answer.T[None]


def final(*rows: tuple[float, ...], count: int = 300) -> np.ndarray:
    """Return boxes in the final layout (1, 300, 6), padded with zeros.

    Each row is a box: corners, score and class.
    """
    answer = np.zeros((count, 6), np.float32)
    answer[: len(rows)] = np.reshape(rows, (-1, answer.shape[1]))
    return answer[None]
