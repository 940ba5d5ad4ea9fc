"""Labels as COCO writes them: one JSON file of images, categories and annotations.

A box is left, top, width and height in px. The format: Lin et al., arXiv 1405.0312; cocodataset.org/#format-data.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from deploy.detection.labels import FileLabels, NamedBox, faulty
from profiles.toml import read_json

LISTS = ("images", "annotations", "categories")
XVIEW = "convert it to COCO or YOLO first, as docs.ultralytics.com/datasets/detect/xview does"


def read_coco(labels: Path, images: Path) -> tuple[list[FileLabels], list[str]]:
    """The boxes of every image that is both listed and in the folder, and a sentence about those that are not there.

    Raises:
        OptionError: no COCO, entries that lack a field or point nowhere, or no image of it in the folder.
    """
    lists = _lists(labels)
    try:
        names = {entry["id"]: _text(entry["name"]) for entry in lists["categories"]}
        listed = {entry["id"]: entry for entry in lists["images"]}
        boxes: dict[Any, list[NamedBox]] = {key: [] for key in listed}
        for entry in lists["annotations"]:
            boxes[entry["image_id"]].append(_box(entry, names))
        found = {key: _image(images, _text(entry["file_name"])) for key, entry in listed.items()}
        sizes = {key: _size(entry) for key, entry in listed.items()}
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        got = f"an entry that breaks it ({type(error).__name__}: {' '.join(str(error).split())[:60]})"
        raise faulty(labels, "COCO's images, annotations and categories", got) from error
    there = [FileLabels(path, boxes[key], labels, sizes[key]) for key, path in found.items() if path is not None]
    absent = len(found) - len(there)
    if not there:
        remedy = "give the folder that holds them"
        raise faulty(labels, f"its images in {images}", f"none of {len(found)}", remedy)
    return there, [f"{absent} of {len(found)} images in {labels.name} are not in the folder."] if absent else []


def _lists(labels: Path) -> dict[str, Sequence[Mapping[str, Any]]]:
    try:
        content: Any = read_json(labels)
    except (OSError, ValueError) as error:
        got = getattr(error, "strerror", None) or " ".join(str(error).split())[:100]
        remedy = XVIEW if labels.suffix.lower() == ".geojson" else "give COCO's JSON file"
        raise faulty(labels, "COCO's JSON", got, remedy) from error
    kind = content.get("type") if isinstance(content, dict) else None
    if kind == "FeatureCollection":
        raise faulty(labels, "COCO's JSON", "GeoJSON, as xView has it", XVIEW)
    lists = {name: content.get(name) if isinstance(content, dict) else None for name in LISTS}
    for name, entries in lists.items():
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise faulty(labels, "COCO's lists images, annotations and categories", f"no list {name!r}")
    return lists  # type: ignore[return-value]


def _box(entry: Mapping[str, Any], names: Mapping[Any, str]) -> NamedBox:
    left, top, width, height = (float(value) for value in entry["bbox"])
    ignored = bool(entry.get("iscrowd", 0))
    return NamedBox((left, top, left + width, top + height), names[entry["category_id"]], ignored)


def _size(entry: Mapping[str, Any]) -> tuple[int, int] | None:
    height, width = int(entry.get("height") or 0), int(entry.get("width") or 0)
    return (height, width) if height > 0 and width > 0 else None


def _image(folder: Path, name: str) -> Path | None:
    """The file of that name in the folder, or of its last part; nothing outside the folder."""
    for path in (folder / name, folder / Path(name).name):
        if ".." not in Path(name).parts and not Path(name).is_absolute() and path.is_file():
            return path
    return None


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"{value!r} where a name belongs")
    return value.strip()
