"""Labelled images, whatever layout their labels have: Pascal VOC as DIOR keeps it, COCO, YOLO or DOTA."""

from dataclasses import dataclass
from pathlib import Path

from deploy.detection.boxes import Boxes


@dataclass(frozen=True)
class LabelledImage:
    """An image file with what is labelled on it.

    Attributes:
        path: of the image.
        truth: labelled boxes, in px of the image; classes are numbers into the set's names.
        site: images of one site share it.
    """

    path: Path
    truth: Boxes
    site: str


@dataclass(frozen=True)
class LabelledSet:
    """Labelled images of one layout.

    Attributes:
        images: in the order of their names; without a box, some may be.
        names: of the classes that are labelled, in alphabetical order.
        notes: what a reader should know of labels that were left out or changed, a sentence each.
    """

    images: tuple[LabelledImage, ...]
    names: tuple[str, ...]
    notes: tuple[str, ...] = ()
