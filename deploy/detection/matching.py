"""Which detection found which object, by pycocotools: the reference code of the COCO evaluation.

Boxes are matched once, on the scene, in its pixels. Every figure behind it is a sum over images (`scores`).
"""

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from deploy.detection.boxes import Boxes, areas, shared_areas
from profiles.errors import MachineError

OVERLAPS = np.linspace(0.5, 0.95, 10)
"""Intersection over union from which a box counts as found: ten levels, as COCO has them."""

CONFIDENCES = np.linspace(0.0, 1.0, 1001)
"""Where precision and recall are read off: a detection counts up to the confidence that is its score."""

ALL = "all"
SIZES_PX: dict[str, tuple[float, float]] = {
    ALL: (0.0, math.inf),
    "under 16 px": (0.0, 16.0),
    "16 to 32 px": (16.0, 32.0),
    "32 px up": (32.0, math.inf),
}
"""Root of a box's area, in px of the scene: from the first up to below the second."""

ROUNDING = 1e-6
"""Of an overlap, wide enough that no detection which pycocotools may match is kept from it."""


@dataclass(frozen=True)
class Image:
    """One image: what is labelled on it, what was found, and the site that it shows.

    Attributes:
        truth: labelled boxes, px of the scene.
        found: boxes with scores, in the same px, of the same classes.
        site: images of one site are drawn together.
    """

    truth: Boxes
    found: Boxes
    site: str


@dataclass(frozen=True)
class ClassMatches:
    """What was found of one class on all images, the best scored first.

    Attributes:
        images: (D,) int64, the image of each detection.
        scores: (D,) float64, falling.
        hits: (10, D) bool, whether it found an object, by `OVERLAPS`.
        ignored: (10, D) bool, whether it counts neither way.
        truths: (I,) int64, the objects to be found on each image.
    """

    images: np.ndarray
    scores: np.ndarray
    hits: np.ndarray
    ignored: np.ndarray
    truths: np.ndarray

    @cached_property
    def places(self) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]:
        """By overlap: where the hits are, where what is ignored is, and how many of these lie before each hit.

        Precision peaks at hits alone, so a draw has to look at nothing else.
        """
        found = [
            (np.flatnonzero(hit), np.flatnonzero(rest)) for hit, rest in zip(self.hits, self.ignored, strict=True)
        ]
        return tuple((hit, rest, np.searchsorted(rest, hit)) for hit, rest in found)

    @cached_property
    def steps(self) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """At an overlap of one half: of the hits, and of all that counts, the last of `CONFIDENCES` and the image."""
        levels = np.searchsorted(CONFIDENCES, self.scores, side="right") - 1
        hit, counted = self.hits[0], ~self.ignored[0]
        return (levels[hit], self.images[hit]), (levels[counted], self.images[counted])


@dataclass(frozen=True)
class Matched:
    """Every detection on a set of images, matched with what is labelled.

    Attributes:
        names: of the classes.
        sites: of the images, in their order.
        by_size: a `ClassMatches` for each class, by the keys of `SIZES_PX`.
    """

    names: tuple[str, ...]
    sites: tuple[str, ...]
    by_size: Mapping[str, tuple[ClassMatches, ...]]


def match(images: Sequence[Image], names: Sequence[str]) -> Matched:
    """Match what was found with what is labelled, class by class, once for all figures.

    The best scored detection is matched first, with the free object that it overlaps most, as COCO has it. What lies
    in an ignored box counts neither way. Every detection given counts, where COCO takes the best 100 of a class:
    aerial images hold more objects than photographs do.

    Args:
        images: all of the set, those without any box too: what is found on them is false.
        names: of the classes that the boxes' numbers stand for.

    Raises:
        MachineError: pycocotools is not installed.
    """
    found, image = together([one.found for one in images])
    sides = np.sqrt(areas(found.corners))
    levels = (len(OVERLAPS), len(found))
    hits = {size: np.zeros(levels, bool) for size in SIZES_PX}
    ignored = {
        size: np.tile((sides < low) | (sides >= high), (levels[0], 1)) for size, (low, high) in SIZES_PX.items()
    }
    truths = {size: np.zeros((len(names), len(images)), np.int64) for size in SIZES_PX}
    for number, size, where, cell in _cells(images, found, image, len(names)):
        which = np.array(cell["dtIds"], np.int64) - 1
        ignored[size][:, which] = cell["dtIgnore"]
        hits[size][:, which] = (cell["dtMatches"] > 0) & ~cell["dtIgnore"]
        truths[size][number, where] = np.count_nonzero(cell["gtIgnore"] == 0)

    def of_class(number: int, size: str) -> ClassMatches:
        mine = np.flatnonzero(found.classes == number)
        order = mine[np.argsort(-found.scores[mine], kind="stable")]
        chosen = hits[size][:, order], ignored[size][:, order]
        return ClassMatches(image[order], found.scores[order], *chosen, truths[size][number])

    by_size = {size: tuple(of_class(number, size) for number in range(len(names))) for size in SIZES_PX}
    return Matched(tuple(names), tuple(one.site for one in images), by_size)


def together(boxes: Sequence[Boxes]) -> tuple[Boxes, np.ndarray]:
    """Boxes of several images in one, and the number of each one's image, (N,) int64."""
    several = [Boxes.none(), *boxes]
    joined = Boxes(*(np.concatenate([getattr(one, name) for one in several]) for name in Boxes.__dataclass_fields__))
    return joined, np.repeat(np.arange(len(boxes)), [len(one) for one in boxes])


def _cells(
    images: Sequence[Image], found: Boxes, image: np.ndarray, count: int
) -> Iterator[tuple[int, str, int, dict[str, Any]]]:
    """What pycocotools makes of each class, size and image on which there is anything of the class."""
    coco, evaluation_of = require_library()
    # Its loops are Python's: what overlaps no object by half, nine of ten detections, can hit at no level.
    near = np.flatnonzero(np.concatenate([np.empty(0, bool), *(_near(one) for one in images)]))
    truth, place = together([one.truth for one in images])
    everything = {"images": [{"id": i} for i in range(len(images))], "categories": [{"id": c} for c in range(count)]}
    with redirect_stdout(io.StringIO()):  # it tells of its progress
        tables = coco(), coco()
        tables[0].dataset = everything | {"annotations": _annotations(truth, place, np.arange(len(truth)))}
        tables[1].dataset = everything | {"annotations": _annotations(found, image, near)}
        for table in tables:
            table.createIndex()
        evaluation = evaluation_of(*tables, "bbox")
        evaluation.params.iouThrs = OVERLAPS
        evaluation.params.maxDets = [max((len(one.found) for one in images), default=0)]
        # Both its ends belong to a range: ours does not hold its upper one.
        evaluation.params.areaRng = [[low**2, np.nextafter(high**2, 0)] for low, high in SIZES_PX.values()]
        evaluation.evaluate()
    keys = product(range(count), SIZES_PX, range(len(images)))
    yield from ((*key, cell) for key, cell in zip(keys, evaluation.evalImgs, strict=True) if cell is not None)


def require_library() -> tuple[Any, Any]:
    """The two classes of pycocotools that are used here, COCO and COCOeval; asked for before long work.

    Raises:
        MachineError: it is not installed.
    """
    try:
        from pycocotools.coco import COCO
        from pycocotools.cocoeval import COCOeval
    except ImportError as error:
        remedy = "pip install 'beers-deploy[detect]'"
        raise MachineError("scores of boxes", expected="pycocotools", got="no such package", remedy=remedy) from error
    return COCO, COCOeval


def _near(image: Image) -> np.ndarray:
    """(N,) whether each detection overlaps an object of its class by half, or lies by half in an ignored one."""
    found, truth = image.found, image.truth
    shared = shared_areas(found.corners, truth.corners)
    own, other = areas(found.corners)[:, None], areas(truth.corners)[None, :]
    whole = np.where(truth.ignored[None, :], own, own + other - shared)
    same = found.classes[:, None] == truth.classes[None, :]
    return np.asarray((same & (shared >= (OVERLAPS[0] - ROUNDING) * whole)).any(axis=1))


def _annotations(boxes: Boxes, images: np.ndarray, which: np.ndarray) -> list[dict[str, Any]]:
    """Some of the boxes as COCO writes them; numbers start at 1, for 0 stands for no match."""
    low, size, area = boxes.corners[:, :2], boxes.corners[:, 2:] - boxes.corners[:, :2], areas(boxes.corners)
    return [
        {
            "id": int(i) + 1,
            "image_id": int(images[i]),
            "category_id": int(boxes.classes[i]),
            "bbox": [*low[i].tolist(), *size[i].tolist()],
            "area": float(area[i]),
            "score": float(boxes.scores[i]),
            "iscrowd": int(boxes.ignored[i]),  # the one way to have it pass over a box
        }
        for i in which
    ]
