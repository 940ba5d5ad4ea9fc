"""Scores of boxes are those of pycocotools, whatever the weights; precision and recall those that are counted."""

import builtins
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.detection.boxes import Boxes
from deploy.detection.classes import class_map
from deploy.detection.matching import ALL, CONFIDENCES, SIZES_PX, Image, match
from deploy.detection.scores import RECALLS, average_precisions, confidence_curve, mean, precisions, score
from profiles.errors import MachineError
from tests.deploy.detection.drawn import NAMES, by_pycocotools, drawn_images

SEEDS = st.integers(0, 2**32 - 1)
ONE = np.array([[10.0, 10.0, 20.0, 20.0]])


def of_pycocotools(images: list[Image], size: str = ALL) -> np.ndarray:
    """By class and overlap, NaN where a class has no object."""
    found = by_pycocotools(images, size).T
    return np.where(found < 0, np.nan, found)


@settings(max_examples=60)
@given(SEEDS, st.integers(1, 8), st.booleans(), st.sampled_from(list(SIZES_PX)))
def test_average_precision_is_that_of_pycocotools(seed: int, count: int, ties: bool, size: str) -> None:
    images = drawn_images(np.random.default_rng(seed), count, ties)
    ours = [average_precisions(one, np.ones(count, np.int64)) for one in match(images, NAMES).by_size[size]]
    np.testing.assert_allclose(ours, of_pycocotools(images, size), rtol=0, atol=1e-12)


@settings(max_examples=40)
@given(SEEDS, st.lists(st.integers(0, 4), min_size=2, max_size=6))
def test_a_weight_is_as_good_as_so_many_copies(seed: int, weights: list[int]) -> None:
    images = drawn_images(np.random.default_rng(seed), len(weights))
    copies = [image for image, weight in zip(images, weights, strict=True) for _ in range(weight)]
    found = score(match(images, NAMES), np.array(weights))
    if not copies:
        assert np.isnan(found.ap)
        return
    expected = of_pycocotools(copies)
    np.testing.assert_allclose(found.ap50, mean(expected[:, 0]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.ap, mean(expected.mean(axis=1)), rtol=0, atol=1e-12)
    again = score(match(copies, NAMES))
    for name, value in again.figures().items():
        np.testing.assert_allclose(found.figures()[name], value, rtol=0, atol=1e-12, err_msg=name)


@settings(max_examples=40)
@given(SEEDS, st.sampled_from([0.0, 0.137, 0.5, 0.9, 1.0]))
def test_precision_and_recall_are_those_of_what_is_left_at_a_confidence(seed: int, confidence: float) -> None:
    images = drawn_images(np.random.default_rng(seed), 5)
    curve = confidence_curve(match(images, NAMES), np.ones(5, np.int64))
    left = [replace(image, found=image.found[image.found.scores >= confidence]) for image in images]
    precision, recall = [], []
    for of_class in match(left, NAMES).by_size[ALL]:
        if of_class.truths.sum():
            true, counted = of_class.hits[0].sum(), (~of_class.ignored[0]).sum()
            precision.append(true / counted if counted else 1.0)
            recall.append(true / of_class.truths.sum())
    np.testing.assert_allclose(curve.at(confidence), (mean(precision), mean(recall)), rtol=0, atol=1e-12)


def test_perfect_boxes_score_one() -> None:
    images = drawn_images(np.random.default_rng(3), 20, ignored=False)
    figures = score(match([replace(image, found=image.truth) for image in images], NAMES)).figures()
    assert set(figures.values()) == {1.0}
    nothing = score(match([replace(image, found=Boxes.none()) for image in images], NAMES)).figures()
    assert {name: value for name, value in nothing.items() if value} == {"precision": 1.0, "own precision": 1.0}


def test_a_detector_that_numbers_the_classes_otherwise_scores_the_same() -> None:
    images = drawn_images(np.random.default_rng(4), 20)
    names = ("Vehicle", "S-hip", "TANK")
    classes = class_map(NAMES, names)
    number = np.argsort(classes.truth)  # which labelled class each of the detector's is
    other = [
        Image(image.truth.renamed(classes.truth), image.found.renamed(classes.truth), image.site) for image in images
    ]
    found, expected = score(match(other, names)), score(match(images, NAMES))
    np.testing.assert_allclose((found.ap50, found.ap), (expected.ap50, expected.ap), rtol=0, atol=1e-12)
    by_class = [found.by_class[names[i]] for i in range(3)]
    assert by_class == [expected.by_class[NAMES[number[i]]] for i in range(3)]
    # By number they are others' classes.
    assert (
        score(match([replace(one, found=image.found) for one, image in zip(other, images, strict=True)], names)).ap50
        < 0.7 * found.ap50
    )


def test_a_shift_by_a_pixel_costs_the_levels_that_it_passes() -> None:
    shifted = Image(Boxes.of(ONE, [0]), Boxes.of(ONE + np.array([1, 0, 1, 0]), [0], [0.9]), "a")
    found = score(match([shifted], ("ship",)))
    assert (found.ap50, round(found.ap, 12)) == (1.0, 0.7)  # 90 px2 of 110 overlap: 0.82, above seven of ten levels


def test_what_is_found_on_an_unlabelled_image_is_false() -> None:
    labelled = Image(Boxes.of(ONE, [0]), Boxes.of(ONE, [0], [0.5]), "a")
    empty = Image(Boxes.none(), Boxes.of(ONE, [0], [0.9]), "b")
    assert score(match([labelled], ("ship",))).ap == 1.0
    with_false = score(match([labelled, empty], ("ship",)))
    assert (with_false.ap50, with_false.own) == (0.5, (0.5, 1.0))
    assert score(match([labelled, replace(empty, found=Boxes.none())], ("ship",))).ap == 1.0
    assert np.isnan(score(match([empty], ("ship",))).ap50)


def test_what_lies_in_an_ignored_box_counts_neither_way() -> None:
    truth = Boxes.of(np.vstack([ONE, ONE + 50]), [0, 0], ignored=[False, True])
    within = Boxes.of(np.vstack([ONE, ONE + 50, ONE + 51]), [0, 0, 0], [0.5, 0.9, 0.8])
    found = score(match([Image(truth, within, "a")], ("ship",)))
    assert (found.ap50, found.own) == (1.0, (1.0, 1.0))
    missed = score(match([Image(truth, within[:1], "a")], ("ship",)))
    assert missed.ap == 1.0
    false = Boxes.of(np.vstack([ONE, ONE + 80]), [0, 0], [0.5, 0.9])
    assert score(match([Image(truth, false, "a")], ("ship",))).ap50 == 0.5


def test_a_class_of_which_nothing_is_labelled_drops_out_of_the_mean() -> None:
    image = Image(Boxes.of(ONE, [0]), Boxes.of(np.vstack([ONE, ONE]), [0, 1], [0.5, 0.9]), "a")
    found = score(match([image], ("ship", "tank")))
    assert found.ap50 == 1.0
    assert np.isnan(found.by_class["tank"])


def test_sizes_are_told_apart_by_the_root_of_the_area() -> None:
    sides = (15.99, 16.0, 31.99, 32.0)
    corners = np.array([[0, 100.0 * i, side, 100.0 * i + side] for i, side in enumerate(sides)])
    boxes = Boxes.of(corners, [0] * 4)
    matched = match([Image(boxes, boxes, "a")], ("ship",))
    assert {size: int(one[0].truths.sum()) for size, one in matched.by_size.items()} == {
        "all": 4,
        "under 16 px": 1,
        "16 to 32 px": 2,
        "32 px up": 1,
    }
    assert set(score(matched).by_size.values()) == {1.0}


def test_own_confidence_is_that_of_the_best_mean_f1() -> None:
    corners = np.vstack([ONE, ONE + 30, ONE + 60])
    truth, found = Boxes.of(corners[:2], [0, 0]), Boxes.of(corners, [0, 0, 0], [0.9, 0.6, 0.3])
    scores = score(match([Image(truth, found, "a")], ("ship",)), confidence=0.7)
    assert scores.confidence == pytest.approx(0.301)  # the false one no longer counts
    assert (scores.own, scores.fixed) == ((1.0, 1.0), (1.0, 0.5))
    curve = confidence_curve(match([Image(truth, found, "a")], ("ship",)), np.ones(1, np.int64))
    assert curve.f1[0] == pytest.approx(0.8)
    assert len(curve.f1) == len(CONFIDENCES)


def test_a_curve_falls_with_recall() -> None:
    images = drawn_images(np.random.default_rng(8), 30)
    for of_class in match(images, NAMES).by_size[ALL]:
        curve = precisions(of_class, np.ones(30, np.int64))[0]
        assert curve.shape == RECALLS.shape
        assert (np.diff(curve) <= 0).all()
        assert curve[0] > curve[-1]


def test_without_pycocotools_it_is_said_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    known = builtins.__import__

    def lacking(name: str, *rest: object) -> object:
        if name.startswith("pycocotools"):
            raise ImportError(name)
        return known(name, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", lacking)
    with pytest.raises(MachineError, match=r"beers-deploy\[detect\]"):
        match([Image(Boxes.of(ONE, [0]), Boxes.none(), "a")], ("ship",))
