"""Boxes drawn at random, and what pycocotools itself makes of them."""

import io
from collections.abc import Sequence
from contextlib import redirect_stdout

import numpy as np
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from deploy.detection.boxes import Boxes
from deploy.detection.matching import SIZES_PX, Image

NAMES = ("ship", "tank", "vehicle")


def drawn_images(rng: np.random.Generator, count: int, ties: bool = False, ignored: bool = True) -> list[Image]:
    """Images of a few objects of all sizes: some found well, some badly or as another class, and false ones beside.

    With `ties` scores are of ten values; else no two are alike.
    """
    images = []
    for number in range(count):
        truth = _boxes(rng, int(rng.integers(0, 7)))
        passed = rng.random(len(truth)) < (0.2 if ignored else 0.0)
        again = rng.integers(0, max(len(truth), 1), int(rng.integers(0, 12)) if len(truth) else 0)
        near = truth.corners[again] + rng.normal(0, 1.5, (len(again), 4))
        near[:, 2:] = np.maximum(near[:, 2:], near[:, :2] + 1)
        named = np.where(rng.random(len(again)) < 0.8, truth.classes[again], rng.integers(0, 3, len(again)))
        false = _boxes(rng, int(rng.integers(0, 6)))
        corners, classes = np.vstack([near, false.corners]), np.concatenate([named, false.classes])
        scores = rng.random(len(corners)).round(1 if ties else 12)
        found = Boxes.of(corners, classes, scores)
        images.append(Image(Boxes.of(truth.corners, truth.classes, ignored=passed), found, f"site {number}"))
    return images


def _boxes(rng: np.random.Generator, count: int) -> Boxes:
    low = rng.uniform(0, 100, (count, 2))
    return Boxes.of(np.hstack([low, low + rng.uniform(4, 60, (count, 2))]), rng.integers(0, 3, count))


def by_pycocotools(images: Sequence[Image], size: str = "all") -> np.ndarray:
    """Average precision by overlap and class, (10, 3), -1 where a class has no object: all of it by the library."""
    with redirect_stdout(io.StringIO()):
        evaluation = COCOeval(_table(images, "truth"), _table(images, "found"), "bbox")
        evaluation.params.maxDets = [1000]
        low, high = SIZES_PX[size]
        evaluation.params.areaRng, evaluation.params.areaRngLbl = [[low**2, high**2]], [size]
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][:, :, :, 0, 0]  # overlap, recall, class
    return np.asarray(precision.mean(axis=1))


def _table(images: Sequence[Image], role: str) -> COCO:
    rows: list[dict[str, object]] = []
    for number, image in enumerate(images):
        boxes: Boxes = getattr(image, role)
        for i in range(len(boxes)):
            left, top, right, bottom = boxes.corners[i].tolist()
            box = [left, top, right - left, bottom - top]
            row = {"id": len(rows) + 1, "image_id": number, "category_id": int(boxes.classes[i]), "bbox": box}
            row |= {"area": box[2] * box[3], "score": float(boxes.scores[i]), "iscrowd": int(boxes.ignored[i])}
            rows.append(row)
    table = COCO()
    table.dataset = {
        "images": [{"id": number} for number in range(len(images))],
        "categories": [{"id": number} for number in range(len(NAMES))],
        "annotations": rows,
    }
    table.createIndex()
    return table
