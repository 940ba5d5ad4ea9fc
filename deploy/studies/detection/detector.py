"""Detectors as Ultralytics exports them to ONNX: the metadata of a file, and boxes by onnxruntime
on the CPU.

Two layouts are supported (docs.ultralytics.com/integrations/onnx, and files of its 8.4.190). Raw is
1 x (4 + classes) x anchors: centre, size and a score of each class. Final is 1 x N x 6: corners,
score and class, of `nms=True` or of a network that needs no suppression. Both accept RGB in 0 to 1
on a grey letterbox, and return px of the input.
"""

import ast
import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnxruntime import InferenceSession

from beers_deploy.profiles.errors import (
    CODE_FAULTS,
    LONGEST,
    ModelError,
    OptionError,
    printable,
    reason_of,
)
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.onnx.messages import constants
from beers_deploy.quant.onnx_file import load_onnx, metadata
from beers_deploy.quant.session import open_session
from beers_deploy.studies.detection.boxes import MAX_BOXES, Boxes, Letterbox, suppress

MIN_SCORE = 1e-3
"""Detections below this score are dropped, as Ultralytics validates: average precision needs the
doubtful ones.
"""
CUT = 0.01
"""A file that drops detections only below this confidence loses almost nothing of its average
precision.
"""
LITERAL = 1 << 16
"""The maximum number of characters of a Python literal in the metadata. The names of 1 200 classes
need half of it.
"""
ROUNDING = 1e-3
"""The margin by which a score may lie outside 0 to 1."""
REMEDY = "Export it with Ultralytics for detection, with format='onnx'."


@dataclass(frozen=True)
class Detector:
    """An object detector, ready to run.

    Attributes:
        names: the names of the classes, in the order of the class indices of its boxes.
        size_px: the side of its square input in pixels.
        flag: a warning for the reader of results if the file itself drops boxes of low confidence,
            so that its average precision is too low; else empty.
    """

    names: tuple[str, ...]
    size_px: int
    flag: str
    _run: Callable[[np.ndarray], np.ndarray]

    def detect(self, rgb: np.ndarray) -> Boxes:
        """Detect objects on an image.

        Args:
            rgb: the image (H, W, 3), float32 in 0 to 1.

        Returns:
            At most 300 boxes in pixels of the image, cut at its borders, best score first.

        Raises:
            ModelError: the detector does not run, or returns no valid boxes and scores.
        """
        height, width = rgb.shape[:2]
        box = Letterbox(height, width, self.size_px)
        boxes = self.decoded(self._run(box.image(rgb)[None]))
        # Boxes leave the letterbox first, so that they are cut at the borders of the image itself.
        inside = replace(boxes, corners=box.to_image(boxes.corners)).clipped(height, width)
        return Boxes.of(inside.corners, inside.classes, inside.scores)

    def decoded(self, output: np.ndarray) -> Boxes:
        """Convert an output of the network to boxes.

        Args:
            output: either (1, 4 + classes, anchors), centres, sizes and class scores, of which
                several may lie on one object; or (1, N, 6), corners, score and class.

        Returns:
            The boxes in pixels of the detector's input, one on each object, best score first.

        Raises:
            ModelError: the output has another shape, NaN, scores outside 0 to 1 or unknown classes.
        """
        if not _is_read(output.shape, len(self.names)):
            sizes = " x ".join(map(str, output.shape))
            raise ModelError(
                f"The detector's output must have the sizes that its file states, but it has "
                f"{sizes}. {REMEDY}"
            )
        if not np.isfinite(output).all():
            raise ModelError(f"The detector returns NaN or infinity as box or score. {REMEDY}")
        # A raw answer has at least the 21 anchors of an input of 32 px.
        final = output.shape[2] == 6
        scores = output[:, :, 4] if final else output[:, 4:]
        if scores.min(initial=0) < -ROUNDING or scores.max(initial=0) > 1 + ROUNDING:
            raise ModelError(
                f"The detector returns scores outside 0 to 1, perhaps logits or an objectness. "
                f"{REMEDY}"
            )
        if not final:
            # Every pair of an anchor and a class with a sufficient score is a candidate.
            classes, anchors = np.nonzero(scores[0] > MIN_SCORE)
            middle = output[0][:2, anchors].T.astype(np.float64)
            half = output[0][2:4, anchors].T.astype(np.float64) / 2
            corners = np.hstack([middle - half, middle + half])
            return suppress(Boxes.of(corners, classes, scores[0, classes, anchors]))
        # Rows of zeros pad the list.
        rows = output[0][scores[0] > MIN_SCORE]
        if not np.isin(rows[:, 5], np.arange(len(self.names))).all():
            raise ModelError(
                f"The detector returns classes other than 0 to {len(self.names) - 1} in its sixth "
                f"column. {REMEDY}"
            )
        rows = rows[np.argsort(-rows[:, 4], kind="stable")[:MAX_BOXES]]
        return Boxes.of(rows[:, :4], rows[:, 5], rows[:, 4])


def open_detector(path: Path, size_px: int | None = None) -> Detector:
    """Open the file of an object detector.

    Args:
        path: an ONNX file that Ultralytics exported for detection.
        size_px: the side of the square input in pixels; None uses the size that the file is fixed
            to or was trained for.

    Raises:
        ModelError: the file cannot be opened, has another layout, or does not state its classes.
        OptionError: `size_px` contradicts the file, or is missing and the file states no size.
    """
    model = load_onnx(path)
    about: dict[str, Any] = {**metadata(model)}
    # Ultralytics writes its metadata as Python literals. A longer text is not parsed.
    for key, text in metadata(model).items():
        if len(text) <= LITERAL:
            with contextlib.suppress(
                MemoryError, RecursionError, SyntaxError, TypeError, ValueError
            ):
                about[key] = ast.literal_eval(text)
    names = class_names(about.get("names"))
    if not names:
        stated = repr(about["names"])[:80] if "names" in about else "none"
        raise ModelError(
            f"The metadata of {path} must have the names of its classes, such as "
            f"{{0: 'ship', ...}}, but it has {stated}. {REMEDY}"
        )
    task = about.get("task", "detect")
    channels = _sizes(model.graph.input[0])[1:2]
    outputs = [_sizes(value) for value in model.graph.output]
    is_read = len(outputs) == 1 and _is_read(outputs[0], len(names))
    if task != "detect" or channels != [3] or not is_read:
        shapes = ", ".join(" x ".join(map(str, sizes)) for sizes in outputs)
        facts = f"task {task}, channels {' '.join(map(str, channels))}, output {shapes}"
        raise ModelError(
            f"{path} must have a detector's output as Ultralytics exports it for RGB, "
            f"1 x {4 + len(names)} x anchors for {len(names)} classes (raw) or 1 x N x 6 (nms=True "
            f"or end2end), but it has {printable(facts)}. {REMEDY}"
        )
    size = _size_px(fixed_tile_px(model), about.get("imgsz"), size_px, path)
    return Detector(names, size, _flag(model), partial(_answer, open_session(model), path))


def _answer(session: InferenceSession, path: Path, image: np.ndarray) -> np.ndarray:
    try:
        return np.asarray(session.run(None, {session.get_inputs()[0].name: image})[0])
    except CODE_FAULTS:
        raise
    except Exception as error:
        # onnxruntime raises a class of its own for each status code.
        reason = reason_of(error)
        raise ModelError(
            f"The detector {path} does not run: {reason}. Export it again, for one size of image."
        ) from error


def _is_read(shape: Sequence[int], classes: int) -> bool:
    """Return True if an output is raw or final, of one image. 0 stands for a size that a file
    leaves open.
    """
    return len(shape) == 3 and shape[0] in (0, 1) and (shape[1] == 4 + classes or shape[2] == 6)


def _sizes(value: onnx.ValueInfoProto) -> list[int]:
    """Return the sizes that a file states for an input or output, with 0 for those left open."""
    return [dimension.dim_value for dimension in value.type.tensor_type.shape.dim]


def _size_px(fixed: int | None, stated: Any, requested: int | None, path: Path) -> int:
    if fixed and requested not in (None, fixed):
        raise OptionError(
            f"`side` must be {fixed} px, which {path.name} is fixed to, but it is {requested} px. "
            f"Export the detector for {requested} px, or leave `side` out."
        )
    if isinstance(stated, list) and len(stated) == 2 and stated[0] == stated[1]:
        stated = stated[0]
    size = fixed or requested or stated
    if not isinstance(size, int) or size < 1:
        raise OptionError(
            "The side of the detector's square input must be a number of px, but "
            f"{path.name} states {printable(str(size))}. Give `side`."
        )
    return size


def _flag(model: onnx.ModelProto) -> str:
    """Return a sentence on the loss by suppression inside the file. Its confidence threshold is
    found only in the graph.
    """
    if not any(node.op_type == "NonMaxSuppression" for node in model.graph.node):
        return ""
    values = constants(model)
    comparisons = (node.input for node in model.graph.node if node.op_type == "Greater")
    limits = [
        values[name].max()
        for name in chain.from_iterable(comparisons)
        if name in values and values[name].size
    ]
    if limits and max(limits) <= CUT:
        return ""
    where = f"confidence {max(limits):.3g}" if limits else "an unknown confidence"
    return (
        f"The detector's own suppression drops what lies below {where}, so average precision is "
        "too low: export it without nms, or with conf=0.001."
    )


def letters(name: str) -> str:
    """Return the letters and digits of a class name in lower case, for the comparison of names that
    tools spell differently, such as "Small-Car" and "small car".
    """
    return "".join(c for c in name.casefold() if c.isalnum())


def class_names(names: Any) -> tuple[str, ...]:
    """Return the class names that a detector's file states, in the order of their indices.

    Args:
        names: the value in the file's metadata: a list of names, or a dict of names by number from
            0. Any other value is not valid.

    Returns:
        The names; an empty tuple if the value is not valid.
    """
    names = (
        [names.get(number) for number in range(len(names))] if isinstance(names, dict) else names
    )
    if not isinstance(names, list) or not all(
        isinstance(name, str) and letters(name) for name in names
    ):
        return ()
    return tuple(str(name).strip() for name in names)


def parse_classes(text: str) -> dict[str, str]:
    """Parse the option that maps labelled classes to classes of the detector.

    Args:
        text: pairs of names, LABELLED=DETECTOR,LABELLED=DETECTOR.

    Returns:
        The detector's name by the labelled name.

    Raises:
        OptionError: the text has another form, or names a labelled class twice.
    """
    pairs = [[part.strip() for part in entry.split("=")] for entry in text.split(",")]
    valid = all(len(pair) == 2 and all(map(letters, pair)) for pair in pairs)
    if not valid or len({letters(pair[0]) for pair in pairs}) < len(pairs):
        raise OptionError(
            "`classes` must be LABELLED=DETECTOR,..., each labelled class once, such as "
            f"car=vehicle,minibus=vehicle, but it is {printable(repr(text))}."
        )
    return dict(pairs)


def class_numbers(
    labelled: Sequence[str], detector: Sequence[str], mapping: Mapping[str, str]
) -> np.ndarray:
    """Map each labelled class to the index of a class of the detector.

    A class is mapped as `mapping` states. Without an entry it is mapped to the class of the same
    name; case, spaces and punctuation are ignored.

    Args:
        labelled: the L names of the labelled classes, in the order of their indices.
        detector: the names of the detector's classes, in the order of their indices.
        mapping: the detector's name by the labelled name, as `parse_classes` returns it.

    Returns:
        The index of the detector's class for each labelled class, (L,) int64; -1 for a class that
        the detector does not know. `Boxes.renamed` accepts it.

    Raises:
        OptionError: `mapping` has a name that is not a class, the detector's names are ambiguous,
            or no class is mapped.
    """
    number = {letters(name): i for i, name in enumerate(detector)}
    if len(number) < len(detector):
        raise OptionError(
            "`detector` must have classes that differ in their letters, but two have the same "
            "letters. Export one whose classes differ."
        )
    for requested, names in ((mapping, labelled), (mapping.values(), detector)):
        for name in requested:
            if letters(name) not in map(letters, names):
                raise OptionError(
                    f"{printable(repr(name))} in `classes` is not one of the classes "
                    f"{printable(', '.join(names), 4 * LONGEST)}. Write LABELLED=DETECTOR."
                )
    own = {letters(name): letters(other) for name, other in mapping.items()}
    keys = [own.get(letters(name), letters(name)) for name in labelled]
    numbers = np.array([number.get(key, -1) for key in keys], np.int64)
    if not (numbers >= 0).any():
        raise OptionError(
            f"The labelled classes ({printable(', '.join(labelled)) or 'none'}) have no class in "
            f"common with the detector ({printable(', '.join(detector), 4 * LONGEST)}). Give "
            "`classes` as LABELLED=DETECTOR."
        )
    return numbers
