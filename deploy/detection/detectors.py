"""Detectors as Ultralytics exports them to ONNX: what a file says of itself, and boxes by onnxruntime on the CPU.

Two layouts are read (docs.ultralytics.com/integrations/onnx, and files of its 8.4.190): raw, 1 x (4 + classes) x
anchors, centre, size and a score of each class; and final, 1 x N x 6, corners, score and class, of `nms=True` or of a
network that needs no suppression. Both take RGB in 0 to 1 on a grey letterbox, and answer in px of the input.
"""

import ast
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnx
import onnxruntime as ort

from deploy.detection.boxes import MOST, Boxes, Letterbox, suppress
from deploy.detection.classes import letters
from model.processor import require_cores
from profiles.errors import ModelError, OptionError
from quant.onnx_file import constants, fixed_tile_px, load_onnx, metadata
from quant.session import open_session

LEAST_SCORE = 1e-3
"""Below it a detection is none, as Ultralytics validates: average precision needs the doubtful ones."""

CUT = 0.01
"""A file that drops detections only below this confidence loses next to nothing of its average precision."""

LITERAL = 1 << 16
"""Characters of a Python literal in the metadata; the names of 1 200 classes take half of it."""

ROUNDING = 1e-3
"""By how much a score may pass 0 or 1."""

Layout = Literal["raw", "final"]
REMEDY = "export it by Ultralytics for detection, with format='onnx'"


@dataclass(frozen=True)
class Detector:
    """A detector ready to run.

    Attributes:
        names: of its classes, in its order.
        size_px: side of its square input.
        layout: of its output: raw, or final boxes.
        flag: why its average precision comes out too low, in a sentence; None where nothing is cut.
    """

    names: tuple[str, ...]
    size_px: int
    layout: Layout
    flag: str | None
    _run: Callable[[np.ndarray], np.ndarray]

    def detect(self, rgb: np.ndarray) -> Boxes:
        """What it finds on an image, the best scored first, 300 boxes at most.

        Args:
            rgb: (H, W, 3) float32 in 0 to 1, any size.

        Returns:
            Boxes in px of the image, cut at its borders.

        Raises:
            OptionError: an image too narrow for the input.
            ModelError: it does not run, or answers no scores in 0 to 1.
        """
        height, width = rgb.shape[:2]
        box = Letterbox(height, width, self.size_px)
        found = self.decoded(self._run(box.image(rgb)[None]))
        inside = found.at(box.to_scene(found.corners)).clipped(height, width)
        return Boxes.of(inside.corners, inside.classes, inside.scores)

    def decoded(self, output: np.ndarray) -> Boxes:
        """Boxes in px of the input, suppressed, of what the network answered.

        Args:
            output: (1, 4 + classes, anchors) raw, or (1, N, 6) final; float.

        Raises:
            ModelError: of another size, scores outside 0 to 1, or values that are not finite.
        """
        self._check(output)
        if self.layout == "raw":
            return suppress(_raw(output[0]))
        found = _final(output[0], len(self.names))
        return found[np.argsort(-found.scores, kind="stable")[:MOST]]

    def _check(self, output: np.ndarray) -> None:
        axis, size = (1, 4 + len(self.names)) if self.layout == "raw" else (2, 6)
        if output.ndim != 3 or len(output) != 1 or output.shape[axis] != size:
            got = " x ".join(map(str, output.shape))
            raise ModelError(
                "detector", expected="an answer of the sizes that its file states", got=got, remedy=REMEDY
            )
        if not np.isfinite(output).all():
            raise ModelError("detector", expected="finite boxes and scores", got="NaN or infinity", remedy=REMEDY)
        scores = output[:, 4:] if self.layout == "raw" else output[:, :, 4]
        if scores.min(initial=0) < -ROUNDING or scores.max(initial=0) > 1 + ROUNDING:
            got = "others: logits or an objectness perhaps"
            raise ModelError("detector", expected="scores in 0 to 1", got=got, remedy=REMEDY)


def open_detector(path: Path, threads: int = 0, size_px: int | None = None) -> Detector:
    """Open a detector's file.

    Args:
        path: ONNX, float or quantised.
        threads: 0 takes every core.
        size_px: side of the input of a file that takes any; None takes the one it was exported for.

    Raises:
        ModelError: a file that is not to be trusted, or of another layout.
        OptionError: another size than the file is fixed to, or more threads than cores.
    """
    require_cores("--threads", threads)
    model = load_onnx(path)
    about = {key: _literal(value) for key, value in metadata(model).items()}
    names = _names(about.get("names"), path)
    layout = _layout(model, about, len(names), path)
    size = _size_px(fixed_tile_px(model), about, size_px, path)
    return Detector(names, size, layout, _flag(model), _runner(model, threads, path))


def _runner(model: onnx.ModelProto, threads: int, path: Path) -> Callable[[np.ndarray], np.ndarray]:
    session: ort.InferenceSession = open_session(model, threads)
    name = session.get_inputs()[0].name

    def run(image: np.ndarray) -> np.ndarray:
        try:
            return np.asarray(session.run(None, {name: image})[0])
        except Exception as error:  # onnxruntime raises a class of its own for each status code
            got = " ".join(str(error).split())[:160]
            remedy = "export it again, for one size of image"
            raise ModelError(str(path), expected="a detector that runs", got=got, remedy=remedy) from error

    return run


def _literal(text: str) -> Any:
    """What a value of the metadata stands for, where it is a Python literal; else the text."""
    try:
        return ast.literal_eval(text) if len(text) <= LITERAL else text
    except (MemoryError, RecursionError, SyntaxError, TypeError, ValueError):
        return text


def _names(found: Any, path: Path) -> tuple[str, ...]:
    values = [found.get(number) for number in range(len(found))] if isinstance(found, dict) else found
    if (
        not isinstance(values, list)
        or not values
        or not all(isinstance(name, str) and letters(name) for name in values)
    ):
        got = "none" if found is None else repr(found)[:80]
        raise _unread(path, "the names of its classes in its metadata, {0: 'ship', ...}", got)
    return tuple(values)


def _layout(model: onnx.ModelProto, about: dict[str, Any], classes: int, path: Path) -> Layout:
    """Which of the two layouts, by task, shapes and what made it.

    Raises:
        ModelError: another one.
    """
    task, channels = about.get("task", "detect"), _sizes(model.graph.input[0])[1:2]
    outputs = [_sizes(value) for value in model.graph.output]
    other = "rtdetr" in letters(
        f"{about.get('head', '')}{about.get('description', '')}"
    )  # as final, but for 2 classes
    shape = outputs[0] if len(outputs) == 1 and len(outputs[0]) == 3 and not other else []
    if task == "detect" and channels == [3] and shape and shape[0] in (0, 1):
        if shape[1] == 4 + classes:
            return "raw"
        if shape[2] == 6:
            return "final"
    read = f"for RGB, 1 x {4 + classes} x anchors for {classes} classes (raw) or 1 x N x 6 (nms=True or end2end)"
    shapes = ", ".join(" x ".join(map(str, sizes)) for sizes in outputs)
    got = f"task {task}, {' '.join(map(str, channels))} channels, output {shapes}{', of RT-DETR' if other else ''}"
    raise _unread(path, f"a detector's output as Ultralytics exports it {read}", got)


def _sizes(value: onnx.ValueInfoProto) -> list[int]:
    """Sizes that a file states of an input or output; 0 where it leaves one open."""
    return [dimension.dim_value for dimension in value.type.tensor_type.shape.dim]


def _size_px(fixed: int | None, about: dict[str, Any], asked: int | None, path: Path) -> int:
    stated, stride = about.get("imgsz"), about.get("stride")
    sides = set(stated) if isinstance(stated, list) else {stated}
    size = fixed or asked or (sides.pop() if len(sides) == 1 else None)
    step = stride if isinstance(stride, int) and stride > 0 and not fixed else 1
    if fixed and asked not in (None, fixed):
        remedy = f"export it for {asked} px, or leave --size out"
        raise OptionError("--size", expected=f"{fixed}, which {path.name} is fixed to", got=f"{asked}", remedy=remedy)
    if not isinstance(size, int) or size < step or size % step:
        expected = f"a side of the detector's input in px, a multiple of its stride of {step}"
        raise OptionError("--size", expected=expected, got=f"{size}", remedy="say it")
    return size


def _flag(model: onnx.ModelProto) -> str | None:
    """What suppression inside the file costs; the confidence it cuts at stands nowhere but in its graph."""
    if not any(node.op_type == "NonMaxSuppression" for node in model.graph.node):
        return None
    known = constants(model)
    limits = [
        known[name] for node in model.graph.node if node.op_type == "Greater" for name in node.input if name in known
    ]
    cut = max((float(limit.max()) for limit in limits if limit.size), default=None)
    if cut is not None and cut <= CUT:
        return None
    where = "an unknown confidence" if cut is None else f"confidence {cut:.3g}"
    effect = f"The detector's own suppression drops what lies below {where}, so average precision is too low"
    return f"{effect}: export it without nms, or with conf=0.001."


def _raw(output: np.ndarray) -> Boxes:
    """Every pair of an anchor and a class whose score counts; px of the input."""
    classes, anchors = np.nonzero(output[4:] > LEAST_SCORE)
    middle, half = output[:2, anchors].T.astype(np.float64), output[2:4, anchors].T.astype(np.float64) / 2
    return Boxes.of(np.hstack([middle - half, middle + half]), classes, output[4 + classes, anchors])


def _final(output: np.ndarray, classes: int) -> Boxes:
    """Rows with a score that counts: the rest pads the list with zeros."""
    rows = output[output[:, 4] > LEAST_SCORE]
    if len(rows) and not np.isin(rows[:, 5], np.arange(classes)).all():
        expected = f"classes from 0 to {classes - 1} in its sixth column"
        raise ModelError("detector", expected=expected, got="others", remedy=REMEDY)
    return Boxes.of(rows[:, :4], rows[:, 5].astype(np.int64), rows[:, 4])


def _unread(path: Path, expected: str, got: str) -> ModelError:
    return ModelError(str(path), expected=expected, got=got, remedy=REMEDY)
