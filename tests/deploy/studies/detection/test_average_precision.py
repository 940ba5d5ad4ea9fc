"""Test that scores of boxes are those of pycocotools for any weights, and that intervals state no
more than the sites allow.
"""

import io
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from beers_deploy.studies.detection.average_precision import (
    interval,
    mean_known,
    precisions,
    score,
    score_rows,
    site_weights,
    sites_note,
)
from beers_deploy.studies.detection.boxes import Boxes
from beers_deploy.studies.detection.matching import SIZES_PX, Hits, find_hits

NAMES = ("ship", "tank", "vehicle")
SEEDS = st.integers(0, 2**32 - 1)
ONE = np.array([[10.0, 10.0, 20.0, 20.0]])

Pairs = list[tuple[Boxes, Boxes]]
"""For each image, the labelled boxes and the detected boxes."""


def drawn(rng: np.random.Generator, images: int, ties: bool = False) -> Pairs:
    """Draw objects of all sizes, and detections: good, bad, of a wrong class, and false ones.

    With `ties` the scores have few values. Otherwise no two are equal.
    """
    pairs = []
    for _ in range(images):
        truth = boxes(rng, int(rng.integers(0, 7)))
        false = boxes(rng, int(rng.integers(0, 6)))
        count = int(rng.integers(0, 12)) if len(truth) else 0
        near = truth[rng.integers(0, max(len(truth), 1), count)]
        corners = near.corners + rng.normal(0, 1.5, (count, 4))
        corners[:, 2:] = np.maximum(corners[:, 2:], corners[:, :2] + 1)
        # A fifth of the labels are drawn again.
        classes = np.where(rng.random(count) < 0.8, near.classes, rng.integers(0, 3, count))
        found = Boxes.of(
            np.vstack([corners, false.corners]),
            np.concatenate([classes, false.classes]),
            rng.random(count + len(false)).round(1 if ties else 12),
        )
        pairs.append((replace(truth, ignored=rng.random(len(truth)) < 0.2), found))
    return pairs


def boxes(rng: np.random.Generator, count: int) -> Boxes:
    low = rng.uniform(0, 100, (count, 2))
    corners = np.hstack([low, low + rng.uniform(4, 60, (count, 2))])
    return Boxes.of(corners, rng.integers(0, 3, count))


def hits_of(pairs: Pairs, classes: int = len(NAMES)) -> Hits:
    return find_hits([truth for truth, _ in pairs], [detected for _, detected in pairs], classes)


def scored(
    pairs: Pairs, names: Sequence[str] = ("ship",), confidence: float = np.nan
) -> dict[str, float]:
    figures = score(
        hits_of(pairs, len(names)), names, np.ones((1, len(pairs)), np.int64), confidence
    )
    return {name: float(values[0]) for name, values in figures.items()}


def by_pycocotools(pairs: Pairs, size: str = "all") -> np.ndarray:
    """Compute the average precision by class and overlap, (3, 10), with pycocotools alone.

    It is NaN where a class has no object.
    """
    with redirect_stdout(io.StringIO()):
        evaluation = COCOeval(_table([t for t, _ in pairs]), _table([f for _, f in pairs]), "bbox")
        evaluation.params.maxDets = [1000]
        low, high = SIZES_PX[size]
        evaluation.params.areaRng = [[low**2, high**2]]
        evaluation.params.areaRngLbl = [size]
        evaluation.evaluate()
        evaluation.accumulate()
    # The axes of the array are overlap, recall, class, area and number of detections.
    precision = evaluation.eval["precision"][:, :, :, 0, 0].mean(axis=1).T
    return np.where(precision < 0, np.nan, precision)


def _table(images: Sequence[Boxes]) -> COCO:
    rows: list[dict[str, object]] = []
    for number, image_boxes in enumerate(images):
        for (left, top, right, bottom), kind, value, crowd in zip(
            *vars(image_boxes).values(), strict=True
        ):
            width = right - left
            height = bottom - top
            row = {"id": len(rows) + 1, "image_id": number, "category_id": int(kind)}
            box = {"bbox": [left, top, width, height], "area": width * height}
            rows.append({**row, **box, "score": float(value), "iscrowd": int(crowd)})
    table = COCO()
    numbers = {
        "images": [{"id": i} for i in range(len(images))],
        "categories": [{"id": c} for c in range(3)],
    }
    table.dataset = {**numbers, "annotations": rows}
    table.createIndex()
    return table


@settings(max_examples=60)
@given(
    SEEDS,
    st.lists(st.integers(0, 4), min_size=1, max_size=8),
    st.booleans(),
    st.sampled_from(list(SIZES_PX)),
)
def test_a_weight_counts_like_as_many_copies_for_pycocotools(
    seed: int, weights: list[int], ties: bool, size: str
) -> None:
    pairs = drawn(np.random.default_rng(seed), len(weights), ties)
    # With equal scores, pycocotools would sort copies of an image in another order.
    weights = [min(weight, 1) for weight in weights] if ties else weights
    copies: Pairs = []
    for pair, weight in zip(pairs, weights, strict=True):
        copies += [pair] * weight
    hits = hits_of(pairs)
    images = np.array([weights])
    figures = score(hits, NAMES, images, 0.5)
    if not copies:
        assert np.isnan(figures["mAP50"])
        return
    number = list(SIZES_PX).index(size)
    ours = [precisions(hits, kind, images, number, 10)[0].mean(axis=-1) for kind in range(3)]
    expected = by_pycocotools(copies, size)
    assert_allclose(ours, expected, rtol=0, atol=1e-12)
    for name, value in scored(copies, NAMES, 0.5).items():
        assert_allclose(figures[name][0], value, rtol=0, atol=1e-12, err_msg=name)
    mean = mean_known(expected[:, :1])[0]
    of_size = figures["mAP50" if size == "all" else f"mAP50 {size}"][0]
    assert_allclose(of_size, mean, rtol=0, atol=1e-12)
    if size == "all":
        mean = mean_known(expected.mean(axis=1)[:, None])[0]
        assert_allclose(figures["mAP50-95"][0], mean, rtol=0, atol=1e-12)


@settings(max_examples=30)
@given(SEEDS, st.sampled_from([0.0, 0.137, 0.5, 0.9, 1.0]))
def test_precision_and_recall_are_those_of_what_is_left_at_a_confidence(
    seed: int, confidence: float
) -> None:
    pairs = drawn(np.random.default_rng(seed), 5)
    figures = scored(pairs, NAMES, confidence)
    hits = hits_of([(truth, detected[detected.scores >= confidence]) for truth, detected in pairs])
    everything = hits_of(pairs)
    assert_array_equal(everything.hits[..., everything.scores >= confidence], hits.hits)
    counted = ~np.concatenate([truth.ignored for truth, _ in pairs])
    is_found = everything.found_at[..., counted] >= confidence
    assert_array_equal(is_found, hits.found_at[..., counted] > -np.inf)
    precision = []
    recall = []
    for kind, objects in enumerate(hits.objects[0].sum(axis=1)):
        if objects:
            mine = hits.classes == kind
            true_positives = hits.hits[0, 0, mine].sum()
            counted = (~hits.ignored[0, 0, mine]).sum()
            precision.append(true_positives / counted if counted else 1.0)
            recall.append(true_positives / objects)
    expected = [np.mean(values or np.nan) for values in (precision, recall)]
    actual = [figures["precision"], figures["recall"]]
    assert_allclose(actual, expected, rtol=0, atol=1e-12)


def test_sizes_are_distinguished_by_the_root_of_the_area() -> None:
    sides = (15.99, 16.0, 31.99, 32.0)
    squares = Boxes.of(
        [[0, 100.0 * i, side, 100.0 * i + side] for i, side in enumerate(sides)], [0] * 4
    )
    assert hits_of([(squares, squares)], 1).objects.sum(axis=(1, 2)).tolist() == [4, 1, 2, 1]


def test_own_confidence_is_that_of_the_best_mean_f1() -> None:
    corners = np.vstack([ONE, ONE + 30, ONE + 60])
    pair = Boxes.of(corners[:2], [0, 0]), Boxes.of(corners, [0, 0, 0], [0.9, 0.6, 0.3])
    figures = scored([pair], confidence=0.7)
    # Just above 0.3 the false detection no longer counts.
    assert figures["own confidence"] == pytest.approx(0.301)
    assert (figures["own precision"], figures["own recall"]) == (1.0, 1.0)
    assert (figures["precision"], figures["recall"]) == (1.0, 0.5)


def test_every_row_is_read_at_the_first_one_s_confidence() -> None:
    pairs = drawn(np.random.default_rng(7), 10)
    halved = [(truth, replace(found, scores=found.scores / 2)) for truth, found in pairs]
    rows = {"reference": hits_of(pairs), "halved": hits_of(halved)}
    figures, confidence = score_rows(rows, NAMES, np.ones((1, 10), np.int64))
    assert confidence == scored(pairs, NAMES)["own confidence"]
    assert figures["halved"]["recall"][0] == scored(halved, NAMES, confidence)["recall"]
    assert figures["halved"]["recall"][0] != figures["halved"]["own recall"][0]


def test_a_draw_has_whole_sites_and_a_seed_gives_the_same_draws() -> None:
    weights = site_weights(["a", "a", "b", "c"], 5)
    assert weights[0].tolist() == [1, 1, 1, 1]
    assert (weights[:, 0] == weights[:, 1]).all()
    assert (weights[1:, 1:].sum(axis=1) == 3).all()
    assert_array_equal(weights, site_weights(["a", "a", "b", "c"], 5))
    assert not np.array_equal(weights, site_weights(["a", "a", "b", "c"], 6))


def test_a_class_without_an_object_in_a_draw_is_left_out() -> None:
    ship = Boxes.of(ONE, [0])
    pairs = [(ship, ship)] * 3 + [(Boxes.of(ONE, [1]), Boxes.of([], []))] * 2
    figures = score(hits_of(pairs, 2), ("ship", "tank"), site_weights(list("abcde"), 0))
    assert set(figures["mAP50"]) == {0.0, 0.5, 1.0}
    assert 0 < np.isnan(figures["mAP50 of tank"]).sum() < 1000
    assert interval(figures["mAP50 of tank"], 5) == (0.0, 0.0)


def test_below_five_sites_there_is_no_interval_and_below_ten_a_warning() -> None:
    values = np.linspace(0.2, 0.4, 50)
    assert interval(values, 4) is None
    assert interval(values, 5) is not None
    assert "of 4, fewer than 5" in sites_note(4)
    assert "Only 9 sites" in sites_note(9)
    assert sites_note(10) == ""
