"""The small detector: it is what its recipe says, and finds what is drawn."""

import numpy as np
import pytest

from beers_deploy.quant.onnx_file import load_onnx, metadata
from beers_deploy.studies.detection.average_precision import find_hits, map50
from beers_deploy.studies.detection.boxes import Boxes
from beers_deploy.studies.detection.detector import open_detector
from benchmarks.detector.network import DETECTOR
from benchmarks.detector.scenes import CLASSES
from benchmarks.detector.training import DetectorRecipe, drawn_picture

HELD_OUT_SEED = 7


def test_it_is_read_as_a_detector_of_our_classes_and_says_its_recipe() -> None:
    detector = open_detector(DETECTOR, 1)
    assert (detector.names, detector.size_px, detector.flag) == (CLASSES, 256, "")
    assert metadata(load_onnx(DETECTOR))["recipe"] == str(DetectorRecipe(precision="bfloat16"))


@pytest.mark.slow
def test_it_finds_most_of_what_it_never_saw() -> None:
    pictures = [drawn_picture(256, HELD_OUT_SEED, number) for number in range(6)]
    detector = open_detector(DETECTOR, 1)
    boxes = [
        detector.detect((picture.image.astype(np.float32) / 255).transpose(1, 2, 0))
        for picture in pictures
    ]
    truths = [Boxes.of(picture.corners, picture.classes) for picture in pictures]
    hits = find_hits(truths, boxes, len(CLASSES))
    assert float(map50(hits, np.ones((1, len(truths)), np.int64))[0]) > 0.75
