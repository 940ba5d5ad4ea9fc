"""Labelled images, whatever layout their labels have: Pascal VOC as DIOR keeps it, COCO, YOLO or DOTA."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deploy.detection.boxes import Boxes, areas
from deploy.detection.classes import letters
from deploy.detection.coco import read_coco
from deploy.detection.labels import FileLabels, NamedBox, faulty
from deploy.detection.text_labels import is_dota, read_dota, read_yolo, yolo_names
from deploy.detection.voc import is_voc_tree, read_voc, tree_pairs
from model.io.files import IMAGE_SUFFIXES
from model.io.images import image_size_px, list_images, site_of
from profiles.errors import OptionError

JSON = (".json", ".geojson")
SPLITS = ("test", "val", "valid", "train")
"""Where no split is asked for, the first that is there: what a detector was trained on comes last."""
LAYOUTS = "labels as VOC (.xml), COCO (.json), YOLO or DOTA (.txt)"


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
        names: of the classes that are labelled, in the order of their letters.
        notes: what a reader should know of labels that were left out or changed, a sentence each.
    """

    images: tuple[LabelledImage, ...]
    names: tuple[str, ...]
    notes: tuple[str, ...] = ()


def read_labelled(images: Path, labels: Path | None = None, split: str | None = None) -> LabelledSet:
    """Labelled images of a folder.

    Args:
        images: the folder of the images, or the top of a tree as VOC, DIOR, YOLO or DOTA have it.
        labels: a folder of label files, one an image, or COCO's JSON; None looks where each layout keeps them.
        split: which part of a tree; None takes `test` if there is one.

    Raises:
        OptionError: no labels, labels of another layout or with faults, no such split, or not one box.
        ImageError: no image, or one that cannot be read.
        MachineError: a package that reads the layout is not installed.
    """
    if labels is None and is_voc_tree(images):
        return _labelled([read_voc(*pair) for pair in tree_pairs(images, split)], [])
    folder = _image_folder(images, split)
    where = labels or _labels_near(images, folder)
    if where.suffix.lower() in JSON:
        return _labelled(*read_coco(where, folder))
    return _labelled(*_by_file(list_images(folder), where, (where, where.parent, folder, images)))


def _image_folder(top: Path, split: str | None) -> Path:
    """Where the images of a split lie: TOP/images/SPLIT, TOP/SPLIT/images or TOP/SPLIT, else TOP or TOP/images."""
    if split is None and _holds(top, IMAGE_SUFFIXES):
        return top
    for name in (split,) if split else SPLITS:
        for path in (top / "images" / name, top / name / "images", top / name):
            if _holds(path, IMAGE_SUFFIXES):
                return path
    if split:
        remedy = "name a split that is there"
        raise OptionError(str(top), expected=f"images of the split {split!r}", got="none", remedy=remedy)
    return top / "images" if (top / "images").is_dir() else top


def _labels_near(top: Path, folder: Path) -> Path:
    """Where the labels of a folder's images lie: in the place of `images`, beside them, or in a file of JSON."""
    parts = folder.relative_to(top).parts
    swapped = [top.joinpath(*(new if part == "images" else part for part in parts)) for new in ("labels", "labelTxt")]
    folders = [path for path in swapped if path != folder]
    for path in (*folders, folder, top / "labels", top / "labelTxt", top / "Annotations", top):
        if _holds(path, (".xml", ".txt"), but="classes.txt"):
            return path
        found = [file for kind in JSON for file in sorted(path.glob(f"*{kind}"))]
        if len(found) > 1:
            raise OptionError(
                str(path), expected="one file of labels", got=f"{len(found)}", remedy="name it: --labels"
            )
        if found:
            return found[0]
    list_images(folder)  # which says so where there is no image either
    raise OptionError(str(folder), expected=LAYOUTS, got="none beside the images", remedy="give them as --labels")


def _holds(folder: Path, suffixes: Iterable[str], but: str = "") -> bool:
    """Whether a folder holds a file of one of these kinds."""
    return folder.is_dir() and any(p.suffix.lower() in suffixes and p.name != but for p in folder.iterdir())


def _by_file(images: Sequence[Path], where: Path, named_in: Sequence[Path]) -> tuple[list[FileLabels], list[str]]:
    """Labels of a file an image, and what is to be said of them."""
    if not where.is_dir():
        got = "no such folder" if not where.exists() else "another file"
        raise OptionError(str(where), expected=LAYOUTS, got=got, remedy="give a folder, or COCO's JSON")
    kinds = {suffix: [where / f"{image.stem}{suffix}" for image in images] for suffix in (".xml", ".txt")}
    for suffix, paths in kinds.items():
        there = [path for path in paths if path.exists()]
        if there and suffix == ".txt" and not is_dota(there):
            names = yolo_names(named_in)
            pairs = zip(images, paths, strict=True)
            return [read_yolo(image, path, names, image_size_px(image)) for image, path in pairs], []
        if there:
            _require_all(where, paths, there)
            read, notes = (
                (read_voc, [])
                if suffix == ".xml"
                else (read_dota, ["Oriented boxes of DOTA are enclosed in upright ones."])
            )
            return [read(image, path) for image, path in zip(images, paths, strict=True)], notes
    got = f"none that is named as one of the {len(images)} images"
    raise OptionError(str(where), expected=LAYOUTS, got=got, remedy="name each file as its image")


def _require_all(where: Path, paths: Sequence[Path], there: Sequence[Path]) -> None:
    if len(there) < len(paths):
        first = next(path for path in paths if not path.exists())
        got = f"{len(paths) - len(there)} of {len(paths)} missing, the first {first.name}"
        remedy = "leave those images out, or give them files without objects"
        raise OptionError(str(where), expected="a file of labels for every image", got=got, remedy=remedy)


def _labelled(files: Sequence[FileLabels], notes: Sequence[str]) -> LabelledSet:
    """The set of what was read, its boxes inside their images."""
    spelled = {letters(box.name): box.name for one in reversed(files) for box in reversed(one.boxes)}
    number = {key: i for i, key in enumerate(sorted(spelled))}
    images, lost = [], list[str]()
    for one in sorted(files, key=lambda one: one.image.name):
        height, width = _size(one)
        whole = _boxes(one.boxes, number)
        sound = whole[areas(whole.corners) > 0]
        inside = sound.clipped(height, width)
        lost += [one.source.name] * (len(whole) - len(inside))
        images.append(LabelledImage(one.image, inside, site_of(one.image.name)))
    if not any(len(image.truth) for image in images):
        raise OptionError(
            "labels", expected="one object at least", got=f"none on {len(images)} images", remedy="check the labels"
        )
    return LabelledSet(
        tuple(images), tuple(spelled[key] for key in sorted(spelled)), (*notes, *_remarks(images, lost))
    )


def _boxes(boxes: Sequence[NamedBox], number: dict[str, int]) -> Boxes:
    corners = np.array([box.corners for box in boxes], np.float64).reshape(-1, 4)
    classes = [number[letters(box.name)] for box in boxes]
    return Boxes.of(corners, np.array(classes), ignored=np.array([box.ignored for box in boxes], bool))


def _size(one: FileLabels) -> tuple[int, int]:
    """Height and width of an image in px; its labels must have been made for them."""
    size = image_size_px(one.image)
    if one.size_px is not None and one.size_px != size:
        height, width = size
        got = f"{one.size_px[0]} x {one.size_px[1]} px"
        remedy = "give the image that was labelled"
        raise faulty(one.source, f"labels of an image of {height} x {width} px", got, remedy)
    return size


def _remarks(images: Sequence[LabelledImage], lost: Sequence[str]) -> list[str]:
    found = []
    if empty := sum(not len(image.truth) for image in images):
        found.append(
            f"Images without a labelled object, on which whatever is found is false: {empty} of {len(images)}."
        )
    if lost:
        found.append(f"Boxes left out, without area inside their image: {len(lost)}, the first in {lost[0]}.")
    if ignored := sum(int(image.truth.ignored.sum()) for image in images):
        found.append(f"Boxes that count neither way, difficult, a crowd or visible by less than 30 %: {ignored}.")
    return found
