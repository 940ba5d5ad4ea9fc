"""Boxes on an image: their overlap, the suppression of several on one object, and their scaling
with an image.

Coordinates are continuous pixels: pixel i covers [i, i + 1), so a box around the first pixel is 0,
0, 1, 1. Readers convert every other convention to this one (`labels`).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from skimage.transform import resize

from beers_deploy.profiles.errors import OptionError

MIN_VISIBLE = 0.3
"""If a smaller share of a box is inside the image, finding it counts neither for nor against a
detector.
"""
PADDING = 114 / 255
OVERLAP = 0.7
MAX_BOXES = 300
MAX_CANDIDATES = 30_000
"""The values with which Ultralytics validates: the grey around an image, the overlap above which
the box with the lower score is removed, the number of boxes retained in an image, and the number
compared, best scores first.
"""


@dataclass(frozen=True)
class Boxes:
    """The N labelled or detected boxes of one image.

    Attributes:
        corners: left, top, right and bottom of each box in pixels, (N, 4) float64.
        classes: the class of each box, (N,) int64, as an index of a tuple of names that is stored
            elsewhere.
        scores: the confidence of each detection in 0 to 1, (N,) float64; 1 for labelled boxes.
        ignored: True for a labelled box that need not be found, (N,) bool: detections inside it
            count neither for nor against a detector.
    """

    corners: np.ndarray
    classes: np.ndarray
    scores: np.ndarray
    ignored: np.ndarray

    @classmethod
    def of(
        cls,
        corners: ArrayLike,
        classes: ArrayLike,
        scores: ArrayLike | None = None,
        ignored: ArrayLike | None = None,
    ) -> "Boxes":
        """Create boxes from lists or arrays.

        Args:
            corners: left, top, right and bottom of each box in pixels, (N, 4).
            classes: the index of the class of each box, (N,).
            scores: the confidence of each detection in 0 to 1, (N,); None for labelled boxes.
            ignored: True for a box that need not be found, (N,); None ignores no box.
        """
        array = np.asarray(corners, np.float64).reshape(-1, 4)
        count = len(array)
        return cls(
            array,
            np.asarray(classes, np.int64).reshape(count),
            np.ones(count) if scores is None else np.asarray(scores, np.float64).reshape(count),
            np.zeros(count, bool) if ignored is None else np.asarray(ignored, bool).reshape(count),
        )

    def __len__(self) -> int:
        return len(self.corners)

    def __getitem__(self, which: np.ndarray | slice) -> "Boxes":
        """Return the boxes selected by a mask, indices or a slice."""
        return Boxes(
            self.corners[which], self.classes[which], self.scores[which], self.ignored[which]
        )

    def renamed(self, classes: np.ndarray) -> "Boxes":
        """Return the boxes with other class indices, such as those of a detector.

        Args:
            classes: the new index of each old one, (C,); boxes of a class with -1 are removed.
        """
        new = np.asarray(classes, np.int64)[self.classes]
        return Boxes(self.corners, new, self.scores, self.ignored)[new >= 0]

    def clipped(self, height_px: float, width_px: float) -> "Boxes":
        """Return the boxes cut at the borders of an image of `height_px` x `width_px` pixels.

        A box completely outside is removed. A box of which less than `MIN_VISIBLE` is inside is
        marked as ignored.
        """
        limits = np.array([width_px, height_px, width_px, height_px])
        inside = np.clip(self.corners, 0, limits)
        visible = areas(inside)
        full = areas(self.corners)
        ignored = self.ignored | (visible < MIN_VISIBLE * full)
        return replace(self, corners=inside, ignored=ignored)[visible > 0]


def areas(corners: np.ndarray) -> np.ndarray:
    """Return the areas of boxes in square pixels, (N,), given their corners (N, 4). The area is 0
    if the right or lower edge lies before the opposite one.
    """
    return np.asarray(np.prod(np.maximum(corners[:, 2:] - corners[:, :2], 0), axis=1))


def iou(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Compute the overlap of each box with each other box: their intersection over union.

    Args:
        one: the corners of N boxes, (N, 4).
        other: the corners of M boxes, (M, 4).

    Returns:
        The overlaps of 0 to 1, (N, M); 0 for two boxes without area.
    """
    low = np.maximum(one[:, None, :2], other[None, :, :2])
    high = np.minimum(one[:, None, 2:], other[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0), axis=2)
    union = areas(one)[:, None] + areas(other) - shared
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0))


def suppress(boxes: Boxes) -> Boxes:
    """Remove boxes that overlap a better box of the same class (non-maximum suppression).

    A box is removed if its IoU with a box of a higher score exceeds OVERLAP. Only the best
    MAX_CANDIDATES are compared, and at most MAX_BOXES are returned.

    Returns:
        The remaining boxes, best score first.
    """
    candidates = np.argsort(-boxes.scores, kind="stable")[:MAX_CANDIDATES]
    selection = list[int]()
    while len(candidates) and len(selection) < MAX_BOXES:
        best = int(candidates[0])
        candidates = candidates[1:]
        selection.append(best)
        # Boxes of other classes stay: overlaps are computed within the class alone.
        crowded = boxes.classes[candidates] == boxes.classes[best]
        crowded[crowded] = (
            iou(boxes.corners[best][None], boxes.corners[candidates[crowded]])[0] > OVERLAP
        )
        candidates = candidates[~crowded]
    return boxes[np.array(selection, np.int64)]


class Letterbox:
    """Fits images of one size into a detector's square input: scaled uniformly, centred, padded
    grey; and converts boxes back.

    Downscaling samples bilinearly without a prefilter, as Ultralytics does when it trains and runs.

    Args:
        height_px: the height of the image.
        width_px: the width of the image.
        size_px: the side of the detector's input in pixels.

    Raises:
        OptionError: the image is so narrow that less than a pixel of its short side would be left.
    """

    def __init__(self, height_px: int, width_px: int, size_px: int) -> None:
        share = min(size_px / height_px, size_px / width_px)
        height = round(height_px * share)
        width = round(width_px * share)
        self._inner = (height, width)
        if min(self._inner) < 1:
            raise OptionError(
                f"The image of {height_px} x {width_px} px is too narrow: its short side has less "
                f"than a pixel in the detector's input of {size_px} px. Cut it into squares."
            )
        top = (size_px - height) // 2
        left = (size_px - width) // 2
        self._border = (top, size_px - height - top), (left, size_px - width - left), (0, 0)
        # Each axis has its own gain, because the sides are rounded to whole pixels: one gain for
        # both would be off by up to half a pixel.
        self._gain = np.tile([width / width_px, height / height_px], 2)
        self._shift = np.tile([left, top], 2)

    def image(self, rgb: np.ndarray) -> np.ndarray:
        """Convert an image to the detector's input.

        Args:
            rgb: the image (height_px, width_px, 3) in 0 to 1.

        Returns:
            The input (3, size_px, size_px), float32 in 0 to 1.
        """
        # Shrunk without a filter in front, as Ultralytics does when it trains and runs.
        same = self._inner == rgb.shape[:2]
        fitted = (
            rgb if same else resize(rgb, self._inner, order=1, mode="edge", anti_aliasing=False)
        )
        padded = np.pad(fitted.astype(np.float32), self._border, constant_values=PADDING)
        return np.ascontiguousarray(padded.transpose(2, 0, 1))

    def to_image(self, corners: np.ndarray) -> np.ndarray:
        """Convert the corners of boxes, (N, 4), from pixels of the detector's input to pixels of
        the image.
        """
        return np.asarray((corners - self._shift) / self._gain)
