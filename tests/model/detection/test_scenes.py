"""Drawn scenes: the boxes are the objects' own pixels, the sizes are those of real ones, the seed decides all."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.detection.canvas import SCENE_GSD_M, Canvas
from model.detection.objects import CLASSES, Part, aircraft, ship, tank, vehicle
from model.detection.scenes import LabelledScene, labelled_scene
from model.simulator.drawing import turn

SHAPES: list[Callable[[np.random.Generator], list[Part]]] = [vehicle, ship, aircraft, lambda g: tank(9.0, g)]
LONGEST_M = {"vehicle": 14.2, "ship": 71, "aircraft": 46, "tank": 31}


@pytest.fixture(scope="module")
def scenes() -> list[LabelledScene]:
    return [labelled_scene(np.random.default_rng(seed), 600, 701) for seed in range(12)]


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(range(4)), st.floats(0, math.tau), st.integers(0, 2**32))
def test_a_box_is_the_pixels_that_the_object_changed(kind: int, angle: float, seed: int) -> None:
    canvas = Canvas(400, 420, np.random.default_rng(seed))
    before = np.array(canvas._image)
    placed = canvas.put(kind, SHAPES[kind](canvas.generator), turn(1.3, -2.1, angle), 0.0)
    assert placed
    rows, columns = np.nonzero(np.array(canvas._image) != before)
    assert canvas.corners == [(columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)]


def test_nothing_is_put_over_the_border_or_on_another_object() -> None:
    canvas = Canvas(400, 400, np.random.default_rng(0))
    parts = tank(9.0, canvas.generator)
    assert canvas.put(3, parts, turn(0, 0, 0), 3.0)
    assert not canvas.put(3, parts, turn(18.2, 0, 0), 3.0)
    assert not canvas.put(3, parts, turn(45, 0, 0), 3.0)
    assert len(canvas.corners) == len(canvas.classes) == 1


def test_a_tree_does_not_cover_an_object() -> None:
    canvas = Canvas(400, 400, np.random.default_rng(0))
    canvas.put(3, tank(9.0, canvas.generator), turn(0, 0, 0), 3.0)
    before = np.array(canvas._image)
    canvas.tree((7.0, 7.0), 3.0)
    np.testing.assert_array_equal(np.array(canvas._image), before)
    canvas.tree((30.0, 30.0), 3.0)
    assert (np.array(canvas._image) != before).any()


def test_every_object_lies_within_and_has_the_size_of_its_kind(scenes: list[LabelledScene]) -> None:
    for scene in scenes:
        assert scene.corners.dtype == np.float64
        assert scene.corners.shape == (len(scene.classes), 4)
        assert (scene.corners[:, :2] >= 0).all()
        assert (scene.corners[:, 2:] <= (701, 600)).all()
        sides_m = (scene.corners[:, 2:] - scene.corners[:, :2]) * SCENE_GSD_M
        assert (sides_m.max(1) >= 1.5).all()
        for kind, name in enumerate(CLASSES):
            assert sides_m[scene.classes == kind].max(initial=0) <= LONGEST_M[name] + 2 * SCENE_GSD_M


def test_all_kinds_come_and_differ_from_the_ground(scenes: list[LabelledScene]) -> None:
    counts = sum(np.bincount(scene.classes, minlength=len(CLASSES)) for scene in scenes)
    assert np.all(np.array(counts) >= 10)
    for scene in scenes:
        assert scene.radiance.shape == (600, 701)
        assert scene.radiance.dtype == np.float32
        assert scene.radiance.min() > 0
        assert scene.radiance.max() < 500


def test_the_seed_decides_all() -> None:
    one, same, other = (labelled_scene(np.random.default_rng(seed), 300, 300) for seed in (4, 4, 5))
    np.testing.assert_array_equal(one.radiance, same.radiance)
    np.testing.assert_array_equal(one.corners, same.corners)
    assert one.radiance.tobytes() != other.radiance.tobytes()
