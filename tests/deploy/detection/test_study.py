"""A study with a detector that finds what is bright: where its boxes lie, what is kept, and what follows of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from deploy.cache import Cache
from deploy.detection.boxes import Boxes, iou
from deploy.detection.detectors import Detector
from deploy.detection.differences import differences
from deploy.detection.page import CROP_PX, ZOOM, Window, crops, curves, marks_of
from deploy.detection.rows import GAIN, LOSS, NO_LOSS, REGAINED, detection_rows, headline, main_table
from deploy.detection.study import REFERENCE, Comparison, Sensors, Study, View, network_digest, rows_of
from deploy.detection.subjects import Subject
from deploy.methods import method_named
from deploy.networks import silent
from model.shipped import shipped_weights
from model.simulator.detector import Draw
from profiles import load_sensor
from profiles.constant import Constant
from profiles.figures import Row
from profiles.sensor_file import reference_for

GROUND, SHIP = 20.0, 250.0
"""Radiances in W/m2/sr/um."""


def sensors(name: str = "dior-medium", ratio: int = 3) -> Sensors:
    degraded = replace(load_sensor(name), oversampling=Constant(ratio, "assumed", "a test"))
    return Sensors(degraded, reference_for(degraded))


def subject(
    corners: list[tuple[int, int, int, int]], height: int = 150, width: int = 210, name: str = "a", kind: int = 0
) -> Subject:
    radiance = torch.full((height, width), GROUND)
    for x1, y1, x2, y2 in corners:
        radiance[y1:y2, x1:x2] = SHIP
    truth = Boxes.of(np.array(corners, float), np.full(len(corners), kind))
    return Subject(name, name, truth, f"{name} {corners}", None, lambda _: radiance)


class Bright:
    """Answers with the box around what is bright in its input, in the raw layout, and counts how often."""

    def __init__(self, size_px: int = 96, fails_after: int = 10**9) -> None:
        self.calls, self._fails_after = 0, fails_after
        self.detector = Detector(("ship", "tank"), size_px, "raw", None, self.run)

    def run(self, image: np.ndarray) -> np.ndarray:
        if self.calls == self._fails_after:
            raise KeyboardInterrupt
        self.calls += 1
        rows, columns = np.nonzero(image[0, 0] > 0.75)
        answer = np.zeros((1, 6, 1), np.float32)
        if len(rows):
            left, top, right, bottom = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
            answer[0, :5, 0] = (left + right) / 2, (top + bottom) / 2, right - left, bottom - top, 0.9
        return answer


def study(folder: Path, subjects: list[Subject], bright: Bright | None = None) -> Study:
    file = folder / "detector.onnx"
    file.write_bytes(b"a detector")
    return Study((bright or Bright()).detector, file, subjects, 0, Cache(folder / "cache"))


@pytest.mark.parametrize("ratio", [2, 3, 4])
@pytest.mark.parametrize("corners", [(24, 36, 84, 72), (60, 12, 96, 120), (131, 85, 190, 133)])
def test_boxes_come_back_to_where_the_object_lies(
    ratio: int, corners: tuple[int, int, int, int], tmp_path: Path
) -> None:
    one = subject([corners], height=149, width=211)
    found = study(tmp_path, [one], Bright(size_px=128)).look(sensors(ratio=ratio), {REFERENCE: None})[REFERENCE][0]
    assert iou(found.corners, one.truth.corners)[0, 0] > 0.75
    middle = (found.corners[0, :2] + found.corners[0, 2:]) / 2
    np.testing.assert_allclose(middle, (np.array(corners[:2]) + corners[2:]) / 2, atol=0.6 * ratio)


def test_all_rows_are_shown_under_the_stretch_of_the_reference() -> None:
    view = View(subject([(60, 60, 110, 100)]), sensors("dior-high"), Draw(0))
    assert view.degraded.shape == view.reference.shape == (50, 70)
    np.testing.assert_array_equal(view.shown(None), view.display.to_srgb(view.reference))
    assert view.display.black == pytest.approx(np.percentile(view.reference, 0.5))


def test_a_study_that_was_stopped_goes_on_and_finds_the_same(tmp_path: Path) -> None:
    scenes = [subject([(30 + 9 * k, 30, 90 + 9 * k, 80)], name=str(k)) for k in range(4)]
    for folder in (tmp_path / "whole", tmp_path / "stopped"):
        folder.mkdir()
    rows = rows_of(sensors(), ["degraded"], silent)
    whole = study(tmp_path / "whole", scenes).compare(sensors(), rows)
    with pytest.raises(KeyboardInterrupt):
        study(tmp_path / "stopped", scenes, Bright(fails_after=5)).compare(sensors(), rows)
    rest = Bright()
    again = study(tmp_path / "stopped", scenes, rest).compare(sensors(), rows)
    assert rest.calls == 2 * len(scenes) - 5
    assert detection_rows(again) == detection_rows(whole)
    none = Bright()
    study(tmp_path / "stopped", scenes, none).compare(sensors(), rows)
    assert none.calls == 0


@pytest.mark.parametrize("change", ["seed", "sensor", "detector", "scene", "size"])
def test_what_was_found_otherwise_is_not_taken(change: str, tmp_path: Path) -> None:
    scenes, seen = [subject([(30, 30, 90, 80)])], sensors()
    first = study(tmp_path, scenes)
    first.look(seen, {REFERENCE: None})
    bright = Bright(size_px=64 if change == "size" else 96)
    other = replace(first, detector=bright.detector, seed=1 if change == "seed" else 0)
    if change == "detector":
        other.file.write_bytes(b"another")
    if change == "scene":
        other = replace(other, subjects=[subject([(30, 30, 90, 81)])])
    other.look(sensors("dior-high") if change == "sensor" else seen, {REFERENCE: None})
    assert bright.calls == 1


def test_a_network_is_named_by_its_bytes(tmp_path: Path) -> None:
    degraded = load_sensor("pleiades-degraded")
    assert network_digest("degraded", degraded) == network_digest("traditional-fast", degraded) == ""
    plain, blind = (network_digest(name, degraded) for name in ("convbeers-xs-int8", "convbeers-xs-int8@blind"))
    assert len({plain, blind, network_digest(str(shipped_weights("convbeers-xs")), degraded)}) == 3
    assert "" not in (plain, blind)
    own = tmp_path / "own.onnx"
    own.write_bytes(b"one")
    before = network_digest(str(own), degraded)
    own.write_bytes(b"two")
    assert network_digest(str(own), degraded) != before


def handmade(folder: Path, sites: int = 12, tanks: int = 0, **found: int) -> Comparison:
    """Sites of one object each, ships and at last `tanks`, of which each row finds so many, and all surely."""
    scenes = [subject([(30, 30, 90, 80)], name=str(k), kind=int(k >= sites - tanks)) for k in range(sites)]
    made, seen = study(folder, scenes), sensors("dior-high")
    methods = {name: method_named(name, seen.degraded, seen.reference) for name in found if name != REFERENCE}
    boxes = {
        name: [
            Boxes.of(each.truth.corners, each.truth.classes, [0.9]) if k < count else Boxes.none()
            for k, each in enumerate(scenes)
        ]
        for name, count in found.items()
    }
    matched = {name: made.match(each) for name, each in boxes.items()}
    scored = differences(matched, np.random.default_rng(0))
    return Comparison(seen, {REFERENCE: None, **methods}, made.views(seen), boxes, matched, scored)


def figures(found: Comparison, table: str) -> dict[str, Row]:
    return {row.name: row for row in detection_rows(found) if row.table == table}


def test_a_loss_and_what_is_regained_of_it(tmp_path: Path) -> None:
    found = handmade(tmp_path, reference=12, degraded=3, traditional=9)
    rows = figures(found, main_table("dior-high"))
    assert list(rows) == [REFERENCE, "degraded", "traditional"]
    ap = {name: row.figures["mAP50"].value for name, row in rows.items()}
    assert ap == pytest.approx({"reference": 100, "degraded": 100 * 26 / 101, "traditional": 100 * 76 / 101})
    last = rows["traditional"]
    assert last.figures[GAIN].value == pytest.approx(5000 / 101)
    assert last.figures[GAIN].unit == "points"
    assert last.figures[REGAINED].value == pytest.approx(100 * 50 / 75)
    assert last.text["against degraded"] == "a gain"
    assert "a gain" in headline([found])
    assert LOSS not in rows[REFERENCE].figures
    assert GAIN not in rows["degraded"].figures


def test_a_restoration_that_loses_is_said_to(tmp_path: Path) -> None:
    row = figures(handmade(tmp_path, reference=12, degraded=9, traditional=3), main_table("dior-high"))["traditional"]
    assert row.text["against degraded"] == "a loss"


def test_without_a_loss_no_share_of_it_is_stated(tmp_path: Path) -> None:
    found = handmade(tmp_path, reference=12, degraded=12, traditional=12)
    rows = figures(found, main_table("dior-high"))
    assert rows["degraded"].figures[LOSS].interval == (0.0, 0.0)
    assert rows["traditional"].figures[REGAINED].reason == NO_LOSS
    assert rows["traditional"].text["against degraded"].startswith("no difference")
    assert "no difference" in headline([found])


@pytest.mark.parametrize("sites", [1, 4])
def test_a_few_sites_bear_no_interval_and_no_verdict(sites: int, tmp_path: Path) -> None:
    row = figures(handmade(tmp_path, sites, reference=sites, degraded=0, traditional=sites), main_table("dior-high"))
    assert all(figure.interval is None for each in row.values() for figure in each.figures.values())
    assert row["traditional"].text["against degraded"].startswith("not known")
    assert f"of {sites}, fewer than 5" in row["traditional"].figures[REGAINED].reason


def test_every_figure_of_a_row_is_measured_or_says_why_not(tmp_path: Path) -> None:
    found = handmade(tmp_path, reference=12, degraded=3, traditional=9)
    assert {row.table for row in detection_rows(found)} == {
        main_table("dior-high"),
        "each at its own best confidence, dior-high",
        "mAP50 by class, dior-high",
        "mAP50 by size, dior-high",
    }
    for row in detection_rows(found):
        for name, figure in row.figures.items():
            assert (figure.mode == "measured" and figure.source) or figure.reason, name
    assert set(figures(found, "mAP50 by class, dior-high")[REFERENCE].figures) == {"ship"}  # no tank is labelled
    by_size = figures(found, "mAP50 by size, dior-high")["degraded"].figures
    assert {size: figure.mode for size, figure in by_size.items()} == {
        "under 16 px": "unavailable",
        "16 to 32 px": "unavailable",
        "32 px up": "measured",
    }


def test_marks_are_the_detections_of_each_object() -> None:
    truth = Boxes.of([[0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10]], [0, 0, 1])
    boxes = Boxes.of(
        [[1, 0, 11, 10], [0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10], [20, 0, 30, 10]],
        [0, 0, 1, 1, 0],
        [0.5, 0.9, 0.9, 0.8, 0.1],
    )
    marks = marks_of(truth, boxes, 0.3)
    assert marks.hits.tolist() == [False, True, False, True, False]  # doubled, found, another class, found, unsure
    assert marks.found.tolist() == [True, False, True]
    assert marks.counted.tolist() == [True, True, True, True, False]


def test_a_window_shows_a_box_where_its_pixels_are() -> None:
    rgb = np.zeros((CROP_PX + 20, CROP_PX + 30, 3), np.float32)
    rgb[30:40, 50:60] = 1
    window = Window(5, 9, 3)
    crop = window.crop(rgb)
    ((x1, y1, x2, y2),) = window.enlarged(np.array([[150.0, 90, 180, 120]])) / ZOOM
    assert crop[int(y1) : int(y2), int(x1) : int(x2)].min() == 255
    assert int((crop > 0).sum()) == 3 * 100
    assert Window(60, 60, 1).crop(rgb).shape == (CROP_PX, CROP_PX, 3)


def test_pictures_and_curves_are_drawn(tmp_path: Path) -> None:
    found = handmade(tmp_path, reference=12, degraded=3)
    pictures = [curves([found]), *crops([found])]
    assert [picture.source.split(";")[0] for picture in pictures] == ["data:image/svg+xml", *["data:image/png"] * 4]
    assert all(picture.caption for picture in pictures)


def test_classes_take_turns_in_pictures_and_no_scene_is_shown_twice(tmp_path: Path) -> None:
    """Ships 0 to 8 and tanks 9 to 11, of which degraded images lose all from 3 on: shown are what is lost."""
    found = handmade(tmp_path, tanks=3, reference=12, degraded=3)
    titles = [picture.title for picture in crops([found])]
    assert titles == [f"{scene}: what is found" for scene in ("3, ship", "9, tank", "4, ship", "10, tank")]
