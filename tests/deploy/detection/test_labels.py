"""Faults of single files of labels: a sentence each, whatever stands in them."""

import json
import sys
from pathlib import Path

import pytest

from deploy.detection.annotations import read_labelled
from deploy.detection.text_labels import yolo_names
from deploy.detection.voc import read_voc
from profiles.errors import MachineError, OptionError
from tests.deploy.detection.folders import coco, dota, image, text, voc, xml, yolo

SHIP = xml([("ship", 2, 3, 12, 9)])
LAUGHS = '<?xml version="1.0"?><!DOCTYPE lolz [<!ENTITY a "ha">' + "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefghi", "bcdefghij", strict=True)
)


def refused(folder: Path, sentence: str) -> None:
    with pytest.raises(OptionError, match=sentence) as error:
        read_labelled(folder)
    assert str(error.value).isprintable()
    assert len(str(error.value)) < 500 + len(str(folder))


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (LAUGHS + "]><annotation>&j;</annotation>", "XML without a document type"),
        (SHIP.replace("<annotation>", '<!DOCTYPE a SYSTEM "file:///etc/passwd"><annotation>', 1), "a document type"),
        (SHIP.replace("<xmin>3</xmin>", ""), "a 'ship' without xmin"),
        (SHIP.replace("<ymax>9</ymax>", "<ymax></ymax>"), "numbers as corners of a 'ship'"),
        (SHIP.replace("<xmax>12", "<xmax>nan"), "numbers as corners of a 'ship', got '3 4 nan 9'"),
        (SHIP.replace("<xmax>12", "<xmax>1e999"), "numbers as corners"),
        (SHIP.replace("<xmax>12", "<xmax>twelve"), "numbers as corners"),
        (SHIP.replace("<name>ship</name>", "<name> </name>"), "a name for every object"),
        (SHIP.replace("<width>60", "<width>six"), "numbers as size"),
        (SHIP.replace("bndbox", "robndbox"), "upright boxes"),
        (SHIP[:-20], "expected XML"),
        ("", "expected XML"),
        ("<kml></kml>", "Pascal VOC, an 'annotation', got <kml>"),
        ("<annotation>" + "<a>" * 50 + "</a>" * 50 + "</annotation>", "at most 32 levels"),
        ('<?xml version="1.0" encoding="klingon"?>' + SHIP, "expected XML"),
    ],
)
def test_a_faulty_voc_file_is_refused_by_a_sentence(content: str, sentence: str, tmp_path: Path) -> None:
    image(tmp_path / "a.png")
    text(tmp_path / "a.xml", content)
    refused(tmp_path, sentence)


def test_entities_hide_in_no_encoding(tmp_path: Path) -> None:
    image(tmp_path / "a.png")
    (tmp_path / "a.xml").write_bytes((LAUGHS + "]><annotation>&j;</annotation>").encode("utf-16"))
    refused(tmp_path, "XML without a document type")


def test_a_huge_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    image(tmp_path / "a.png")
    with (tmp_path / "a.xml").open("wb") as stream:
        stream.truncate(1 << 40)
    refused(tmp_path, "more than 8388608 bytes")


def test_an_object_that_is_difficult_need_not_be_found(tmp_path: Path) -> None:
    path = text(tmp_path / "a.xml", SHIP.replace("<difficult>0", "<difficult>1"))
    assert [box.ignored for box in read_voc(tmp_path / "a.png", path).boxes] == [True]


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("0 0.5 0.5 0.1", "YOLO's 'class cx cy w h'"),
        ("0 0.5 0.5 0.1 0.1 0.9", "YOLO's 'class cx cy w h'"),
        ("0 30 20 10 10", "coordinates as shares of the image, 0 to 1"),
        ("2 0.5 0.5 0.1 0.1", "a class from 0 to 1, of which there is a name, got 2"),
        ("-1 0.5 0.5 0.1 0.1", "a class from 0 to 1"),
        ("0.5 0.5 0.5 0.1 0.1", "a class from 0 to 1"),
        ("ship 0.5 0.5 0.1 0.1", "numbers as class and coordinates"),
        ("0 nan 0.5 0.1 0.1", "numbers as class and coordinates"),
    ],
)
def test_a_faulty_yolo_line_is_refused_by_a_sentence(line: str, sentence: str, tmp_path: Path) -> None:
    folder = yolo(tmp_path)
    text(folder / "labels" / "val" / "00001.txt", line + "\n")
    refused(folder, sentence)


def test_an_outline_of_yolo_is_enclosed(tmp_path: Path) -> None:
    folder = yolo(tmp_path)
    text(folder / "labels" / "val" / "00001.txt", "1 0.5 0 0.75 0.5 0.5 1 0.25 0.5\n")
    assert read_labelled(folder).images[0].truth.corners.tolist() == [[15, 0, 45, 40]]


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("names: 5", "names: a list, or a table by number from 0"),
        ("names: {0: ship, 2: tank}", "names: a list, or a table"),
        ("names: [ship, no]", "names: a list, or a table"),
        ("names: [ship", "expected YAML"),
        ("names: !!python/object/apply:os.system [true]", "expected YAML"),
        ("a: &a [x, x]\nb: &b [*a, *a]\nnames: [*b, *b]", "names: a list, or a table"),
        ("path: here", "data.yaml or classes.txt with the names"),
        ("[" * 5000, "expected YAML"),
    ],
)
def test_a_faulty_table_of_names_is_refused_by_a_sentence(content: str, sentence: str, tmp_path: Path) -> None:
    folder = yolo(tmp_path)
    text(folder / "data.yaml", content)
    refused(folder, sentence)


def test_a_table_of_names_that_would_take_minutes_is_refused(tmp_path: Path) -> None:
    folder = yolo(tmp_path)
    text(folder / "data.yaml", "names: [" + "ab, " * 20000 + "]")
    refused(folder, "more than 65536 bytes")


def test_names_stand_in_a_list_a_table_or_lines(tmp_path: Path) -> None:
    text(tmp_path / "a" / "data.yaml", "names: [ship, tank]")
    text(tmp_path / "b" / "data.yml", "names: {1: tank, 0: ship}")
    text(tmp_path / "c" / "classes.txt", "ship\ntank\n")
    assert {yolo_names([tmp_path / name]) for name in "abc"} == {("ship", "tank")}
    assert yolo_names([tmp_path / "none", tmp_path / "c"]) == ("ship", "tank")


def test_without_pyyaml_it_is_said_how_to_do_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MachineError, match=r"beers-deploy\[detect\]', or write classes.txt"):
        read_labelled(yolo(tmp_path))


@pytest.mark.parametrize("line", ["1 2 3 4 5 6 7 ship 0", "a b c d e f g h ship 0", "1 2 3 4 5 6 7 8 ship 9"])
def test_a_faulty_dota_line_is_refused_by_a_sentence(line: str, tmp_path: Path) -> None:
    folder = dota(tmp_path)
    text(folder / "labelTxt" / "00002.txt", line + "\n")
    refused(folder, "DOTA's eight coordinates|numbers as coordinates")


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        ({"images": None}, "no list 'images'"),
        ({"annotations": [5]}, "no list 'annotations'"),
        ({"annotations": [{"image_id": 9, "category_id": 7, "bbox": [0, 0, 1, 1]}]}, "an entry that breaks it"),
        ({"annotations": [{"image_id": 0, "category_id": 99, "bbox": [0, 0, 1, 1]}]}, "an entry that breaks it"),
        ({"annotations": [{"image_id": 0, "category_id": 7, "bbox": [0, 0, 1]}]}, "an entry that breaks it"),
        ({"annotations": [{"image_id": 0, "category_id": 7, "bbox": [0, 0, "a", 1]}]}, "an entry that breaks it"),
        ({"annotations": [{"image_id": [], "category_id": 7, "bbox": [0, 0, 1, 1]}]}, "an entry that breaks it"),
        ({"categories": [{"id": 7, "name": 5}]}, "an entry that breaks it"),
        ({"images": [{"id": 0, "file_name": "../../etc/passwd"}]}, "its images in .* got none of 1"),
        ({"images": [{"id": 0, "file_name": "/etc/passwd"}]}, "its images in .* got none of 1"),
    ],
)
def test_a_faulty_coco_file_is_refused_by_a_sentence(
    damage: dict[str, object], sentence: str, tmp_path: Path
) -> None:
    path = coco(tmp_path) / "labels.json"
    content = json.loads(path.read_text()) | damage
    if damage.get("images"):
        content["annotations"] = []
    path.write_text(json.dumps(content))
    refused(tmp_path, sentence)


def test_other_json_is_refused_by_a_sentence(tmp_path: Path) -> None:
    path = coco(tmp_path) / "labels.json"
    for content, sentence in (("[1, 2]", "no list 'images'"), ("{", "COCO's JSON"), ("[NaN]", "COCO's JSON")):
        path.write_text(content)
        refused(tmp_path, sentence)


def test_what_the_folder_lacks_of_coco_is_left_out_and_told(tmp_path: Path) -> None:
    folder = coco(tmp_path)
    (folder / "00002.png").unlink()
    found = read_labelled(folder)
    assert [one.path.stem for one in found.images] == ["00001"]
    assert found.notes == ("1 of 2 images in labels.json are not in the folder.",)


def test_a_crowd_of_coco_need_not_be_found(tmp_path: Path) -> None:
    path = coco(tmp_path) / "labels.json"
    content = json.loads(path.read_text())
    content["annotations"][0]["iscrowd"] = 1
    path.write_text(json.dumps(content))
    found = read_labelled(tmp_path)
    assert sum(int(one.truth.ignored.sum()) for one in found.images) == 1
    assert "count neither way, difficult, a crowd or visible by less than 30 %: 1" in found.notes[0]


def test_a_byte_order_mark_is_no_fault(tmp_path: Path) -> None:
    folder = voc(tmp_path)
    path = folder / "00001.xml"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(read_labelled(folder).images[0].truth) == 2
