"""Tests that synthetic scenes have exact boxes, realistic sizes, and depend on the seed alone."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from beers_deploy.model.simulator.procedural import turn
from beers_deploy.studies.detection.boxes import Boxes
from benchmarks.detector.objects import Part, aircraft, ship, tank, vehicle
from benchmarks.detector.scenes import (
    CLASSES,
    SCENE_GSD_M,
    Canvas,
    Plot,
    synthetic_scene,
)

SHAPES: list[Callable[[np.random.Generator], list[Part]]] = [
    vehicle,
    ship,
    aircraft,
    lambda g: tank(9.0, g),
]
Scene = tuple[np.ndarray, Boxes]
LONGEST_M = {"vehicle": 14.2, "ship": 71, "aircraft": 46, "tank": 31}


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [synthetic_scene(np.random.default_rng(seed), 600, 701) for seed in range(12)]


def unlimited(canvas: Canvas) -> Plot:
    """Return a plot of unlimited size."""
    return Plot(canvas, turn(0, 0, 0), math.inf)


@settings(max_examples=40)
@given(st.sampled_from(range(4)), st.floats(0, math.tau), st.integers(0, 2**32))
def test_a_box_is_the_pixels_that_the_object_changed(kind: int, angle: float, seed: int) -> None:
    canvas = Canvas(400, 420, np.random.default_rng(seed))
    before = np.array(canvas._image)
    assert unlimited(canvas).put(kind, SHAPES[kind](canvas.generator), 1.3, -2.1, angle, 0.0)
    rows, columns = np.nonzero(np.array(canvas._image) != before)
    assert canvas.corners == [(columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)]


def test_no_object_is_put_across_a_border_or_on_another_object() -> None:
    canvas = Canvas(400, 400, np.random.default_rng(0))
    parts = tank(9.0, canvas.generator)
    assert unlimited(canvas).put(3, parts, 0, 0, 0, 3.0)
    assert not unlimited(canvas).put(3, parts, 18.2, 0, 0, 3.0)
    assert not unlimited(canvas).put(3, parts, 45, 0, 0, 3.0)
    assert not Plot(canvas, turn(25, 0, 0), 8.0).put(3, parts, 0, 0, 0, 3.0)
    assert len(canvas.corners) == len(canvas.classes) == 1


def test_every_object_is_inside_and_has_the_size_of_its_kind(scenes: list[Scene]) -> None:
    for radiance, truth in scenes:
        assert radiance.shape == (600, 701)
        assert radiance.dtype == np.float32
        assert radiance.min() > 0
        assert radiance.max() < 500
        assert (truth.corners[:, :2] >= 0).all()
        assert (truth.corners[:, 2:] <= (701, 600)).all()
        sides_m = (truth.corners[:, 2:] - truth.corners[:, :2]) * SCENE_GSD_M
        assert (sides_m.max(1) >= 1.5).all()
        for kind, name in enumerate(CLASSES):
            assert (
                sides_m[truth.classes == kind].max(initial=0) <= LONGEST_M[name] + 2 * SCENE_GSD_M
            )
    assert np.all(
        sum(np.bincount(truth.classes, minlength=len(CLASSES)) for _, truth in scenes) >= 10
    )


def test_the_seed_decides_all() -> None:
    first, repeat, other = (
        synthetic_scene(np.random.default_rng(seed), 300, 300) for seed in (4, 4, 5)
    )
    assert_array_equal(first[0], repeat[0])
    assert_array_equal(first[1].corners, repeat[1].corners)
    assert first[0].tobytes() != other[0].tobytes()
