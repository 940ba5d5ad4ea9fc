"""Tests of the detector's training and file, and of the small detector that is stored."""

import numpy as np
import onnxruntime as ort
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.quant.onnx_file import load_onnx, metadata
from beers_deploy.studies.detection.average_precision import map50
from beers_deploy.studies.detection.boxes import Boxes
from beers_deploy.studies.detection.detector import open_detector
from beers_deploy.studies.detection.matching import find_hits
from benchmarks.detector.network import DETECTOR, Decoding, DetectorNetwork, detector_to_onnx
from benchmarks.detector.scenes import CLASSES
from benchmarks.detector.training import (
    DetectorRecipe,
    Picture,
    drawn_picture,
    train_detector,
    turned,
)

SIDE_PX = 64


def squares(seed: int) -> Picture:
    """Draw a bright square in the upper half and a dark one in the lower half, on grey."""
    generator = np.random.default_rng(seed)
    image = np.full((3, SIDE_PX, SIDE_PX), 128, np.uint8)
    corners = []
    for top, value in ((0, 255), (32, 0)):
        side = int(generator.integers(8, 16))
        x, y = (int(v) for v in generator.integers(1, 31 - side, 2))
        image[:, top + y : top + y + side, x : x + side] = value
        corners.append([x, top + y, x + side, top + y + side])
    return Picture(image, np.array(corners, np.float64), np.array([0, 1]))


@pytest.fixture(scope="module")
def trained() -> DetectorNetwork:
    recipe = DetectorRecipe(steps=60, batch=8, learning_rate=1e-2)
    return train_detector([squares(k) for k in range(16)], 2, recipe)


def test_it_finds_unseen_squares_and_its_file_gives_the_same(
    trained: DetectorNetwork,
) -> None:
    file = detector_to_onnx(trained, ("bright", "dark"), SIDE_PX, "").SerializeToString()
    session = ort.InferenceSession(file, providers=["CPUExecutionProvider"])
    for seed in range(100, 104):
        unseen = squares(seed)
        image = unseen.image[None].astype(np.float32) / 255
        with torch.inference_mode():
            boxes = Decoding(trained)(torch.from_numpy(image)).numpy()
        (result,) = session.run(["output0"], {"images": image})
        assert_allclose(result, boxes, rtol=1e-3, atol=1e-3)
        for kind, corners in enumerate(unseen.corners):
            box = boxes[0, :4, boxes[0, 4 + kind].argmax()]
            assert_allclose(box[:2], (corners[:2] + corners[2:]) / 2, atol=3)
            assert_allclose(box[2:], corners[2:] - corners[:2], atol=5)


def test_the_same_seed_gives_the_same_weights_and_another_gives_others() -> None:
    pictures = [squares(k) for k in range(3)]
    runs = [
        train_detector(pictures, 2, DetectorRecipe(steps=3, batch=2, seed=s)).state_dict()
        for s in (0, 0, 1)
    ]
    assert all(torch.equal(a, b) for a, b in zip(runs[0].values(), runs[1].values(), strict=True))
    assert not torch.equal(runs[0]["tail.weight"], runs[2]["tail.weight"])


@given(st.integers(0, 2**32))
def test_symmetries_move_the_boxes_with_the_image(seed: int) -> None:
    picture = turned(squares(seed), np.random.default_rng(seed))
    for kind, value in enumerate((255, 0)):
        rows, columns = np.nonzero(picture.image[0] == value)
        bounds = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        assert_array_equal(picture.corners[kind], bounds)


def test_the_stored_detector_states_our_classes_and_its_recipe() -> None:
    detector = open_detector(DETECTOR)
    assert (detector.names, detector.size_px, detector.flag) == (CLASSES, 256, "")
    assert metadata(load_onnx(DETECTOR))["recipe"] == str(DetectorRecipe())


@pytest.mark.slow
def test_the_stored_detector_finds_most_unseen_objects() -> None:
    pictures = [drawn_picture(256, 7, number) for number in range(6)]
    detector = open_detector(DETECTOR)
    boxes = [
        detector.detect((picture.image.astype(np.float32) / 255).transpose(1, 2, 0))
        for picture in pictures
    ]
    truths = [Boxes.of(picture.corners, picture.classes) for picture in pictures]
    hits = find_hits(truths, boxes, len(CLASSES))
    assert float(map50(hits, np.ones((1, len(truths)), np.int64))[0]) > 0.75
