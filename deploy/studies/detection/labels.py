"""Labelled images: Pascal VOC (DIOR's folders among it), COCO and YOLO.

Boxes are in continuous pixels of the image, pixel i covering [i, i + 1):

- VOC, an XML file an image (Everingham et al., VOC2012 development kit; DIOR: Li et al., arXiv 1909.00133): corners
  count pixels from 1 and belong to the box.
- COCO, one JSON file (Lin et al., arXiv 1405.0312; cocodataset.org/#format-data): left, top, width, height in px.
- YOLO, a text file an image (docs.ultralytics.com/datasets/detect): `class cx cy w h`, or `class x y x y x y ...` of
  an outline, which an upright box encloses, as shares of the image; names in data.yaml or classes.txt; an image
  without a file shows no object.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from beers_deploy.model.io.files import IMAGE_SUFFIXES
from beers_deploy.model.io.images import image_size_px, list_images
from beers_deploy.profiles.errors import BeersError, MissingExtraError, OptionError
from beers_deploy.profiles.toml import read_json, read_whole
from beers_deploy.restoration.index_files import NoDoctype
from beers_deploy.studies.detection.boxes import Boxes, areas
from beers_deploy.studies.detection.detector import class_names, letters

SPLITS = ("test", "val", "valid", "train")
"""Where no split is asked for, the first that is there: what a detector was trained on comes last."""
LAYOUTS = "labels as VOC (.xml), COCO (.json) or YOLO (.txt)"
LABEL_BYTES, NAMES_BYTES = 1 << 23, 1 << 16
"""Limits of a file of labels (25 000 boxes of XML), and of data.yaml, of which PyYAML reads so much in 0.4 s."""
SPAN = 1e-3
"""By how much a share of YOLO's may pass 0 or 1: tools write six digits or fewer."""
HORIZONTAL = "Horizontal Bounding Boxes"
CORNERS = ("xmin", "ymin", "xmax", "ymax")


class LabelledImage(NamedTuple):
    """An image file with the boxes labelled on it, in its px; their classes are numbers into the set's names."""

    path: Path
    truth: Boxes


@dataclass(frozen=True)
class LabelledSet:
    """Labelled images of one layout.

    Attributes:
        images: in the order of their names; some may be without a box.
        names: of the classes that are labelled.
        notes: a sentence for each kind of label that was left out or changed.
    """

    images: tuple[LabelledImage, ...]
    names: tuple[str, ...]
    notes: tuple[str, ...]


class _Box(NamedTuple):
    name: str
    corners: tuple[float, float, float, float]
    ignored: bool = False


class _File(NamedTuple):
    """The labels of one image; `size_px` is the height and width that they were made for, where they say so."""

    image: Path
    boxes: Sequence[_Box]
    source: Path
    size_px: tuple[int, int] | None = None


def read_labelled(images: Path, labels: Path | None = None, split: str | None = None) -> LabelledSet:
    """Labelled images of a folder.

    Args:
        images: the folder of the images, or the top of a tree as VOC, DIOR or YOLO have it.
        labels: a folder of label files, one an image, or COCO's JSON; None looks where each layout keeps them.
        split: which part of a tree; None takes `test` if there is one.
    """
    if labels is None and (images / "Annotations").is_dir() and any(images.glob("JPEGImages*")):
        return _labelled_set([_read_voc(*pair) for pair in _voc_pairs(images, split)])
    folder = _image_folder(images, split)
    where = labels or _labels_near(images, folder)
    if where.suffix.lower() == ".json":
        return _labelled_set(*_read_coco(where, folder))
    return _labelled_set(_read_each(list_images(folder), where, (where, where.parent, folder, images)))


def _image_folder(top: Path, split: str | None) -> Path:
    """Where the images of a split lie: TOP/images/SPLIT, TOP/SPLIT/images or TOP/SPLIT, else TOP or TOP/images."""
    if split is None and _holds(top, IMAGE_SUFFIXES):
        return top
    for name in (split,) if split else SPLITS:
        for path in (top / "images" / name, top / name / "images", top / name):
            if _holds(path, IMAGE_SUFFIXES):
                return path
    if split:
        raise _faulty(top, f"images of the split {split!r}", "none", "name a split that is there")
    return top / "images" if (top / "images").is_dir() else top


def _labels_near(top: Path, folder: Path) -> Path:
    """Where the labels of a folder's images lie: in the place of `images`, beside them, or in a file of JSON."""
    parts = folder.relative_to(top).parts
    swapped = top.joinpath(*("labels" if part == "images" else part for part in parts))
    for path in (swapped, folder, top / "labels", top / "Annotations", top):
        if _holds(path, (".xml", ".txt"), but="classes.txt"):
            return path
        found = sorted(path.glob("*.json"))
        if len(found) > 1:
            raise _faulty(path, "one file of labels", f"{len(found)}", "name it as `labels`")
        if found:
            return found[0]
    list_images(folder)  # which says so where there is no image either
    raise _faulty(folder, LAYOUTS, "none beside the images", "give them as `labels`")


def _holds(folder: Path, suffixes: Iterable[str], but: str = "") -> bool:
    return folder.is_dir() and any(p.suffix.lower() in suffixes and p.name != but for p in folder.iterdir())


def _read_each(images: Sequence[Path], where: Path, named_in: Sequence[Path]) -> list[_File]:
    if not where.is_dir():
        raise _faulty(where, LAYOUTS, "another file" if where.exists() else "no such folder", "give a folder")
    there = {path.name for path in where.iterdir()}
    xml, text = ([(image, where / f"{image.stem}{suffix}") for image in images] for suffix in (".xml", ".txt"))
    missing = [labels.name for _, labels in xml if labels.name not in there]
    if not missing:
        return [_read_voc(*pair) for pair in xml]
    if len(missing) < len(xml):
        got = f"{len(missing)} of {len(xml)} missing, the first {missing[0]}"
        remedy = "leave those images out, or give them files without objects"
        raise _faulty(where, "a file of labels for every image", got, remedy)
    if any(labels.name in there for _, labels in text):
        names = yolo_names(named_in)
        return [_read_yolo(*pair, names) for pair in text]
    raise _faulty(where, LAYOUTS, f"none named as one of the {len(images)} images", "name each file as its image")


def _labelled_set(files: Sequence[_File], notes: Sequence[str] = ()) -> LabelledSet:
    spelled = {letters(box.name): box.name for one in reversed(files) for box in reversed(one.boxes)}
    number = {key: i for i, key in enumerate(sorted(spelled))}
    images, lost = [], list[str]()
    for one in sorted(files, key=lambda one: one.image.name):
        classes, ignored = [number[letters(box.name)] for box in one.boxes], [box.ignored for box in one.boxes]
        whole = Boxes.of([box.corners for box in one.boxes], classes, ignored=ignored)
        inside = whole[areas(whole.corners) > 0].clipped(*_size_px(one))
        lost += [one.source.name] * (len(whole) - len(inside))
        images.append(LabelledImage(one.image, inside))
    if not any(len(image.truth) for image in images):
        got = f"none on {len(images)} images"
        raise OptionError("labels", expected="one object at least", got=got, remedy="check the labels")
    names = tuple(spelled[key] for key in sorted(spelled))
    return LabelledSet(tuple(images), names, (*notes, *_remarks(images, lost)))


def _size_px(one: _File) -> tuple[int, int]:
    """Height and width of an image in px; its labels must have been made for them."""
    height, width = image_size_px(one.image)
    if one.size_px not in (None, (height, width)):
        expected, got = f"labels of an image of {height} x {width} px", f"{one.size_px[0]} x {one.size_px[1]} px"
        raise _faulty(one.source, expected, got, "give the image that was labelled")
    return height, width


def _remarks(images: Sequence[LabelledImage], lost: Sequence[str]) -> list[str]:
    empty, ignored = sum(not len(i.truth) for i in images), sum(int(i.truth.ignored.sum()) for i in images)
    first = lost[0] if lost else ""
    remarks = (
        (empty, f"Images without a labelled object, all found there is false: {empty} of {len(images)}."),
        (lost, f"Boxes left out, without area inside their image: {len(lost)}, the first in {first}."),
        (ignored, f"Boxes that count neither way, difficult, a crowd or visible by less than 30 %: {ignored}."),
    )
    return [sentence for said, sentence in remarks if said]


def _voc_pairs(folder: Path, split: str | None) -> list[tuple[Path, Path]]:
    """Image and label files of a split of VOC's or DIOR's folders; None takes `test`, or all where there is none."""
    images = {p.stem: p for p in folder.glob("JPEGImages*/*") if p.suffix.lower() in IMAGE_SUFFIXES}
    labels = folder / "Annotations"
    labels = labels / HORIZONTAL if (labels / HORIZONTAL).is_dir() else labels
    lists = {path.stem: path for path in sorted((folder / "ImageSets" / "Main").glob("*.txt"))}
    wanted = split or "test"
    if split is None and wanted not in lists:
        return [(path, labels / f"{stem}.xml") for stem, path in sorted(images.items())]
    if wanted not in lists:
        raise _faulty(folder, f"one of its splits ({', '.join(lists) or 'none'})", repr(wanted), "name one of them")
    stems = sorted({line.split()[0] for line in _lines(lists[wanted])})  # a list of one class has a number behind it
    missing = [stem for stem in stems if stem not in images]
    if missing:
        got = f"{len(missing)} of {len(stems)} missing, the first {missing[0]!r}"
        raise _faulty(folder, f"every image of {wanted}", got, "unpack the images whole")
    return [(images[stem], labels / f"{stem}.xml") for stem in stems]


def _read_voc(image: Path, labels: Path) -> _File:
    try:
        # NoDoctype refuses a document type: with entities a file of a hundred bytes can grow to gigabytes.
        root = ET.fromstring(_read_bytes(labels), ET.XMLParser(target=NoDoctype()))  # noqa: S314
    except BeersError:
        raise
    except (ET.ParseError, ValueError, LookupError, RecursionError) as error:  # lookup: of an encoding
        raise _faulty(labels, "plain XML", " ".join(str(error).split())[:100]) from error
    if root.tag != "annotation":
        raise _faulty(labels, "Pascal VOC, an 'annotation'", f"<{root.tag}>"[:80], "give labels of VOC")
    size = _numbers([root.findtext(f"size/{name}", "0") for name in ("height", "width")], labels, "size")
    return _File(image, [_voc_box(entry, labels) for entry in root.iter("object")], labels, _stated_px(*size))


def _voc_box(entry: ET.Element, path: Path) -> _Box:
    name = (entry.findtext("name") or "").strip()
    if not name:
        raise _faulty(path, "a name for every object", "none")
    corners = [entry.findtext(f"bndbox/{corner}", "none") for corner in CORNERS]
    left, top, right, bottom = _numbers(corners, path, f"{', '.join(CORNERS)} of a {name!r}")
    return _Box(name, (left - 1, top - 1, right, bottom), (entry.findtext("difficult") or "0").strip() == "1")


def _read_coco(labels: Path, folder: Path) -> tuple[list[_File], list[str]]:
    """The labels of every image that is both listed and in the folder, and a sentence about those that are not."""
    try:
        content: Any = read_json(labels)
        names = {entry["id"]: _text(entry["name"]) for entry in content["categories"]}
        boxes: dict[Any, list[_Box]] = {entry["id"]: [] for entry in content["images"]}
        for entry in content["annotations"]:
            left, top, width, height = map(float, entry["bbox"])
            corners = (left, top, left + width, top + height)
            boxes[entry["image_id"]].append(_Box(names[entry["category_id"]], corners, bool(entry.get("iscrowd", 0))))
        files = [
            _File(path, boxes[entry["id"]], labels, _stated_px(entry.get("height") or 0, entry.get("width") or 0))
            for entry in content["images"]
            if (path := _inside(folder, _text(entry["file_name"]))) is not None
        ]
    except BeersError:
        raise
    except (OSError, LookupError, TypeError, ValueError, OverflowError) as error:
        got = f"{type(error).__name__}: {' '.join(str(error).split())[:100]}"
        remedy = "give COCO's JSON file"
        raise _faulty(labels, "COCO's lists of images, annotations and categories", got, remedy) from error
    listed = len(content["images"])
    if not files:
        raise _faulty(labels, f"its images in {folder}", f"none of {listed}", "give the folder that holds them")
    absent = listed - len(files)
    return files, [f"{absent} of {listed} images in {labels.name} are not in the folder."] if absent else []


def _stated_px(height: float, width: float) -> tuple[int, int] | None:
    return (int(height), int(width)) if height > 0 and width > 0 else None


def _inside(folder: Path, name: str) -> Path | None:
    """The file of that name in the folder, or of its last part; nothing outside the folder."""
    for path in (folder / name, folder / Path(name).name):
        if ".." not in Path(name).parts and not Path(name).is_absolute() and path.is_file():
            return path
    return None


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"{value!r} where a name belongs")
    return value.strip()


def _read_yolo(image: Path, labels: Path, names: Sequence[str]) -> _File:
    size_px = image_size_px(image)
    lines = _lines(labels) if labels.exists() else []
    return _File(image, [_yolo_box(line, labels, names, size_px) for line in lines], labels)


def _yolo_box(line: str, path: Path, names: Sequence[str], size_px: tuple[int, int]) -> _Box:
    words = line.split()
    if len(words) != 5 and (len(words) < 7 or len(words) % 2 == 0):
        raise _faulty(path, "YOLO's 'class cx cy w h'", repr(line[:80]))
    number, *shares = _numbers(words, path, "class and coordinates")
    if number not in range(len(names)):
        expected, remedy = f"a class from 0 to {len(names) - 1}", "name it in data.yaml or classes.txt"
        raise _faulty(path, f"{expected}, of which there is a name", words[0][:20], remedy)
    if min(shares) < -SPAN or max(shares) > 1 + SPAN:
        remedy = "divide pixels by the image's width and height"
        raise _faulty(path, "coordinates as shares of the image, 0 to 1", repr(line[:80]), remedy)
    points = np.reshape(shares, (-1, 2)) * size_px[::-1]
    if len(shares) == 4:
        middle, size = points
        points = np.array([middle - size / 2, middle + size / 2])
    (left, top), (right, bottom) = points.min(axis=0), points.max(axis=0)
    return _Box(names[int(number)], (left, top, right, bottom))


def yolo_names(folders: Sequence[Path]) -> tuple[str, ...]:
    """Names of the classes, in their order, from the first data.yaml or classes.txt in some folders."""
    for folder in folders:
        for path in (*sorted(folder.glob("*.yaml")), *sorted(folder.glob("*.yml"))):
            if found := _yaml_names(path):
                return found
        if (folder / "classes.txt").is_file():
            return tuple(line.strip() for line in _lines(folder / "classes.txt"))
    expected, places = "data.yaml or classes.txt with the names of the classes", ", ".join(map(str, folders))
    raise OptionError("YOLO labels", expected=expected, got=f"neither in {places}", remedy="add one")


def _yaml_names(path: Path) -> tuple[str, ...]:
    """The list or table `names` of a YAML file; nothing where it has none."""
    try:
        import yaml  # type: ignore[import-untyped]  # its stubs are one more package, for one function
    except ImportError as error:
        got, remedy = "no such package", "pip install 'beers-deploy[detect]', or write classes.txt"
        raise MissingExtraError(str(path), expected="PyYAML to read it", got=got, remedy=remedy) from error
    text = _read_bytes(path, NAMES_BYTES)
    try:
        content: Any = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise _faulty(path, "YAML", " ".join(str(error).split())[:100]) from error
    if not isinstance(content, dict) or "names" not in content:
        return ()
    names = class_names(content["names"])
    if not names:
        raise _faulty(path, "names: a list, or a table by number from 0", "other names")
    return names


def _lines(path: Path) -> list[str]:
    return [line for line in _read_bytes(path).decode("utf-8-sig", "replace").splitlines() if line.strip()]


def _read_bytes(path: Path, limit_bytes: int = LABEL_BYTES) -> bytes:
    try:
        return read_whole(path, limit_bytes)
    except (OSError, ValueError) as error:
        raise _faulty(path, "a file of labels", getattr(error, "strerror", None) or str(error)) from error


def _numbers(texts: Sequence[str], path: Path, what: str) -> list[float]:
    try:
        found = [float(text) for text in texts]
    except ValueError:
        found = [math.nan]
    if not all(map(math.isfinite, found)):
        raise _faulty(path, f"numbers as {what}", repr(" ".join(texts))[:80])
    return found


def _faulty(path: Path, expected: str, got: str, remedy: str = "correct the labels") -> OptionError:
    return OptionError(str(path), expected=expected, got=got, remedy=remedy)
