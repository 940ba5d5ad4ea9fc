"""Match detections with labelled objects by pycocotools, the reference code of the COCO evaluation.

The detection with the best score is matched first, with the free object of its class that it
overlaps most. Detections in an ignored box count neither as hits nor as false. The same holds for
objects of another size, and for detections of another size that found none. Every detection counts,
while COCO uses the best 100 of a class, because aerial images contain more objects than photographs
do.
"""

import io
import math
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass

import numpy as np
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from beers_deploy.studies.detection.boxes import Boxes, areas

OVERLAPS = np.linspace(0.5, 0.95, 10)
"""Intersection over union from which a box counts as found: ten levels, as in COCO."""
SIZES_PX = {
    "all": (0.0, math.inf),
    "under 16 px": (0.0, 16.0),
    "16 to 32 px": (16.0, 32.0),
    "32 px up": (32.0, math.inf),
}
"""Square root of a box's area, in px of the scene: from the first value to below the second."""
ALL = 0
"""The index in `SIZES_PX` of all sizes."""


@dataclass(frozen=True)
class Hits:
    """The D detections of one detector on I images with M labelled boxes, and which of them found
    an object.

    Results depend on the range of object sizes (S ranges, `SIZES_PX`) and on the overlap that is
    required (`OVERLAPS`, 10 of them).

    Attributes:
        images: the index of the image of each detection, (D,) int64.
        classes: the index of the class of each detection, (D,) int64.
        scores: the confidence of each detection, (D,) float64.
        hits: True if the detection found an object, (S, 10, D) bool.
        ignored: True if the detection counts neither as a hit nor as false, (S, 10, D) bool.
        label_images: the index of the image of each labelled box, (M,) int64.
        found_at: the confidence of the detection that matches the labelled box, (S, 10, M) float64;
            -inf if none does, and the lowest one for an ignored box.
        objects: the number of objects to find, by size, class and image, (S, C, I) int64.
    """

    images: np.ndarray
    classes: np.ndarray
    scores: np.ndarray
    hits: np.ndarray
    ignored: np.ndarray
    label_images: np.ndarray
    found_at: np.ndarray
    objects: np.ndarray


def find_hits(truths: Sequence[Boxes], detected: Sequence[Boxes], classes: int) -> Hits:
    """Match detections with labels, once for all figures.

    Args:
        truths: the labelled boxes of each image. Images without an object are included, because
            detections there are false.
        detected: the detections on each image, in the pixels and classes of its labelled boxes.
        classes: the number of classes.
    """
    # COCO's ranges contain both ends.
    ranges = [[low**2, np.nextafter(high**2, 0)] for low, high in SIZES_PX.values()]
    # It reports its progress on standard output.
    with redirect_stdout(io.StringIO()):
        labels = _annotations(truths)
        detections = _annotations(detected)
        evaluation = COCOeval(labels, detections, "bbox")
        evaluation.params.imgIds = range(len(truths))
        evaluation.params.catIds = range(classes)
        evaluation.params.iouThrs = OVERLAPS
        evaluation.params.areaRng = ranges
        evaluation.params.maxDets = [len(detections.anns)]
        evaluation.evaluate()
    scores = np.concatenate([boxes.scores for boxes in detected])
    # The index -1 means no detection.
    scores_or_none = np.append(scores, -np.inf)
    levels = len(ranges), len(OVERLAPS)
    hits = np.zeros((*levels, len(detections.anns)), bool)
    ignored = np.zeros_like(hits)
    found_at = np.full((*levels, len(labels.anns)), -np.inf)
    objects = np.zeros((len(ranges), classes, len(truths)), np.int64)
    # There is one entry for each range, class and image with boxes.
    for entry in filter(None, evaluation.evalImgs):
        size = ranges.index(entry["aRng"])
        of_detections = np.array(entry["dtIds"], np.int64) - 1
        of_labels = np.array(entry["gtIds"], np.int64) - 1
        hits[size][:, of_detections] = (entry["dtMatches"] > 0) & ~entry["dtIgnore"]
        ignored[size][:, of_detections] = entry["dtIgnore"]
        found_at[size][:, of_labels] = scores_or_none[entry["gtMatches"].astype(np.int64) - 1]
        objects[size, entry["category_id"], entry["image_id"]] = (entry["gtIgnore"] == 0).sum()
    return Hits(
        _image_numbers(detected),
        np.concatenate([boxes.classes for boxes in detected]),
        scores,
        hits,
        ignored,
        _image_numbers(truths),
        found_at,
        objects,
    )


def _image_numbers(images: Sequence[Boxes]) -> np.ndarray:
    """Return the index of the image of each box, for the boxes of all images in order."""
    return np.repeat(np.arange(len(images)), [len(boxes) for boxes in images])


def _annotations(images: Sequence[Boxes]) -> COCO:
    """Return the boxes of I images in COCO's form, with numbers from 1 on as `id`."""
    rows = list[dict[str, object]]()
    for number, boxes in enumerate(images):
        sizes = boxes.corners[:, 2:] - boxes.corners[:, :2]
        bboxes = np.hstack([boxes.corners[:, :2], sizes])
        for bbox, area, kind, score, ignored in zip(
            bboxes, areas(boxes.corners), boxes.classes, boxes.scores, boxes.ignored, strict=True
        ):
            row = {
                "id": len(rows) + 1,
                "image_id": number,
                "category_id": int(kind),
                "bbox": bbox,
                "area": area,
                "score": score,
                "iscrowd": int(ignored),
            }
            rows.append(row)
    table = COCO()
    table.dataset = {"annotations": rows, "categories": []}
    table.createIndex()
    return table
