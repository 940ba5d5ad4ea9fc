"""Tests of suppression and of the letterbox, at any size."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.profiles.errors import OptionError
from beers_deploy.studies.detection.boxes import OVERLAP, Boxes, Letterbox, iou, suppress

SIDES = st.integers(1, 97)


def drawn(rng: np.random.Generator, count: int) -> np.ndarray:
    low = rng.uniform(0, 50, (count, 2))
    return np.hstack([low, low + rng.uniform(1, 30, (count, 2))])


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_suppression_leaves_the_best_of_each_cluster(seed: int) -> None:
    rng = np.random.default_rng(seed)
    candidates = Boxes.of(
        drawn(rng, 20).repeat(4, axis=0) + rng.uniform(0, 3, (80, 4)),
        rng.integers(0, 2, 80),
        rng.random(80),
    )
    survivors = suppress(candidates)
    assert (np.diff(survivors.scores) <= 0).all()
    # By candidate and survivor: True if the survivor is better, of its class, and crowds it out.
    crowded = (
        (iou(candidates.corners, survivors.corners) > OVERLAP)
        & (candidates.classes[:, None] == survivors.classes)
        & (candidates.scores[:, None] < survivors.scores)
    ).any(axis=1)
    assert_array_equal(crowded, ~np.isin(candidates.scores, survivors.scores))


def test_suppression_keeps_the_best_and_no_more_than_300() -> None:
    apart = Boxes.of(
        [[10.0 * i, 0, 10.0 * i + 5, 5] for i in range(320)], [0] * 320, np.linspace(0.1, 0.9, 320)
    )
    assert suppress(apart).scores.tolist() == apart.scores[::-1][:300].tolist()
    assert len(suppress(Boxes.of([], []))) == 0


@settings(max_examples=25)
@given(SIDES, SIDES, st.integers(3, 8))
def test_the_letterbox_maps_pixels_and_boxes_to_the_same_place(
    height: int, width: int, eighths: int
) -> None:
    """The values of this image are the coordinates of its pixels."""
    height = 3 * height + 40
    width = 3 * width + 41
    size = 32 * eighths + 1
    y, x = np.mgrid[0:height, 0:width] + 0.5
    image = np.stack([x / width, y / height, np.full(x.shape, 0.5)], axis=2).astype(np.float32)
    box = Letterbox(height, width, size)
    pixels = box.image(image)
    assert pixels.shape == (3, size, size)
    assert pixels.dtype == np.float32
    # The third band is level, and differs from the grey around the image.
    inside = np.abs(pixels[2] - 0.5) < 1e-3
    rows, columns = np.nonzero(inside)
    edges = np.array([[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]])
    assert_allclose(box.to_image(edges), [[0, 0, width, height]], atol=1e-6)
    middles = box.to_image(np.stack([columns, rows, columns, rows], axis=1) + 0.5)
    # Between the middles of the outermost pixels: at the border it can only repeat the last one.
    x_px, y_px = np.clip(middles[:, :2], 0.5, np.array([width, height]) - 0.5).T
    assert np.abs(pixels[0][inside] * width - x_px).max() < 0.01
    assert np.abs(pixels[1][inside] * height - y_px).max() < 0.01


def test_an_image_of_which_nothing_would_be_left_is_refused() -> None:
    with pytest.raises(OptionError, match="3 x 5000 px is too narrow"):
        Letterbox(3, 5000, 256)


def test_boxes_mostly_outside_are_ignored_and_boxes_outside_are_dropped() -> None:
    corners = np.array(
        [[-8, 0, 2, 10], [-5, 0, 5, 10], [-20, 0, -10, 10], [95, 95, 120, 105], [10, 10, 20, 20]]
    )
    clipped_boxes = Boxes.of(corners, range(5), ignored=[False, False, False, False, True]).clipped(
        100, 100
    )
    assert clipped_boxes.classes.tolist() == [0, 1, 3, 4]
    assert clipped_boxes.ignored.tolist() == [True, False, True, True]
    assert clipped_boxes.corners[:2].tolist() == [[0, 0, 2, 10], [0, 0, 5, 10]]
