"""Test that every layout of the same labels gives the same boxes, and that any other folder is
refused in one sentence.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.studies.detection.detector import class_numbers
from beers_deploy.studies.detection.labels import LabelledSet, read_labelled
from tests.deploy.studies.detection.folders import (
    OBJECTS,
    Object,
    coco,
    dior,
    image,
    text,
    voc,
    xml,
)

LAYOUTS: dict[str, Callable[[Path], Path]] = {"voc": voc, "coco": coco}
LAYOUTS["dior"] = lambda folder: dior(folder, {"test": OBJECTS})

SHIP = xml([("ship", 2, 3, 12, 9)])


def boxes_of(labelled: LabelledSet) -> dict[str, list[tuple[object, ...]]]:
    return {
        path.stem: [
            (labelled.names[c], *corners.round(9))
            for c, corners in zip(truth.classes, truth.corners, strict=True)
        ]
        for path, truth in labelled.images
    }


def by_voc(folder: Path, content: str, name: str = "a.xml") -> Path:
    """Write an image a.png and a file of labels next to it."""
    return text(image(folder / "a.png").with_name(name), content)


def rewritten(folder: Path, change: Callable[[Any], object]) -> None:
    """Write a folder of labels in COCO's layout, and change the content of its file."""
    path = coco(folder) / "labels.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def refused(folder: Path, sentence: str) -> None:
    with pytest.raises(OptionError, match=sentence) as error:
        read_labelled(folder)
    assert str(error.value).isprintable()
    assert len(str(error.value)) < 500 + len(str(folder))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_of_the_same_labels_gives_the_same_boxes(layout: str, tmp_path: Path) -> None:
    labelled = read_labelled(LAYOUTS[layout](tmp_path))
    assert labelled.names == ["Expressway-Service-area", "ship"]
    assert boxes_of(labelled) == OBJECTS
    assert not any(truth.ignored.any() for _, truth in labelled.images)
    assert labelled.notes == []


@pytest.mark.parametrize("layout", ["voc", "coco"])
def test_labels_may_lie_elsewhere(layout: str, tmp_path: Path) -> None:
    folder = LAYOUTS[layout](tmp_path / "made")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for path in folder.rglob({"voc": "*.xml", "coco": "*.json"}[layout]):
        path.rename(elsewhere / path.name)
    labels = elsewhere / "labels.json" if layout == "coco" else elsewhere
    assert boxes_of(read_labelled(folder, labels)) == OBJECTS


def test_dior_is_read_by_split_and_its_classes_by_their_letters(tmp_path: Path) -> None:
    test: dict[str, list[Object]] = {
        "00001": [("Expressway-toll-station", 1, 2, 20, 30), ("storagetank", 1, 2, 9, 9)]
    }
    splits: dict[str, dict[str, list[Object]]] = {
        "train": {"00099": [("ship", 1, 1, 9, 9)]},
        "val": {"00098": [("dam", 1, 1, 9, 9)]},
    }
    folder = dior(tmp_path, {**splits, "test": test})
    labelled = read_labelled(folder)
    assert boxes_of(labelled) == test
    assert boxes_of(read_labelled(folder, split="val")) == splits["val"]
    # Other folders spell and order the same classes like this.
    spelt = ("ship", "Storage Tank", "expressway toll station")
    assert class_numbers(labelled.names, spelt, {}).tolist() == [2, 1]


def test_a_split_that_is_not_there_is_named_with_those_that_are(tmp_path: Path) -> None:
    folder = dior(tmp_path, {"test": OBJECTS})
    with pytest.raises(OptionError, match=r"one of the splits .* \(test\), but it is 'trainval'"):
        read_labelled(folder, split="trainval")
    with pytest.raises(OptionError, match="`split` needs folders as VOC and DIOR have them"):
        read_labelled(voc(tmp_path / "plain"), split="test")
    text(folder / "ImageSets" / "Main" / "test.txt", "00001\n00777\n")
    refused(folder, "1 of 2 files are missing in .*, the first '00777'")
    with pytest.raises(
        OptionError, match=r"numbers as xmin, ymin, xmax, ymax of a .* has 'none none none none'"
    ):
        read_labelled(
            folder / "JPEGImages-test", folder / "Annotations" / "Oriented Bounding Boxes"
        )


def test_the_four_photographs_are_read_with_their_boxes(shared_data: Path) -> None:
    folder = shared_data / "detection"
    if not folder.is_dir():
        pytest.skip("no folder shared/data/detection beside the repository")
    labelled = read_labelled(folder)
    classes = np.concatenate([truth.classes for _, truth in labelled.images])
    assert [
        int((classes == labelled.names.index(name)).sum()) for name in ("car", "minibus", "Tree")
    ] == [108, 3, 61]
    assert labelled.images[0][1].corners[0].tolist() == [160.0, 97.0, 182.0, 138.0]
    assert labelled.notes == []


def test_boxes_outside_or_without_area_are_left_out_and_counted(tmp_path: Path) -> None:
    boxes: list[Object] = [("ship", 5, 5, 9, 9), ("ship", 70, 5, 90, 9), ("ship", 9, 9, 9, 20)]
    by_voc(tmp_path, xml(boxes))
    labelled = read_labelled(tmp_path)
    assert boxes_of(labelled)["a"] == [("ship", 5, 5, 9, 9)]
    assert labelled.notes == [
        "Boxes left out, without area inside their image: 2, the first in a.xml."
    ]


def test_labels_of_an_image_of_another_size_are_refused(tmp_path: Path) -> None:
    image(voc(tmp_path) / "00002.png", (80, 120))
    refused(tmp_path, r"00002\.xml labels an image of 40 x 60 px, but the image has 80 x 120 px")


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda folder: image(folder / "a.png"), "but it has 0 .json files"),
        (
            lambda folder: by_voc(folder, xml([]), "b.xml"),
            "1 of 1 files are missing in .*, the first 'a.xml'",
        ),
        (lambda folder: by_voc(folder, xml([])), "none on 1 image"),
        (lambda folder: folder, "there is no image in it"),
        (lambda folder: text(text(coco(folder) / "b.json", "{}"), "{}"), "it has 2 .json files"),
    ],
)
def test_a_folder_without_labelled_images_is_refused(
    make: Callable[[Path], object], sentence: str, tmp_path: Path
) -> None:
    make(tmp_path)
    with pytest.raises((OptionError, ImageError), match=sentence):
        read_labelled(tmp_path)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ('<!DOCTYPE a [<!ENTITY b "c">]>' + SHIP, "a document type"),
        (SHIP.replace("<xmin>3</xmin>", ""), "xmin, .* of a 'ship', but it has 'none 4 12 9'"),
        (SHIP.replace("<name>ship</name>", "<name> </name>"), "an object without a name"),
        ("<kml></kml>", "Pascal VOC, an 'annotation', but it is <kml>"),
        ('<?xml version="1.0" encoding="klingon"?>' + SHIP, "is not plain XML: .*klingon"),
    ],
)
def test_a_faulty_voc_file_is_refused_by_a_sentence(
    content: str, sentence: str, tmp_path: Path
) -> None:
    by_voc(tmp_path, content)
    refused(tmp_path, sentence)


def test_a_huge_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    image(tmp_path / "a.png")
    with (tmp_path / "a.xml").open("wb") as stream:
        stream.truncate(1 << 40)
    refused(tmp_path, "more than 8388608 bytes")


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        ({"images": None}, "TypeError: 'NoneType'"),
        (
            {"annotations": [{"image_id": 9, "category_id": 7, "bbox": [0, 0, 1, 1]}]},
            "KeyError: 9",
        ),
        ({"categories": [{"id": 7, "name": 5}]}, "TypeError: "),
        *(
            (
                {"images": [{"id": 0, "file_name": name}], "annotations": []},
                "No image that .*labels.json lists .1. is in",
            )
            for name in ("../../etc/passwd", "/etc/passwd")
        ),
    ],
)
def test_a_faulty_coco_file_is_refused_by_a_sentence(
    damage: dict[str, object], sentence: str, tmp_path: Path
) -> None:
    rewritten(tmp_path, lambda content: content.update(damage))
    refused(tmp_path, sentence)


def test_files_of_labels_without_an_image_are_counted(tmp_path: Path) -> None:
    text(voc(tmp_path) / "00003.xml", SHIP)
    assert read_labelled(tmp_path).notes == [
        f"1 of 3 files of labels in {tmp_path} are of no image."
    ]


def test_images_that_coco_does_not_list_are_counted_and_one_listed_twice_is_refused(
    tmp_path: Path,
) -> None:
    path = coco(tmp_path) / "labels.json"
    content = json.loads(path.read_text())
    image(tmp_path / "00003.png")
    assert read_labelled(tmp_path).notes == [
        "1 of 3 images in the folder are left out, because labels.json does not list them."
    ]
    first, second = content["images"]
    for again, sentence in (
        ({**second, "id": 9}, r"labels\.json lists one image of .* twice"),
        ({**first, "file_name": "00003.png"}, "two images have one id"),
    ):
        path.write_text(json.dumps(content | {"images": [first, second, again]}))
        refused(tmp_path, sentence)


def test_labels_of_which_no_object_counts_are_refused(tmp_path: Path) -> None:
    def forgive(content: Any) -> None:
        for annotation in content["annotations"]:
            annotation["iscrowd"] = 1

    rewritten(tmp_path, forgive)
    refused(tmp_path, "at least one object that counts, but they have none on 2 images")


def test_images_missing_from_the_folder_are_counted_and_a_crowd_need_not_be_found(
    tmp_path: Path,
) -> None:
    rewritten(tmp_path, lambda content: content["annotations"][-1].update(iscrowd=1))
    (tmp_path / "00002.png").unlink()
    labelled = read_labelled(tmp_path)
    assert [path.stem for path, _ in labelled.images] == ["00001"]
    assert labelled.notes == [
        "1 of 2 images in labels.json are not in the folder.",
        "Boxes that count neither way, difficult, a crowd or visible by less than 30 %: 1.",
    ]
