"""Every layout gives the same boxes of the same labels; what none of them is, is refused by one sentence."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deploy.detection.annotations import LabelledSet, read_labelled
from deploy.detection.classes import class_map
from profiles.errors import BeersError, ImageError, OptionError
from tests.deploy.detection.folders import DIOR, OBJECTS, coco, dior, dota, image, text, voc, xml, yolo

LAYOUTS: dict[str, Callable[[Path], Path]] = {"voc": voc, "coco": coco, "yolo": yolo, "dota": dota}
LAYOUTS["dior"] = lambda folder: dior(folder, {"test": OBJECTS})


def boxes_of(found: LabelledSet) -> dict[str, list[tuple[object, ...]]]:
    return {
        one.path.stem: [
            (found.names[c], *corners.round(9))
            for c, corners in zip(one.truth.classes, one.truth.corners, strict=True)
        ]
        for one in found.images
    }


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_says_the_same_of_the_same_boxes(layout: str, tmp_path: Path) -> None:
    found = read_labelled(LAYOUTS[layout](tmp_path))
    assert found.names == ("Expressway-Service-area", "ship")
    assert boxes_of(found) == OBJECTS
    assert [one.site for one in found.images] == ["00001", "00002"]
    assert not any(one.truth.ignored.any() for one in found.images)
    assert all("DOTA" in note for note in found.notes)


@pytest.mark.parametrize("layout", ["voc", "yolo", "coco"])
def test_labels_may_lie_elsewhere(layout: str, tmp_path: Path) -> None:
    folder = LAYOUTS[layout](tmp_path / "made")
    suffix = {"voc": "*.xml", "yolo": "*.txt", "coco": "*.json"}[layout]
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for path in folder.rglob(suffix):
        path.rename(elsewhere / path.name)
    images = folder / "images" / "val" if layout == "yolo" else folder
    if layout == "yolo":
        text(elsewhere / "classes.txt", "Expressway-Service-area\nship\n")
    labels = elsewhere / "labels.json" if layout == "coco" else elsewhere
    assert boxes_of(read_labelled(images, labels)) == OBJECTS


def test_dior_is_read_by_split_with_its_twenty_classes(tmp_path: Path) -> None:
    of_all = {f"{i + 1:05}": [(name, 1.0, 2.0, 20.0, 30.0)] for i, name in enumerate(DIOR)}
    splits = {"train": {"00099": [("ship", 1.0, 1.0, 9.0, 9.0)]}, "val": {"00098": [("dam", 1.0, 1.0, 9.0, 9.0)]}}
    folder = dior(tmp_path, {**splits, "test": of_all})
    found = read_labelled(folder)
    assert sorted(found.names) == sorted(DIOR)
    assert boxes_of(found) == of_all
    assert boxes_of(read_labelled(folder, split="val")) == splits["val"]
    # As mmrotate and TorchGeo spell and order them.
    detector = sorted(name.lower().replace("-", " ") for name in DIOR)
    classes = class_map(found.names, detector)
    assert classes.unknown == ()
    assert [detector[i] for i in classes.truth] == [name.lower().replace("-", " ") for name in found.names]


def test_a_split_that_is_not_there_is_named_with_those_that_are(tmp_path: Path) -> None:
    folder = dior(tmp_path, {"test": OBJECTS})
    with pytest.raises(OptionError, match=r"one of its splits \(test\), got 'trainval'"):
        read_labelled(folder, split="trainval")
    with pytest.raises(OptionError, match="images of the split 'test'"):
        read_labelled(voc(tmp_path / "plain"), split="test")
    text(folder / "ImageSets" / "Main" / "test.txt", "00001\n00777\n")
    with pytest.raises(OptionError, match="1 of 2 missing, the first '00777'"):
        read_labelled(folder)


def test_the_oriented_boxes_of_dior_are_refused_with_the_folder_to_take(tmp_path: Path) -> None:
    folder = dior(tmp_path, {"test": OBJECTS})
    with pytest.raises(OptionError, match=r"upright boxes .* give the folder 'Horizontal Bounding Boxes'"):
        read_labelled(folder / "JPEGImages-test", folder / "Annotations" / "Oriented Bounding Boxes")


def test_the_four_photographs_are_read_with_their_boxes(shared_data: Path) -> None:
    folder = shared_data / "detection"
    if not folder.is_dir():
        pytest.skip("no folder shared/data/detection beside the repository")
    found = read_labelled(folder)
    counts = {one.path.stem.split("-")[-1]: len(one.truth) for one in found.images}
    assert counts == {"MOS74": 34, "MOS85": 37, "MOS93": 40, "neon_osbs_029": 61}
    assert set(found.names) == {"car", "minibus", "Tree"}
    classes = np.concatenate([one.truth.classes for one in found.images])
    assert [int((classes == found.names.index(name)).sum()) for name in ("car", "minibus", "Tree")] == [108, 3, 61]
    assert found.images[0].truth.corners[0].tolist() == [160.0, 97.0, 182.0, 138.0]
    assert found.notes == ()


def test_dota_s_oriented_boxes_are_enclosed_and_its_difficult_ones_ignored(tmp_path: Path) -> None:
    image(tmp_path / "images" / "P0001.png")
    lines = "imagesource:GoogleEarth\ngsd:null\n10 0 20 10 10 20 0 10 large-vehicle 1\n30 5 35 5 35 9 30 9 ship 0\n"
    text(tmp_path / "labelTxt" / "P0001.txt", lines)
    found = read_labelled(tmp_path)
    assert boxes_of(found)["P0001"] == [("large-vehicle", 0, 0, 20, 20), ("ship", 30, 5, 35, 9)]
    assert found.images[0].truth.ignored.tolist() == [True, False]


def test_xview_is_refused_with_what_converts_it(tmp_path: Path) -> None:
    image(tmp_path / "5.tif")
    feature = '{"type": "Feature", "properties": {"bounds_imcoords": "1,2,3,4", "type_id": 18, "image_id": "5.tif"}}'
    labels = text(tmp_path / "xView_train.geojson", f'{{"type": "FeatureCollection", "features": [{feature}]}}')
    for given in (labels, None):
        with pytest.raises(OptionError, match="GeoJSON, as xView has it; convert it to COCO or YOLO first"):
            read_labelled(tmp_path, given)


def test_a_yolo_image_without_labels_shows_nothing_and_is_told(tmp_path: Path) -> None:
    folder = yolo(tmp_path)
    image(folder / "images" / "val" / "00003.png")
    found = read_labelled(folder)
    assert boxes_of(found)["00003"] == []
    assert found.notes == ("Images without a labelled object, on which whatever is found is false: 1 of 3.",)


def test_a_voc_image_without_labels_is_refused(tmp_path: Path) -> None:
    image(voc(tmp_path) / "00003.png")
    with pytest.raises(
        OptionError, match=r"a file of labels for every image, got 1 of 3 missing, the first 00003\.xml"
    ):
        read_labelled(tmp_path)


def test_labels_without_one_object_are_refused(tmp_path: Path) -> None:
    image(tmp_path / "a.png")
    text(tmp_path / "a.xml", xml([]))
    with pytest.raises(OptionError, match="one object at least, got none on 1 images"):
        read_labelled(tmp_path)


def test_boxes_outside_or_without_area_are_left_out_and_told(tmp_path: Path) -> None:
    image(tmp_path / "a.png")
    objects = [("ship", 5, 5, 9, 9), ("ship", 70, 5, 90, 9), ("ship", 9, 9, 9, 20), ("ship", 50, 30, 70, 34)]
    text(tmp_path / "a.xml", xml([(name, *map(float, corners)) for name, *corners in objects]))  # type: ignore[misc]
    found = read_labelled(tmp_path)
    assert boxes_of(found)["a"] == [("ship", 5, 5, 9, 9), ("ship", 50, 30, 60, 34)]
    assert found.notes == ("Boxes left out, without area inside their image: 2, the first in a.xml.",)


def test_labels_of_an_image_of_another_size_are_refused(tmp_path: Path) -> None:
    folder = voc(tmp_path)
    image(folder / "00002.png", (80, 120))
    with pytest.raises(OptionError, match="labels of an image of 80 x 120 px, got 40 x 60 px"):
        read_labelled(folder)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda folder: image(folder / "a.png"), "labels as VOC .* got none beside the images"),
        (
            lambda folder: text(image(folder / "a.png").with_name("b.xml"), xml([])),
            "got none that is named as one of",
        ),
        (lambda folder: folder, "a folder of images, got no image in it"),
    ],
)
def test_a_folder_without_labelled_images_is_refused(
    make: Callable[[Path], object], sentence: str, tmp_path: Path
) -> None:
    make(tmp_path)
    with pytest.raises((OptionError, ImageError), match=sentence):
        read_labelled(tmp_path)


def test_a_missing_folder_or_file_of_labels_is_refused(tmp_path: Path) -> None:
    folder = voc(tmp_path)
    with pytest.raises(BeersError, match="no such folder"):
        read_labelled(tmp_path / "none", folder)
    with pytest.raises(OptionError, match="got no such folder"):
        read_labelled(folder, tmp_path / "none")
    with pytest.raises(OptionError, match="got another file"):
        read_labelled(folder, folder / "00001.xml")
    coco(folder)
    text(folder / "more.json", "{}")
    for path in folder.glob("*.xml"):
        path.unlink()
    with pytest.raises(OptionError, match="one file of labels, got 2; name it: --labels"):
        read_labelled(folder)
