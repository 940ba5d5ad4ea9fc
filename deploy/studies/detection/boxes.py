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
    """Boxes of one image.

    Attributes:
        corners: (N, 4) float64: left, top, right and bottom in px.
        classes: (N,) int64, indices of a tuple of names that is stored elsewhere.
        scores: (N,) float64 confidence in 0 to 1; 1 for labelled boxes.
        ignored: (N,) bool: detections inside such a box count neither for nor against a detector.
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
        """Create boxes from any array-like. Without scores they are labelled ones, and none is
        ignored by default.
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
        """Return the boxes with class c replaced by `classes[c]`, without boxes of a class that
        becomes -1.
        """
        new = np.asarray(classes, np.int64)[self.classes]
        return Boxes(self.corners, new, self.scores, self.ignored)[new >= 0]

    def clipped(self, height_px: float, width_px: float) -> "Boxes":
        """Return the parts inside an image. Boxes completely outside are left out, and those mostly
        outside are ignored.
        """
        limits = np.array([width_px, height_px, width_px, height_px])
        inside = np.clip(self.corners, 0, limits)
        visible = areas(inside)
        full = areas(self.corners)
        ignored = self.ignored | (visible < MIN_VISIBLE * full)
        return replace(self, corners=inside, ignored=ignored)[visible > 0]


def areas(corners: np.ndarray) -> np.ndarray:
    """Return the areas in px2 (N,) of corners (N, 4), or 0 if a right or lower edge lies before its
    opposite.
    """
    return np.asarray(np.prod(np.maximum(corners[:, 2:] - corners[:, :2], 0), axis=1))


def iou(one: np.ndarray, other: np.ndarray, ignored: np.ndarray | bool = False) -> np.ndarray:
    """Return the intersection over union (N, M), 0 to 1, of corners (N, 4) and (M, 4). It is 0 for
    two boxes without area.

    Args:
        one: corners.
        other: corners.
        ignored: (M,) True where the overlap is the share of `one` inside `other`.
    """
    low = np.maximum(one[:, None, :2], other[None, :, :2])
    high = np.minimum(one[:, None, 2:], other[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0), axis=2)
    own = areas(one)[:, None]
    # Of an ignored box the overlap is the share of the detection inside it, as COCO has it for
    # crowds.
    union = np.where(ignored, own, own + areas(other) - shared)
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
    """Fits an image of any size into a detector's square input: scaled uniformly, centred, padded
    grey.

    Downscaling samples bilinearly without a prefilter, as Ultralytics does when it trains and runs.

    Args:
        height_px: the height of the image.
        width_px: the width of the image.
        size_px: side of the input.
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
        # By axis, for the sides are rounded to whole pixels: one gain for both would be off by up
        # to half a pixel.
        self._gain = np.tile([width / width_px, height / height_px], 2)
        self._shift = np.tile([left, top], 2)

    def image(self, rgb: np.ndarray) -> np.ndarray:
        """Return the input, (3, size_px, size_px) float32, for an image (height_px, width_px, 3) in
        0 to 1.
        """
        # Shrunk without a filter in front, as Ultralytics does when it trains and runs.
        same = self._inner == rgb.shape[:2]
        fitted = (
            rgb if same else resize(rgb, self._inner, order=1, mode="edge", anti_aliasing=False)
        )
        padded = np.pad(fitted.astype(np.float32), self._border, constant_values=PADDING)
        return np.ascontiguousarray(padded.transpose(2, 0, 1))

    def to_image(self, corners: np.ndarray) -> np.ndarray:
        """Convert (N, 4) corners from px of the input to px of the image."""
        return np.asarray((corners - self._shift) / self._gain)
