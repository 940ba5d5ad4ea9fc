"""Test that files of both layouts return their boxes in image coordinates, and that any other file
is refused in one sentence.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.studies.detection.detector import class_numbers, open_detector, parse_classes
from tests.deploy.studies.detection.networks import NAMES, detector, final, raw

IMAGE = np.full((32, 64, 3), 0.5, np.float32)
"""In an input of 64 px the image keeps its size, with 16 px of grey above and below."""
ONE = raw((1, 1, 1, 1, 0.5, 0))


def test_the_raw_layout_gives_the_boxes_of_every_class_that_scores(tmp_path: Path) -> None:
    answer = raw((20, 30, 10, 8, 0.9, 0.2), (21, 30, 10, 8, 0.8, 0.0), (50, 40, 6, 6, 0.0, 0.0005))
    boxes = open_detector(detector(tmp_path / "a.onnx", answer)).detect(IMAGE)
    assert boxes.corners.tolist() == [[15, 10, 25, 18], [15, 10, 25, 18]]
    assert boxes.classes.tolist() == [0, 1]
    assert not boxes.ignored.any()
    np.testing.assert_allclose(boxes.scores, [0.9, 0.2], atol=1e-6)


def test_the_final_layout_gives_its_rows_and_not_its_padding(tmp_path: Path) -> None:
    answer = final((15, 26, 25, 34, 0.2, 1), (15, 26, 25, 34, 0.9, 0), (16, 26, 26, 34, 0.6, 0))
    net = open_detector(detector(tmp_path / "a.onnx", answer, end2end=True))
    boxes = net.detect(IMAGE)
    assert boxes.corners.tolist() == [[15, 10, 25, 18], [16, 10, 26, 18], [15, 10, 25, 18]]
    assert boxes.classes.tolist() == [0, 0, 1]
    assert (net.names, net.size_px, net.flag) == (tuple(NAMES.values()), 64, "")


def test_suppression_inside_the_file_is_flagged_with_its_confidence(tmp_path: Path) -> None:
    answer = final((15, 26, 25, 34, 0.9, 0))
    flagged = open_detector(detector(tmp_path / "a.onnx", answer, cut=0.25, args={"nms": True}))
    assert "drops what lies below confidence 0.25" in flagged.flag
    assert len(flagged.detect(IMAGE)) == 1
    low = open_detector(detector(tmp_path / "b.onnx", answer, cut=0.001, args={"nms": True}))
    assert low.flag == ""


def test_the_size_is_the_file_s_or_the_one_asked_for(tmp_path: Path) -> None:
    fixed = detector(tmp_path / "a.onnx", ONE)
    free = detector(tmp_path / "b.onnx", ONE, size_px="side")
    assert [open_detector(fixed, side).size_px for side in (None, 64)] == [64, 64]
    assert [open_detector(free, side).size_px for side in (None, 128)] == [64, 128]
    with pytest.raises(OptionError, match=r"`side` must be 64 px, .*a.onnx .* 128 px"):
        open_detector(fixed, 128)
    sizes: list[object] = [None, [64, 96], [[], []], "wide"]
    for size in sizes:
        unsaid = detector(tmp_path / "c.onnx", ONE, size_px="side", imgsz=size)
        with pytest.raises(OptionError, match=r"a number of px, but c.onnx states .* Give `side`"):
            open_detector(unsaid)


@pytest.mark.parametrize(
    ("answer", "options", "sentence"),
    [
        (ONE, {"names": None}, "metadata of .* must have the names of its classes"),
        (ONE, {"names": "(" * 9000}, "the names of its classes"),
        (ONE, {"task": "segment"}, "task segment, "),
        (ONE, {"channels": 1}, r"for RGB, 1 x 6 x anchors .* has task detect, channels 1"),
        (ONE, {"outputs": 3}, r"output 1 x 6 x 20, 1 x 6 x 20, 1 x 6 x 20"),
        (
            np.zeros((1, 20, 7)),
            {},
            r"1 x 6 x anchors for 2 classes \(raw\) or 1 x N x 6 .* output 1 x 20 x 7",
        ),
        (np.zeros((4, 300, 6)), {}, "output 4 x 300 x 6"),
    ],
)
def test_another_layout_is_refused_with_the_values_that_were_read(
    answer: np.ndarray, options: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(ModelError, match=sentence):
        open_detector(detector(tmp_path / "a.onnx", answer, **options))


INVALID = [
    (raw((1, 1, 1, 1, 3.5, 0)), "scores outside 0 to 1"),
    (raw((1, 1, 1, 1, -3.5, 0)), "scores outside 0 to 1"),
    (final((1, 1, 2, 2, 0.5, 0.5)), "classes other than 0 to 1 in its sixth column"),
    (raw((np.nan, 1, 1, 1, 0.5, 0)), "returns NaN or infinity"),
    (np.zeros((1, 7, 20)), "the sizes that its file states, but it has 1 x 7 x 20"),
    (np.zeros(0), "the sizes that its file states, but it has 0"),
]


@pytest.mark.parametrize(("answer", "sentence"), INVALID)
def test_an_answer_that_is_no_detection_is_refused(
    answer: np.ndarray, sentence: str, tmp_path: Path
) -> None:
    layout = final() if answer.shape[-1:] == (6,) else raw()
    net = open_detector(detector(tmp_path / "a.onnx", layout))
    with pytest.raises(ModelError, match=sentence):
        net.decoded(answer)


def test_at_most_300_boxes_are_returned(tmp_path: Path) -> None:
    """The final layout is cut to 300. In the raw layout, suppression keeps at most 300 itself."""
    many = final(*[(1, 1, 2, 2, 0.5, 0)] * 400, count=400)
    assert len(open_detector(detector(tmp_path / "b.onnx", many)).decoded(many)) == 300


def test_a_class_is_matched_by_its_letters_or_by_the_users_mapping() -> None:
    labelled = ("car", "Storage-Tank", "minibus", "Tree")
    detector = ("ship", "vehicle", "storagetank")
    assert class_numbers(labelled, detector, {"car": "Vehicle"}).tolist() == [1, 2, -1, -1]
    mapping = parse_classes(" car = vehicle, Mini-Bus=vehicle ")
    assert class_numbers(("car", "minibus"), ("vehicle",), mapping).tolist() == [0, 0]


@pytest.mark.parametrize("text", ["", "car=", "car=a=b", "car=a,CAR=b", "-=ship"])
def test_another_text_is_refused(text: str) -> None:
    with pytest.raises(OptionError, match="`classes` must be LABELLED=DETECTOR"):
        parse_classes(text)


@pytest.mark.parametrize(
    ("labelled", "detector", "mapping", "sentence"),
    [
        (
            ("Tree",),
            ("ship", "tank"),
            {},
            r"\(Tree\) .* in common with the detector \(ship, tank\)",
        ),
        (("car",), ("ship",), {"van": "ship"}, r"'van' in `classes` is not one of the classes car"),
        (("car",), ("ship",), {"car": "boat"}, r"'boat' in `classes` is not one of .* ship"),
        (("ship",), ("Ship", "ship"), {}, "two have the same letters"),
    ],
)
def test_classes_that_cannot_be_matched_are_refused(
    labelled: tuple[str, ...], detector: tuple[str, ...], mapping: dict[str, str], sentence: str
) -> None:
    with pytest.raises(OptionError, match=sentence):
        class_numbers(labelled, detector, mapping)
