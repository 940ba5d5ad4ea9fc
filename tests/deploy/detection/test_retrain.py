"""Detectors trained for each row: what of them is kept, and the rows that follow."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deploy.cache import Cache
from deploy.detection import retrain
from deploy.detection.classes import class_map
from deploy.detection.retrain import SEEDS, TABLE, Retraining, conditions, picture_from, retrained_rows
from deploy.detection.rows import GAIN, REGAINED, paper_rows
from deploy.detection.study import REFERENCE, Sensors, View
from deploy.detection.subjects import drawn_subject
from deploy.networks import silent
from model.detection.network import DetectorNetwork
from model.detection.pictures import Picture
from model.detection.scenes import CLASSES
from model.detection.training import DetectorRecipe, train_detector
from model.simulator.detector import Draw
from profiles import load_sensor
from profiles.sensor_file import reference_for

pytestmark = pytest.mark.slow

KNOWN = class_map(CLASSES, CLASSES)


def pair(name: str) -> Sensors:
    degraded = load_sensor(name)
    return Sensors(degraded, reference_for(degraded))


BOTH = [pair("dior-medium"), pair("dior-high")]


def test_the_rows_are_those_of_the_paper() -> None:
    rows = conditions(BOTH, "traditional-fast", silent)
    assert [(row.restorer, row.sensors.degraded.name) for row in rows] == [
        (REFERENCE, "dior-medium"),
        ("degraded", "dior-medium"),
        ("traditional-fast", "dior-medium"),
        ("degraded", "dior-high"),
        ("traditional-fast", "dior-high"),
    ]
    assert len(rows) == len(paper_rows())


def scored(*ap50: list[float]) -> list[list[dict[str, float]]]:
    return [[{"ap50": one, "ap": one / 2, "own precision": 0.9, "own recall": 0.7} for one in each] for each in ap50]


def test_means_and_spreads_are_over_seeds() -> None:
    found = conditions(BOTH[:1], "traditional-fast", silent)
    each = scored([0.8, 0.82, 0.84], [0.5, 0.6, 0.55], [0.7, 0.75, 0.65])
    rows = retrained_rows(found, {one.name: figures for one, figures in zip(found, each, strict=True)})
    assert {row.table for row in rows} == {TABLE}
    assert rows[0].figures["mAP50"].value == pytest.approx(82)
    assert rows[0].figures["mAP50"].interval == pytest.approx((80, 84))
    assert rows[2].figures[GAIN].value == pytest.approx(15)
    assert rows[2].figures[GAIN].interval == pytest.approx((10, 20))
    assert rows[2].figures[REGAINED].value == pytest.approx(100 * 15 / 27)
    assert GAIN not in rows[1].figures


def test_no_share_is_stated_of_a_loss_within_the_spread() -> None:
    found = conditions(BOTH[:1], "traditional-fast", silent)
    each = scored([0.8, 0.82, 0.84], [0.79, 0.805, 0.7], [0.7, 0.75, 0.65])
    row = retrained_rows(found, {one.name: figures for one, figures in zip(found, each, strict=True)})[2]
    assert "seeds" in row.figures[REGAINED].reason


def test_pictures_of_training_are_what_the_detector_is_shown() -> None:
    view = View(drawn_subject(0, 0, KNOWN), BOTH[0], Draw(0))
    picture = picture_from(view, None)
    np.testing.assert_array_equal(picture.image, np.rint(255 * view.shown(None).transpose(2, 0, 1)))
    np.testing.assert_allclose(picture.corners, view.subject.truth.corners / 3)


def test_what_is_trained_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[tuple[int, int]] = []

    def counted(
        pictures: Sequence[Picture], classes: int, recipe: DetectorRecipe, tick: Callable[[float], None]
    ) -> DetectorNetwork:
        trained.append((recipe.seed, len(pictures)))
        return train_detector(pictures, classes, recipe, tick)

    monkeypatch.setattr(retrain, "train_detector", counted)
    recipe = DetectorRecipe(steps=2, batch=1)
    subjects = [drawn_subject(number, 0, KNOWN) for number in range(2)]
    rows = conditions(BOTH[:1], "traditional-fast", silent)[1:2]
    first = Retraining(rows, subjects, 0, Cache(tmp_path), recipe, scenes=2)
    once = first.run()
    assert trained == [(seed, 2) for _ in rows for seed in range(SEEDS)]
    first.file(rows[0], 2).unlink()
    assert replace(first).run() == once
    assert trained[SEEDS:] == [(2, 2)]


def test_scenes_of_training_are_none_of_the_study() -> None:
    seen = {
        drawn_subject(number, 0, KNOWN).digest for number in (*range(2), *range(retrain.FIRST, retrain.FIRST + 2))
    }
    assert len(seen) == 4
    one, other = (drawn_subject(number, 0, KNOWN) for number in (0, retrain.FIRST))
    assert one.truth.corners.shape != other.truth.corners.shape or not np.array_equal(
        one.truth.corners, other.truth.corners
    )
