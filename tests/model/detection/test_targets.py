"""What a detector is taught: centres in their cells, boxes exact, overlaps as they are counted pixel by pixel."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from model.detection.network import STRIDE_PX, decoded
from model.detection.targets import Targets, focal_loss, generalised_iou, loss_of, targets_of

CELLS = 16
SIDE_PX = CELLS * STRIDE_PX

whole_boxes = st.tuples(st.integers(0, 30), st.integers(0, 30), st.integers(1, 20), st.integers(1, 20)).map(
    lambda box: np.array([box[0], box[1], box[0] + box[2], box[1] + box[3]], np.float64)
)


def encoded(corners: np.ndarray) -> torch.Tensor:
    """The map that says of every cell this box (4,), as `decoded` reads it: (1, 4, h, w)."""
    middle, size = (corners[:2] + corners[2:]) / 2 / STRIDE_PX, (corners[2:] - corners[:2]) / STRIDE_PX
    rows, columns = np.mgrid[:CELLS, :CELLS] + 0.5
    sizes = np.broadcast_to(np.log(size)[:, None, None], (2, CELLS, CELLS))
    return torch.from_numpy(np.concatenate([[middle[0] - columns, middle[1] - rows], sizes]))[None]


@given(whole_boxes)
def test_every_cell_can_say_any_box(corners: np.ndarray) -> None:
    boxes = decoded(encoded(corners))
    wanted = [*(corners[:2] + corners[2:]) / 2, *(corners[2:] - corners[:2])]
    np.testing.assert_allclose(boxes[0].flatten(1).T, np.tile(wanted, (CELLS**2, 1)), atol=1e-9)


@given(whole_boxes, st.integers(0, 2))
def test_the_bump_is_one_in_the_cell_of_the_centre_alone(corners: np.ndarray, kind: int) -> None:
    bumps, boxes, weights = targets_of(corners[None], np.array([kind]), 3, CELLS, CELLS)
    column, row = ((corners[:2] + corners[2:]) / 2 // STRIDE_PX).astype(int)
    assert np.argwhere(bumps == 1).tolist() == [[kind, row, column]]
    held = weights[0] > 0
    np.testing.assert_array_equal(boxes[:, held].T, np.tile(corners, (held.sum(), 1)))
    np.testing.assert_allclose(weights.sum(), np.log(max((corners[2:] - corners[:2]).prod(), 2)), rtol=1e-5)


@given(whole_boxes)
def test_a_map_that_is_right_costs_nothing_and_another_does(corners: np.ndarray) -> None:
    bumps, boxes, weights = (
        torch.from_numpy(each)[None] for each in targets_of(corners[None], np.zeros(1, int), 1, CELLS, CELLS)
    )
    targets, sure = Targets(bumps, boxes, weights), torch.where(bumps == 1, 30.0, -30.0)
    right = loss_of(torch.cat([encoded(corners), sure], dim=1), targets)
    shifted = loss_of(torch.cat([encoded(corners + 1), -sure], dim=1), targets)
    assert all(float(loss) < 1e-3 for loss in right)
    assert all(float(loss) > 0.05 for loss in shifted)


def test_of_two_objects_in_a_cell_the_smaller_has_its_box() -> None:
    corners = np.array([[0.0, 0, 40, 40], [18, 18, 22, 22]])
    for order in ([0, 1], [1, 0]):
        _, boxes, _ = targets_of(corners[order], np.array([0, 0]), 1, CELLS, CELLS)
        np.testing.assert_array_equal(boxes[:, 5, 5], corners[1])


def test_an_image_without_objects_teaches_that_there_are_none() -> None:
    bumps, _, weights = targets_of(np.empty((0, 4)), np.empty(0, np.int64), 2, CELLS, CELLS)
    assert not bumps.any()
    assert not weights.any()
    none = torch.from_numpy(bumps)[None]
    assert float(focal_loss(torch.full_like(none, -30), none)) == pytest.approx(0, abs=1e-6)
    assert float(focal_loss(torch.full_like(none, 3), none)) > 1


@given(whole_boxes, whole_boxes)
def test_the_overlap_is_that_of_counted_pixels(one: np.ndarray, other: np.ndarray) -> None:
    masks = np.zeros((2, 60, 60), bool)
    hull = np.zeros((60, 60), bool)
    low, high = np.minimum(one, other)[:2].astype(int), np.maximum(one, other)[2:].astype(int)
    hull[low[1] : high[1], low[0] : high[0]] = True
    for mask, box in zip(masks, (one, other), strict=True):
        left, top, right, bottom = box.astype(int)
        mask[top:bottom, left:right] = True
    union = masks.any(0).sum()
    wanted = masks.all(0).sum() / union - (hull.sum() - union) / hull.sum()
    found = generalised_iou(*(torch.from_numpy(box)[None, :, None, None] for box in (one, other)))
    assert float(found) == pytest.approx(wanted, abs=1e-9)
