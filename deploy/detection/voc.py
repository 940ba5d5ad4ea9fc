"""Labels as Pascal VOC writes them, an XML file an image, in the folders of VOC and of DIOR.

Their corners count pixels from 1 and belong to the box: xmin 1 and xmax 1 is the first column, 0 to 1 px here.
The folders of VOC (Everingham et al., VOC2012 development kit) are JPEGImages, Annotations and ImageSets/Main. Those
of DIOR (Li et al., arXiv 1909.00133) are JPEGImages-trainval, JPEGImages-test, Annotations/Horizontal Bounding Boxes
and ImageSets/Main.
"""

from pathlib import Path
from xml.etree import ElementTree as ET
from xml.parsers import expat

from deploy.detection.labels import FileLabels, NamedBox, faulty, numbers, read_labels
from model.io.files import IMAGE_SUFFIXES
from profiles.errors import OptionError

SPLITS = Path("ImageSets") / "Main"
HORIZONTAL = "Horizontal Bounding Boxes"
CORNERS = ("xmin", "ymin", "xmax", "ymax")
DEPTH = 32


def is_voc_tree(folder: Path) -> bool:
    """Whether a folder is laid out as VOC or DIOR is."""
    return (folder / "Annotations").is_dir() and bool(image_folders(folder))


def image_folders(folder: Path) -> list[Path]:
    """Its folders of images: JPEGImages, or DIOR's JPEGImages-trainval and JPEGImages-test."""
    return sorted(path for path in folder.glob("JPEGImages*") if path.is_dir())


def tree_pairs(folder: Path, split: str | None) -> list[tuple[Path, Path]]:
    """Image and label files of a split of a tree of folders; None takes `test`, or all where there is none.

    Raises:
        OptionError: no such split, or an image of it that is not there.
    """
    images = {path.stem: path for inner in image_folders(folder) for path in _images(inner)}
    labels = folder / "Annotations"
    labels = labels / HORIZONTAL if (labels / HORIZONTAL).is_dir() else labels
    splits = sorted(path.stem for path in (folder / SPLITS).glob("*.txt"))
    if split is None and "test" not in splits:
        return [(path, labels / f"{stem}.xml") for stem, path in sorted(images.items())]
    wanted = split or "test"
    if wanted not in splits:
        expected = f"one of its splits ({', '.join(splits) or 'none'})"
        raise OptionError(str(folder), expected=expected, got=repr(wanted), remedy="name one of them")
    stems = _stems(folder / SPLITS / f"{wanted}.txt")
    missing = [stem for stem in stems if stem not in images]
    if missing:
        got = f"{len(missing)} of {len(stems)} missing, the first {missing[0]!r}"
        raise OptionError(str(folder), expected=f"every image of {wanted}", got=got, remedy="unpack the images whole")
    return [(images[stem], labels / f"{stem}.xml") for stem in stems]


def _images(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]


def _stems(path: Path) -> list[str]:
    """Each line's first word: VOC's lists of one class have a number behind it."""
    lines = read_labels(path).decode("utf-8", "replace").splitlines()
    return sorted({line.split()[0] for line in lines if line.strip()})


def read_voc(image: Path, labels: Path) -> FileLabels:
    """The boxes of one image.

    Raises:
        OptionError: missing, no VOC, an object without class or upright corners, or a document type: with entities
            a file of a hundred bytes can grow to gigabytes.
    """
    root = _parsed(read_labels(labels), labels)
    if root.tag != "annotation":
        raise faulty(
            labels, "Pascal VOC, an 'annotation'", f"<{root.tag}>"[:80], "give VOC, COCO, YOLO or DOTA labels"
        )
    boxes = tuple(_box(entry, labels) for entry in root.iter("object"))
    size = [root.findtext(f"size/{name}", "0") for name in ("height", "width")]
    height, width = (int(value) for value in numbers(size, labels, "size"))
    return FileLabels(image, boxes, labels, (height, width) if height > 0 and width > 0 else None)


def _box(entry: ET.Element, path: Path) -> NamedBox:
    name = (entry.findtext("name") or "").strip()
    if not name:
        raise faulty(path, "a name for every object", "none")
    if entry.find("bndbox") is None and entry.find("robndbox") is not None:
        raise faulty(path, "upright boxes (bndbox)", "oriented ones", f"give the folder '{HORIZONTAL}'")
    texts = [entry.findtext(f"bndbox/{corner}") for corner in CORNERS]
    if None in texts:
        missing = ", ".join(corner for corner, text in zip(CORNERS, texts, strict=True) if text is None)
        raise faulty(path, f"{', '.join(CORNERS)} of every object", f"a {name!r} without {missing}")
    left, top, right, bottom = numbers([str(text) for text in texts], path, f"corners of a {name!r}")
    difficult = (entry.findtext("difficult") or "0").strip() == "1"
    return NamedBox((left - 1, top - 1, right, bottom), name, difficult)


def _parsed(content: bytes, path: Path) -> ET.Element:
    """The tree of an XML file without a document type, of at most `DEPTH` levels."""
    builder, parser, depth = ET.TreeBuilder(), expat.ParserCreate(), 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEPTH:
            raise faulty(path, f"at most {DEPTH} levels of elements", "more")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse(*_: object) -> None:
        raise faulty(path, "XML without a document type", "one, which may define entities", "remove its DOCTYPE")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = builder.data, refuse
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, LookupError, ValueError) as error:  # the two latter of an encoding that Python lacks
        raise faulty(path, "XML", " ".join(str(error).split())[:100]) from error
    return builder.close()
