"""Tests of a study whose detector finds bright objects: its boxes, its figures and its pictures."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.model.io.pictures import stretch_of
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.studies.detection import average_precision
from beers_deploy.studies.detection.average_precision import score_rows, site_weights
from beers_deploy.studies.detection.boxes import Boxes, iou
from beers_deploy.studies.detection.detector import Detector
from beers_deploy.studies.detection.matching import find_hits
from beers_deploy.studies.detection.page import crops
from beers_deploy.studies.detection.study import (
    REFERENCE,
    AcquiredScene,
    Comparison,
    LabelledScene,
    SensorPair,
    acquired,
)
from beers_deploy.studies.detection.tables import (
    GAIN,
    LOSS,
    NO_LOSS,
    REGAINED,
    detection_rows,
    headline,
)
from beers_deploy.studies.evaluation.methods import Method

GROUND = 20.0
SHIP = 250.0
"""Radiances in W/m2/sr/um."""
NAMES = ("ship", "tank")


def sensors(name: str = "dior-medium", ratio: int = 3) -> SensorPair:
    degraded = replace(Sensor.load(name), oversampling=Constant(ratio, "assumed", "a test"))
    return SensorPair(degraded, degraded.reference)


def scene(
    corners: tuple[int, int, int, int], height: int = 150, width: int = 210, name: str = "a"
) -> LabelledScene:
    x1, y1, x2, y2 = corners
    radiance = np.full((height, width), GROUND, np.float32)
    radiance[y1:y2, x1:x2] = SHIP
    return LabelledScene(name, name, Boxes.of([corners], [0]), None, lambda _: radiance)


def bright(image: np.ndarray) -> np.ndarray:
    """Return the box around the bright pixels of an input, in the raw layout."""
    places = np.argwhere(image[0, 0] > 0.75)[:, ::-1]
    answer = np.zeros((1, 6, 21), np.float32)
    low = places.min(0)
    high = places.max(0) + 1
    answer[0, :5, 0] = (*(low + high) / 2, *high - low, 0.9)
    return answer


@pytest.mark.parametrize("ratio", [2, 3, 4])
@pytest.mark.parametrize("corners", [(24, 36, 84, 72), (60, 12, 96, 120), (131, 85, 190, 133)])
def test_boxes_are_mapped_back_to_the_object(
    ratio: int, corners: tuple[int, int, int, int]
) -> None:
    acquisition = AcquiredScene(scene(corners, 149, 211), sensors(ratio=ratio), Draw(0))
    boxes = acquisition.boxes(Detector(NAMES, 128, "", bright), None)
    assert iou(boxes.corners, np.array([corners], float))[0, 0] > 0.75
    middle = (boxes.corners[0, :2] + boxes.corners[0, 2:]) / 2
    assert_allclose(middle, (np.array(corners[:2]) + corners[2:]) / 2, atol=0.6 * ratio)


def test_all_rows_are_shown_under_the_stretch_of_the_reference() -> None:
    acquisition = AcquiredScene(scene((60, 60, 110, 100)), sensors("dior-high"), Draw(0))
    assert acquisition.degraded.shape == acquisition.reference.shape == (50, 70)
    stretch = stretch_of(acquisition.reference)
    for dn, method in (
        (acquisition.reference, None),
        (acquisition.degraded, Method("degraded", lambda dn: dn, "known")),
    ):
        assert_array_equal(acquisition.shown(method), stretch.to_srgb(dn))


@pytest.fixture(autouse=True, scope="module")
def few_draws() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(average_precision, "DRAWS", 200)
        yield


@cache
def handmade(sites: int = 12, **counts: int) -> Comparison:
    """Return a comparison on sites of one ship each, of which each row finds `counts[row]`.

    Every detection has the highest confidence.
    """
    scenes = [scene((30, 30, 90, 80), name=str(number)) for number in range(sites)]
    pair = sensors("dior-high")
    truths = [item.truth for item in scenes]
    boxes = {
        row: [truth if k < count else Boxes.of([], []) for k, truth in enumerate(truths)]
        for row, count in counts.items()
    }
    hits = {row: find_hits(truths, detected, len(NAMES)) for row, detected in boxes.items()}
    weights = site_weights([item.site for item in scenes], 0)
    figures, confidence = score_rows(hits, NAMES, weights)
    methods = {
        row: None if row == REFERENCE else Method(row, lambda dn: dn, "known") for row in counts
    }
    return Comparison(
        pair, methods, list(acquired(scenes, pair, 0)), boxes, hits, figures, confidence, NAMES
    )


def rows_of(comparison: Comparison, table: str = "detection, dior-high") -> dict[str, Row]:
    return {row.name: row for row in detection_rows(comparison) if row.table == table}


def test_a_loss_and_the_share_of_it_that_is_regained() -> None:
    comparison = handmade(reference=12, degraded=3, traditional=9)
    rows = rows_of(comparison)
    ap = {name: row.figures["mAP50"].value for name, row in rows.items()}
    # Precision is averaged at 101 recalls: 3 of 12 ships reach the first 26 of them, 9 of 12 the
    # first 76.
    assert ap == pytest.approx(
        {"reference": 100, "degraded": 100 * 26 / 101, "traditional": 100 * 76 / 101}
    )
    traditional = rows["traditional"]
    assert traditional.figures[GAIN].value == pytest.approx(5000 / 101)
    assert traditional.figures[REGAINED].value == pytest.approx(100 * 50 / 75)
    assert traditional.text["against degraded"] == "a gain"
    assert "a gain" in headline([comparison])
    assert LOSS not in rows[REFERENCE].figures
    assert GAIN not in rows["degraded"].figures
    worse = rows_of(handmade(reference=12, degraded=9, traditional=3))["traditional"]
    assert worse.text["against degraded"] == "a loss"


def test_without_a_loss_or_without_sites_no_share_of_it_is_stated() -> None:
    rows = rows_of(handmade(reference=12, degraded=12, traditional=12))
    assert rows["degraded"].figures[LOSS].interval == (0.0, 0.0)
    assert rows["traditional"].figures[REGAINED].reason == NO_LOSS
    assert rows["traditional"].text["against degraded"].startswith("no difference")
    row = rows_of(handmade(4, reference=4, degraded=0, traditional=4))["traditional"]
    assert all(figure.interval is None for figure in row.figures.values())
    assert row.text["against degraded"].startswith("not known")
    assert "of 4, fewer than 5" in row.figures[REGAINED].reason


def test_classes_and_sizes_without_an_object_have_no_figure() -> None:
    comparison = handmade(reference=12, degraded=3, traditional=9)
    by_class = rows_of(comparison, "mAP50 by class, dior-high")[REFERENCE].figures
    assert set(by_class) == {"ship"}, "no tank is labelled"
    by_size = rows_of(comparison, "mAP50 by size, dior-high")["degraded"].figures.values()
    assert [figure.value is None for figure in by_size] == [True, True, False]


def test_pictures_show_the_scenes_that_lose_most() -> None:
    pictures = crops([handmade(reference=12, degraded=3)])
    assert {picture.source.split(";")[0] for picture in pictures} == {"data:image/png"}
    assert [picture.title[0] for picture in pictures] == ["3", "4", "5", "6"]
