"""Write small labelled folders in published layouts, all of the same two images."""

import json
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from PIL import Image

from beers_deploy.model.io.pictures import Stretch
from beers_deploy.profiles.sensor import Sensor
from benchmarks.detector.demonstration import synthetic_labelled

Object = tuple[str, float, float, float, float]
"""Name, left, top, right and bottom, in continuous pixel coordinates."""

SIZE_PX = (40, 60)
OBJECTS: dict[str, list[Object]] = {
    "00001": [("ship", 2, 3, 12, 9), ("Expressway-Service-area", 20, 10, 60, 40)],
    "00002": [("ship", 0, 0, 10, 20)],
}
SPELT = ("Motor-Car", "SHIP", "aircraft", "Storage tank")
"""Names of the drawn classes as a labelled folder spells them."""


def image(path: Path, size_px: tuple[int, int] = SIZE_PX) -> Path:
    """Write an image file in the format of its suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((*size_px, 3), 90, np.uint8)).save(path)
    return path


def text(path: Path, content: str) -> Path:
    """Write a text file, and the folders above it where they are missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content, encoding="utf-8")
    return path


def xml(objects: Sequence[Object], size_px: tuple[int, int] = SIZE_PX) -> str:
    """Return labels in Pascal VOC, whose corners count pixels from 1."""
    entries = "".join(
        f"<object><name>{name}</name><difficult>0</difficult>"
        f"<bndbox><xmin>{x1 + 1:g}</xmin><ymin>{y1 + 1:g}</ymin>"
        f"<xmax>{x2:g}</xmax><ymax>{y2:g}</ymax></bndbox></object>"
        for name, x1, y1, x2, y2 in objects
    )
    height, width = size_px
    size = f"<size><width>{width}</width><height>{height}</height><depth>3</depth></size>"
    return f"<annotation>{size}{entries}</annotation>"


def voc(folder: Path) -> Path:
    """Write images with their XML next to them."""
    for stem, objects in OBJECTS.items():
        image(folder / f"{stem}.png")
        text(folder / f"{stem}.xml", xml(objects))
    return folder


def dior(folder: Path, objects: dict[str, dict[str, list[Object]]]) -> Path:
    """Write DIOR as published, with oriented and upright boxes.

    Args:
        folder: where to write.
        objects: the objects of each image, by split and then by the name of the image.
    """
    for split, images in objects.items():
        inner = "JPEGImages-test" if split == "test" else "JPEGImages-trainval"
        for stem, boxes in images.items():
            image(folder / inner / f"{stem}.jpg")
            text(folder / "Annotations" / "Horizontal Bounding Boxes" / f"{stem}.xml", xml(boxes))
            oriented = xml(boxes).replace("bndbox", "robndbox")
            text(folder / "Annotations" / "Oriented Bounding Boxes" / f"{stem}.xml", oriented)
        text(folder / "ImageSets" / "Main" / f"{split}.txt", "\n".join(images) + "\n")
    return folder


def coco(folder: Path) -> Path:
    """Write images and one JSON file, whose ids are not in the order of the names."""
    names = sorted({box[0] for box in chain.from_iterable(OBJECTS.values())})
    images: list[dict[str, object]] = []
    annotations: list[dict[str, object]] = []
    for number, (stem, objects) in enumerate(sorted(OBJECTS.items(), reverse=True)):
        name = image(folder / f"{stem}.png").name
        size = dict(zip(("height", "width"), SIZE_PX, strict=True))
        images.append({"id": number, "file_name": name, **size})
        for kind, x1, y1, x2, y2 in objects:
            box = {"image_id": number, "bbox": [x1, y1, x2 - x1, y2 - y1], "iscrowd": 0}
            category = {"id": len(annotations), "category_id": 7 + names.index(kind)}
            annotations.append({**box, **category})
    categories = [{"id": 7 + i, "name": name} for i, name in enumerate(names)]
    content = {"images": images, "annotations": annotations, "categories": categories}
    text(folder / "labels.json", json.dumps(content))
    return folder


def labelled(folder: Path, count: int) -> Path:
    """Write drawn scenes as sRGB pictures with VOC labels next to them."""
    full_scale = Sensor.load("pleiades-reference").nominal()
    folder.mkdir()
    for number in range(count):
        scene = synthetic_labelled(number)
        picture = Stretch(0, 4095 / full_scale.gain_dn_per_radiance).to_srgb(
            scene.radiance(full_scale)
        )
        Image.fromarray(np.rint(255 * picture).astype(np.uint8)).save(folder / f"s{number}x.png")
        boxes: list[Object] = [
            (SPELT[c], *corners.tolist())
            for c, corners in zip(scene.truth.classes, scene.truth.corners, strict=True)
        ]
        text(folder / f"s{number}x.xml", xml(boxes, (768, 768)))
    return folder
