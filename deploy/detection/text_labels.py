"""Labels as lines of text, a file an image: YOLO's, and DOTA's, whose oriented boxes are enclosed in upright ones.

YOLO (docs.ultralytics.com/datasets/detect): `class cx cy w h`, or `class x y x y x y ...` of an outline, as shares of
the image; the names of the classes stand in data.yaml or classes.txt; an image without a file shows no object.
DOTA (captain-whu.github.io/DOTA/dataset.html): lines `imagesource:` and `gsd:`, then `x y x y x y x y category
difficult` in px.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from deploy.detection.labels import FileLabels, NamedBox, enclosing, faulty, numbers, read_labels
from profiles.errors import MachineError, OptionError

HEADERS = ("imagesource:", "gsd:")
NAMES_BYTES = 1 << 16
"""Of data.yaml: PyYAML takes 0.4 s of processor time for so much (measured)."""

SPAN = 1e-3
"""By how much a share may pass 0 or 1: tools write six digits or fewer."""


def read_dota(image: Path, labels: Path) -> FileLabels:
    """The boxes of one image of DOTA, each the upright one around its oriented box.

    Raises:
        OptionError: missing, or a line that is none of DOTA's.
    """
    return FileLabels(image, tuple(_dota(line, labels) for line in _lines(labels)), labels)


def _dota(line: str, path: Path) -> NamedBox:
    words = line.split()
    if len(words) not in (9, 10) or (len(words) == 10 and words[9] not in ("0", "1", "2")):
        raise faulty(path, "DOTA's eight coordinates, category and difficulty", repr(line[:80]))
    return NamedBox(enclosing(numbers(words[:8], path, "coordinates")), words[8], words[9:] in (["1"], ["2"]))


def is_dota(labels: Sequence[Path]) -> bool:
    """Whether files are DOTA's and not YOLO's, by the first line of all: its ninth word is a name."""
    for path in labels:
        for line in _lines(path):
            words = line.split()
            return len(words) in (9, 10) and not _is_number(words[8])
    return False


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def read_yolo(image: Path, labels: Path, names: Sequence[str], size_px: tuple[int, int]) -> FileLabels:
    """The boxes of one image; none where there is no file.

    Args:
        image: its file.
        labels: where its labels are, if it has any.
        names: of the classes, in their order.
        size_px: height and width of the image.

    Raises:
        OptionError: a line that is none of YOLO's, a class without a name, or coordinates outside 0 to 1.
    """
    lines = _lines(labels) if labels.exists() else []
    return FileLabels(image, tuple(_yolo(line, labels, names, size_px) for line in lines), labels)


def _yolo(line: str, path: Path, names: Sequence[str], size_px: tuple[int, int]) -> NamedBox:
    words = line.split()
    if len(words) != 5 and (len(words) < 7 or len(words) % 2 == 0):
        raise faulty(path, "YOLO's 'class cx cy w h'", repr(line[:80]))
    number, *shares = numbers(words, path, "class and coordinates")
    if number not in range(len(names)):
        remedy = "name it in data.yaml or classes.txt"
        raise faulty(path, f"a class from 0 to {len(names) - 1}, of which there is a name", words[0][:20], remedy)
    if min(shares) < -SPAN or max(shares) > 1 + SPAN:
        remedy = "divide pixels by the image's width and height"
        raise faulty(path, "coordinates as shares of the image, 0 to 1", repr(line[:80]), remedy)
    if len(shares) == 4:
        x, y, width, height = shares
        shares = [x - width / 2, y - height / 2, x + width / 2, y + height / 2]
    left, top, right, bottom = enclosing(shares)
    rows, columns = size_px
    return NamedBox((left * columns, top * rows, right * columns, bottom * rows), names[int(number)])


def yolo_names(folders: Sequence[Path]) -> tuple[str, ...]:
    """Names of the classes, in their order, from the first data.yaml or classes.txt in some folders.

    Raises:
        OptionError: none of them holds either, or what is there does not name classes.
        MachineError: PyYAML, which reads data.yaml, is not installed.
    """
    for folder in folders:
        for path in (*sorted(folder.glob("*.yaml")), *sorted(folder.glob("*.yml"))):
            if found := _from_yaml(path):
                return found
        if (folder / "classes.txt").is_file():
            return tuple(line.strip() for line in _lines(folder / "classes.txt"))
    got = "neither in " + ", ".join(map(str, folders))
    raise OptionError(
        "YOLO labels", expected="data.yaml or classes.txt with the names of the classes", got=got, remedy="add one"
    )


def _from_yaml(path: Path) -> tuple[str, ...]:
    """The list or table `names` of a YAML file; nothing where it has none."""
    try:
        import yaml  # type: ignore[import-untyped]  # its stubs are one more package, for one function
    except ImportError as error:
        remedy = "pip install 'beers-deploy[detect]', or write classes.txt"
        raise MachineError(str(path), expected="PyYAML to read it", got="no such package", remedy=remedy) from error
    try:
        content: Any = yaml.safe_load(read_labels(path, NAMES_BYTES))
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise faulty(path, "YAML", " ".join(str(error).split())[:100]) from error
    names = content.get("names") if isinstance(content, dict) else None
    if names is None:
        return ()
    if isinstance(names, dict) and sorted(names, key=str) == sorted(range(len(names)), key=str):
        names = [names[number] for number in range(len(names))]
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name.strip() for name in names):
        raise faulty(path, "names: a list, or a table by number from 0", "other names")
    return tuple(name.strip() for name in names)


def _lines(path: Path) -> list[str]:
    """Lines that hold something, without DOTA's headers."""
    text = read_labels(path).decode("utf-8-sig", "replace")
    return [line for line in text.splitlines() if line.strip() and not line.lower().startswith(HEADERS)]
