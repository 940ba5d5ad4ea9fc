"""Small labelled folders, laid out as others publish theirs, all of the same two images."""

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
"""A name, then left, top, right and bottom in continuous px."""

SIZE_PX = (40, 60)
OBJECTS: dict[str, list[Object]] = {
    "00001": [("ship", 2, 3, 12, 9), ("Expressway-Service-area", 20, 10, 60, 40)],
    "00002": [("ship", 0, 0, 10, 20)],
}
SPELT = ("Motor-Car", "SHIP", "aircraft", "Storage tank")
"""Of the drawn classes, as a folder spells them."""


def image(path: Path, size_px: tuple[int, int] = SIZE_PX) -> Path:
    """An image file of any kind."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((*size_px, 3), 90, np.uint8)).save(path)
    return path


def text(path: Path, content: str) -> Path:
    """A text file, in folders that need not be there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content, encoding="utf-8")
    return path


def xml(objects: Sequence[Object], size_px: tuple[int, int] = SIZE_PX) -> str:
    """Pascal VOC: corners count pixels from 1."""
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
    """Images and their XML beside them."""
    for stem, objects in OBJECTS.items():
        image(folder / f"{stem}.png")
        text(folder / f"{stem}.xml", xml(objects))
    return folder


def dior(folder: Path, objects: dict[str, dict[str, list[Object]]]) -> Path:
    """DIOR as published, oriented boxes beside the upright ones; images by split, then by name."""
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
    """One file of JSON beside the images; its ids are in an order of their own."""
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
    """Drawn scenes as pictures in sRGB with VOC labels beside them."""
    full_scale = Sensor.load("pleiades-reference").nominal()
    folder.mkdir()
    for number in range(count):
        scene = synthetic_labelled(number, 0)
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
