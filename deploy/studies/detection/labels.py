"""Labelled images: Pascal VOC (DIOR's folders among it), and COCO.

Boxes are in continuous pixels of the image, pixel i covering [i, i + 1):

- VOC, an XML file an image (Everingham et al., VOC2012 development kit; DIOR: Li et al., arXiv
  1909.00133): corners count pixels from 1 and belong to the box.
- COCO, one JSON file (Lin et al., arXiv 1405.0312; cocodataset.org/#format-data): left, top, width,
  height in px.
"""

import math
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from beers_deploy.model.io.files import IMAGE_SUFFIXES
from beers_deploy.model.raster.images import image_size_px, list_images
from beers_deploy.model.raster.index import parse_xml
from beers_deploy.profiles.errors import OptionError, counted, printable, reason_of
from beers_deploy.profiles.user_files.json_text import read_json
from beers_deploy.profiles.user_files.whole import read_whole
from beers_deploy.studies.detection.boxes import Boxes, areas
from beers_deploy.studies.detection.detector import letters

CORRECT = "Correct the labels."
LABEL_BYTES = 1 << 23
"""The largest size of a file of labels, which is 25 000 boxes of XML."""
HORIZONTAL = "Horizontal Bounding Boxes"
CORNERS = ("xmin", "ymin", "xmax", "ymax")

Box = tuple[str, Sequence[float], bool]
"""A name, the corners, and True if the box is ignored."""


class LabelledSet(NamedTuple):
    """Labelled images, read from files.

    Attributes:
        images: the path of each image with its labelled boxes in pixels of the image, sorted by
            name.
        names: the names of the classes; the class indices of the boxes refer to them.
        notes: sentences for the reader of results, such as on boxes that were left out.
    """

    images: list[tuple[Path, Boxes]]
    names: list[str]
    notes: list[str]


class _File(NamedTuple):
    """The labels of one image.

    Attributes:
        image: the path of the image.
        source: the path of the file of the labels.
        boxes: the labelled boxes.
        size_px: the height and width of the image for which the labels were made; 0 if they state
            no size.
    """

    image: Path
    source: Path
    boxes: list[Box]
    size_px: tuple[float, float]


def read_labelled(
    images: Path, labels: Path | None = None, split: str | None = None
) -> LabelledSet:
    """Read the labelled images of a folder, in the formats of Pascal VOC, DIOR or COCO.

    Args:
        images: the folder of the images, or the top of a folder tree in the layout of VOC and DIOR.
        labels: a folder of VOC's XML files, one for each image, or the path of COCO's JSON file;
            None searches next to the images.
        split: the name of a list of images in a tree of VOC or DIOR, such as "test"; None uses
            "test" if there is one, else all images.

    Raises:
        OptionError: labels are missing, damaged, of another image size or without any object, or
            there is no such split.
    """
    is_tree = (images / "Annotations").is_dir() and any(images.glob("JPEGImages*"))
    if labels is None and is_tree:
        return _labelled_set(_read_voc_tree(images, split))
    if split is not None:
        raise OptionError(
            f"`split` needs folders as VOC and DIOR have them, but {images} has none. Leave it out."
        )
    where = labels
    if where is None:
        # This refuses a folder without images.
        list_images(images)
        where = images
        # Without XML files next to the images, their labels are one JSON file there.
        if not any(path.suffix.lower() == ".xml" for path in images.iterdir()):
            json_files = sorted(images.glob("*.json"))
            if len(json_files) != 1:
                raise OptionError(
                    f"{images} must have .xml files of VOC labels or one .json file of COCO "
                    f"labels, but it has {len(json_files)} .json files. Give the labels as "
                    "`labels`."
                )
            where = json_files[0]
    if where.suffix.lower() == ".json":
        return _labelled_set(*_read_coco(where, images))
    return _labelled_set(*_read_each(list_images(images), where))


def _read_each(images: Sequence[Path], where: Path) -> tuple[list[_File], list[str]]:
    """Read the labels of every image. Also return a sentence about labels without an image."""
    if not where.is_dir():
        raise OptionError(f"{where} is no folder of VOC labels and no .json file. Give the labels.")
    names_there = {path.name for path in where.iterdir()}
    absent = [f"{image.stem}.xml" for image in images if f"{image.stem}.xml" not in names_there]
    _require_all(absent, len(images), where)
    files = [_read_voc(image, where / f"{image.stem}.xml") for image in images]
    labels = [name for name in names_there if name.lower().endswith(".xml")]
    stems = {image.stem for image in images}
    unused = sum(Path(name).stem not in stems for name in labels)
    if not unused:
        return files, []
    return files, [f"{unused} of {len(labels)} files of labels in {where} are of no image."]


def _require_all(absent: Sequence[str], count: int, folder: Path) -> None:
    """Raise OptionError if files are absent."""
    if absent:
        raise OptionError(
            f"{len(absent)} of {count} files are missing in {folder}, the first "
            f"{printable(repr(absent[0]))}. Add them: an image without objects needs a file of "
            "labels too."
        )


def _labelled_set(files: Sequence[_File], notes: Sequence[str] = ()) -> LabelledSet:
    boxes = chain.from_iterable(one.boxes for one in files)
    # Sorted twice: names of the same letters have a fixed order too.
    names = sorted(sorted({name for name, *_ in boxes}), key=letters)
    number = {name: i for i, name in enumerate(names)}
    images = []
    outside = list[str]()
    for one in sorted(files, key=lambda one: one.image.name):
        labelled = Boxes.of(
            [corners for _, corners, _ in one.boxes],
            [number[name] for name, *_ in one.boxes],
            ignored=[ignored for *_, ignored in one.boxes],
        )
        inside = labelled[areas(labelled.corners) > 0].clipped(*_size_px(one))
        outside += [one.source.name] * (len(labelled) - len(inside))
        images.append((one.image, inside))
    truths = [truth for _, truth in images]
    # Without an object that counts there is no recall and no average precision.
    if all(truth.ignored.all() for truth in truths):
        raise OptionError(
            f"The labels must have at least one object that counts, but they have none on "
            f"{counted(len(images), 'image')}. Check the labels."
        )
    empty = sum(not len(truth) for truth in truths)
    ignored = sum(int(truth.ignored.sum()) for truth in truths)
    remarks = {
        f"Images without a labelled object, all found there is false: {empty} of {len(truths)}.": (
            empty
        ),
        f"Boxes left out, without area inside their image: {len(outside)}, the first in "
        f"{''.join(outside[:1])}.": len(outside),
        "Boxes that count neither way, difficult, a crowd or visible by less than 30 %: "
        f"{ignored}.": ignored,
    }
    return LabelledSet(images, names, [*notes, *(text for text, n in remarks.items() if n)])


def _size_px(one: _File) -> tuple[int, int]:
    """Return height and width of an image in px. Raise OptionError if its labels were made for
    another size.
    """
    height, width = image_size_px(one.image)
    # Boxes in pixels fit only the image that they were drawn on.
    if min(one.size_px) > 0 and one.size_px != (height, width):
        raise OptionError(
            f"{one.source} labels an image of {one.size_px[0]:g} x {one.size_px[1]:g} px, but the "
            f"image has {height} x {width} px. Give the image that was labelled."
        )
    return height, width


def _read_voc_tree(folder: Path, split: str | None) -> list[_File]:
    """Read the labels of a split of VOC's or DIOR's folders. None uses `test`, or all images if
    there is no such split.
    """
    images = {
        p.stem: p
        for p in sorted(folder.glob("JPEGImages*/*"))
        if p.suffix.lower() in IMAGE_SUFFIXES
    }
    labels = folder / "Annotations"
    # DIOR has a folder of horizontal boxes and one of oriented ones.
    labels = labels / HORIZONTAL if (labels / HORIZONTAL).is_dir() else labels
    lists = {path.stem: path for path in sorted((folder / "ImageSets" / "Main").glob("*.txt"))}
    stems = list(images)
    list_name = split or "test"
    if list_name in lists:
        # A list of one class has a number after each name.
        text = _read_bytes(lists[list_name]).decode("utf-8-sig", "replace")
        stems = sorted({line.split()[0] for line in text.splitlines() if line.strip()})
    elif split:
        raise OptionError(
            f"`split` must be one of the splits of {folder} ({', '.join(lists) or 'none'}), but "
            f"it is {split!r}."
        )
    _require_all([stem for stem in stems if stem not in images], len(stems), folder)
    return [_read_voc(images[stem], labels / f"{stem}.xml") for stem in stems]


def _read_voc(image: Path, labels: Path) -> _File:
    text = _read_bytes(labels)
    try:
        root = parse_xml(text)
    except (ValueError, LookupError, RecursionError) as error:
        # A LookupError is that of an unknown encoding.
        reason = reason_of(error)
        raise OptionError(f"{labels} is not plain XML: {reason}. {CORRECT}") from error
    if root.tag != "annotation":
        raise OptionError(
            f"{labels} must be Pascal VOC, an 'annotation', but it is {f'<{root.tag}>'[:80]}. "
            "Give labels of VOC."
        )
    height, width = _numbers(
        [root.findtext(f"size/{name}", "0") for name in ("height", "width")], labels, "size"
    )
    boxes: list[Box] = []
    for entry in root.iter("object"):
        name = (entry.findtext("name") or "").strip()
        if not name:
            raise OptionError(f"{labels} has an object without a name. {CORRECT}")
        corners = [entry.findtext(f"bndbox/{corner}", "none") for corner in CORNERS]
        left, top, right, bottom = _numbers(corners, labels, f"{', '.join(CORNERS)} of a {name!r}")
        ignored = (entry.findtext("difficult") or "0").strip() == "1"
        # VOC's corners count pixels from 1 and belong to the box.
        boxes.append((name, (left - 1, top - 1, right, bottom), ignored))
    return _File(image, labels, boxes, (height, width))


def _read_coco(labels: Path, folder: Path) -> tuple[list[_File], list[str]]:
    """Read the labels of every image that is both listed and in the folder. Also return a sentence
    about those that are not.
    """
    files, listed = _coco_files(labels, folder)
    if not files:
        raise OptionError(
            f"No image that {labels} lists ({listed}) is in {folder}. Give the folder that holds "
            "them."
        )
    paths = {one.image for one in files}
    if len(paths) < len(files):
        raise OptionError(f"{labels} lists one image of {folder} twice. {CORRECT}")
    # COCO's names may lead into folders below.
    there = list(chain.from_iterable(map(list_images, {path.parent for path in paths})))
    absent = listed - len(files)
    unlisted = len([path for path in there if path not in paths])
    remarks = {
        f"{absent} of {listed} images in {labels.name} are not in the folder.": absent,
        f"{unlisted} of {len(there)} images in the folder are left out, because {labels.name} does "
        "not list them.": unlisted,
    }
    return files, [text for text, n in remarks.items() if n]


def _coco_files(labels: Path, folder: Path) -> tuple[list[_File], int]:
    """Read the labels of the listed images that are in the folder, and count those listed."""
    try:
        content: Any = read_json(labels)
        # `str.strip` raises TypeError where a name is no text, and the file is refused below.
        names = {entry["id"]: str.strip(entry["name"]) for entry in content["categories"]}
        boxes: dict[Any, list[Box]] = {entry["id"]: [] for entry in content["images"]}
        for entry in content["annotations"]:
            left, top, width, height = map(float, entry["bbox"])
            box = (
                names[entry["category_id"]],
                (left, top, left + width, top + height),
                bool(entry.get("iscrowd", 0)),
            )
            boxes[entry["image_id"]].append(box)
        if len(boxes) < len(content["images"]):
            raise ValueError("two images have one id")
        files = [
            _File(
                path,
                labels,
                boxes[entry["id"]],
                (float(entry.get("height") or 0), float(entry.get("width") or 0)),
            )
            for entry in content["images"]
            if (path := _inside(folder, entry["file_name"]))
        ]
        return files, len(content["images"])
    except (OSError, LookupError, TypeError, ValueError, OverflowError) as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:100]}"
        raise OptionError(
            f"{labels} must have COCO's lists of images, annotations and categories, but they "
            f"cannot be read ({reason}). Give COCO's JSON file."
        ) from error


def _inside(folder: Path, name: str) -> Path | None:
    """Return the file of that name, or of its last part, in the folder. A path outside the folder
    gives None.
    """
    # A name in the file must not lead out of the folder.
    if ".." in Path(name).parts or Path(name).is_absolute():
        return None
    return next(
        (path for path in (folder / name, folder / Path(name).name) if path.is_file()), None
    )


def _read_bytes(path: Path) -> bytes:
    try:
        return read_whole(path, LABEL_BYTES)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise OptionError(f"{path} is not a file of labels: {reason}. {CORRECT}") from error


def _numbers(texts: Sequence[str], path: Path, what: str) -> list[float]:
    try:
        numbers = [float(text) for text in texts]
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise OptionError(
            f"{path} must have numbers as {printable(what)}, but it has "
            f"{repr(' '.join(texts))[:80]}. {CORRECT}"
        )
    return numbers
