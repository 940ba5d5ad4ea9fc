"""The page of a detection study: crops with boxes, precision by recall, and the tables."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle

import numpy as np
from PIL import Image, ImageDraw

from deploy.detection.boxes import Boxes, iou
from deploy.detection.matching import ALL, Matched
from deploy.detection.scores import RECALLS, mean, precisions
from deploy.detection.study import REFERENCE, Comparison
from deploy.report.page import Picture
from deploy.report.plots import SERIES, Curve, Panel, curves_svg
from model.evaluation.methods import DEGRADED
from model.io.pictures import grid, picture_url

CROP_PX, ZOOM, SCENES = 88, 3, 4
OVERLAP = 0.5
FOUND, MISSED, FALSE = "#2fd39b", "#ff5a36", "#ffd21f"
"""Colours of boxes."""


@dataclass(frozen=True)
class Marks:
    """What a detector found on an image at a confidence: (N,) of its boxes, (M,) of the labelled ones.

    Attributes:
        hits: which of the boxes found an object.
        found: which objects were found.
        counted: which of the boxes reach the confidence.
    """

    hits: np.ndarray
    found: np.ndarray
    counted: np.ndarray


def marks_of(truth: Boxes, boxes: Boxes, confidence: float) -> Marks:
    """Which boxes found an object of their class that they overlap by half, the best scored first."""
    hits, found = np.zeros(len(boxes), bool), np.zeros(len(truth), bool)
    counted = boxes.scores >= confidence
    overlaps = iou(boxes.corners, truth.corners) * (boxes.classes[:, None] == truth.classes[None, :])
    for one in np.argsort(-boxes.scores, kind="stable"):
        free = np.where(found, 0.0, overlaps[one])
        if counted[one] and len(free) and free.max() >= OVERLAP:
            hits[one] = found[int(free.argmax())] = True
    return Marks(hits, found, counted)


def crops(compared: Sequence[Comparison]) -> list[Picture]:
    """The same crops of a few scenes, a row a sensor and a column a method, where degradation costs most objects.

    The classes take turns, those with most objects first, each with a scene that no other has shown.
    """
    truths = [view.subject.truth for view in compared[0].views]
    kinds, counts = np.unique(np.concatenate([truth.classes for truth in truths]), return_counts=True)
    left, pictures = set(range(len(truths))), []
    turns = cycle(kinds[np.argsort(-counts, kind="stable")].tolist())
    for kind, _ in zip(turns, range(min(SCENES, len(truths))), strict=False):
        number = max(sorted(left), key=lambda each: _worth(compared, each, kind))
        left.remove(number)
        pictures.append(_picture(compared, number, kind))
    return pictures


def _worth(compared: Sequence[Comparison], number: int, kind: int) -> tuple[int, int]:
    """By which a scene is chosen: objects of a class that are lost, then objects of it."""
    lost = sum(int(_lost_objects(found, number, kind).sum()) for found in compared)
    return lost, int((compared[0].views[number].subject.truth.classes == kind).sum())


def _marks(found: Comparison, row: str, number: int) -> Marks:
    truth = found.views[number].subject.truth
    return marks_of(truth, found.found[row][number], found.differences.confidence)


def _lost_objects(found: Comparison, number: int, kind: int) -> np.ndarray:
    """(M,) objects of a class in a scene that are found on the reference and not on degraded images."""
    lost = _marks(found, REFERENCE, number).found & ~_marks(found, DEGRADED, number).found
    return np.asarray(lost & (found.views[number].subject.truth.classes == kind))


def _picture(compared: Sequence[Comparison], number: int, kind: int) -> Picture:
    subject, name = compared[0].views[number].subject, next(iter(compared[0].matched.values())).names[kind]
    names = list(compared[0].methods)
    middle = _middle(compared[0], number, kind)
    rows = [_cells(found, number, middle) for found in compared]
    where = " and ".join(found.name for found in compared)
    caption = (
        f"Rows: {where}. {CROP_PX} pixels of the sensor a side, enlarged {ZOOM} times, one display for all. Boxes at "
        "the confidence of the table: green found, red missed, yellow false."
    )
    return Picture(f"{subject.name}, {name}: what is found", picture_url(np.asarray(grid(names, rows, 1))), caption)


def _middle(found: Comparison, number: int, kind: int) -> np.ndarray:
    """(2,) x and y in scene pixels of the object of a class, a lost one if there is any, with most such near it."""
    truth, lost = found.views[number].subject.truth, _lost_objects(found, number, kind)
    middles = (truth.corners[:, :2] + truth.corners[:, 2:])[lost if lost.any() else truth.classes == kind] / 2
    if not len(middles):
        return np.zeros(2)
    reach = CROP_PX * found.sensors.oversampling / 2
    near = (np.abs(middles[:, None] - middles[None]).max(-1) < reach).sum(1)
    return np.asarray(middles[int(near.argmax())])


def _cells(found: Comparison, number: int, middle: np.ndarray) -> list[np.ndarray]:
    """A crop of each row around a place of the scene, moved inside the image."""
    view, ratio = found.views[number], found.sensors.oversampling
    height, width = view.reference.shape
    left, top = (
        int(np.clip(m / ratio - CROP_PX / 2, 0, max(side - CROP_PX, 0)))
        for m, side in zip(middle, (width, height), strict=True)
    )
    window, truth = Window(top, left, ratio), view.subject.truth
    return [
        _cell(view.shown(method), window, found.found[name][number], truth, _marks(found, name, number))
        for name, method in found.methods.items()
    ]


@dataclass(frozen=True)
class Window:
    """Where a crop lies, in the sensor's pixels, each `ratio` of the scene's wide."""

    top: int
    left: int
    ratio: int

    def crop(self, rgb: np.ndarray) -> np.ndarray:
        """The crop of an image (h, w, 3) in 0 to 1 as uint8, black where the image ends."""
        inside = rgb[self.top : self.top + CROP_PX, self.left : self.left + CROP_PX]
        whole = np.zeros((CROP_PX, CROP_PX, 3), np.uint8)
        whole[: inside.shape[0], : inside.shape[1]] = np.rint(255 * inside)
        return whole

    def enlarged(self, corners: np.ndarray) -> np.ndarray:
        """(N, 4) corners in scene pixels as pixels of the enlarged crop."""
        return (corners / self.ratio - [self.left, self.top, self.left, self.top]) * ZOOM


def _cell(rgb: np.ndarray, window: Window, boxes: Boxes, truth: Boxes, marks: Marks) -> np.ndarray:
    """An enlarged crop with what is missed, falsely found and found drawn over it."""
    picture = Image.fromarray(window.crop(rgb)).resize((CROP_PX * ZOOM, CROP_PX * ZOOM), Image.Resampling.NEAREST)
    draw = ImageDraw.Draw(picture)
    shown = (
        (truth.corners[~marks.found & ~truth.ignored], MISSED),
        (boxes.corners[marks.counted & ~marks.hits], FALSE),
        (boxes.corners[marks.counted & marks.hits], FOUND),
    )
    for corners, colour in shown:
        for x1, y1, x2, y2 in window.enlarged(corners):
            draw.rectangle((x1, y1, max(x2 - 1, x1), max(y2 - 1, y1)), outline=colour, width=2)
    return np.asarray(picture)


def curves(compared: Sequence[Comparison]) -> Picture:
    """Precision by recall at an overlap of one half, means over classes: a panel a sensor."""
    panels = [
        Panel(
            found.name,
            [
                Curve(name, number % len(SERIES), name == REFERENCE, _points(matched))
                for number, (name, matched) in enumerate(found.matched.items())
            ],
        )
        for found in compared
    ]
    svg = curves_svg(panels, "recall", "precision", logarithmic=False)
    address = "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()
    return Picture("Precision by recall", address, "At an overlap of 0.5, mean over the classes that are labelled.")


def _points(matched: Matched) -> tuple[tuple[float, float], ...]:
    weights = np.ones(len(matched.sites), np.int64)
    by_class = np.array([precisions(one, weights)[0] for one in matched.by_size[ALL]])
    return tuple((float(recall), mean(values)) for recall, values in zip(RECALLS, by_class.T, strict=True))
