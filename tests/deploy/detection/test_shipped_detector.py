"""The shipped detector: it is what its recipe says, finds what is drawn, and stays itself in INT8."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from deploy.detection.boxes import Boxes
from deploy.detection.detectors import open_detector
from deploy.detection.matching import Image, match
from deploy.detection.scores import Scores, score
from deploy.dpu.board import load_dpu
from deploy.dpu.checker.placement import place
from deploy.dpu.checker.table import legality
from deploy.dpu.reading import read_network
from model.detection.objects import CLASSES
from model.detection.pictures import Picture, drawn_picture
from model.detection.training import DetectorRecipe
from model.shipped import DETECTOR, DETECTOR_INT8
from profiles.sensor_file import REFERENCE, load_sensor
from profiles.target import board_names
from quant.encodings import encoding_faults
from quant.onnx_file import load_onnx, metadata

HELD_OUT_SEED = 7


@cache
def pictures() -> list[Picture]:
    sensor = load_sensor(REFERENCE).nominal()
    return [drawn_picture(sensor, 3, 256, HELD_OUT_SEED, number) for number in range(6)]


@cache
def scores(int8: bool) -> Scores:
    detector = open_detector(DETECTOR_INT8 if int8 else DETECTOR, 1)
    seen = [(picture.image.astype(np.float32) / 255).transpose(1, 2, 0) for picture in pictures()]
    truths = [Boxes.of(picture.corners, picture.classes) for picture in pictures()]
    images = [
        Image(truth, detector.detect(rgb), str(k)) for k, (truth, rgb) in enumerate(zip(truths, seen, strict=True))
    ]
    return score(match(images, CLASSES))


@pytest.mark.parametrize("path", [DETECTOR, DETECTOR_INT8])
def test_both_files_are_read_as_a_detector_of_our_classes(path: Path) -> None:
    detector = open_detector(path, 1)
    assert (detector.names, detector.size_px, detector.layout, detector.flag) == (CLASSES, 256, "raw", None)


def test_it_was_made_by_the_recipe_that_stands_here() -> None:
    assert metadata(load_onnx(DETECTOR))["recipe"] == str(DetectorRecipe(precision="bfloat16"))
    assert metadata(load_onnx(DETECTOR_INT8))["recipe"] == metadata(load_onnx(DETECTOR))["recipe"]


@pytest.mark.slow
def test_it_finds_most_of_what_it_never_saw() -> None:
    assert scores(int8=False).ap50 > 0.75


def test_int8_finds_as_much() -> None:
    assert scores(int8=True).ap50 == pytest.approx(scores(int8=False).ap50, abs=0.03)
    assert encoding_faults(load_onnx(DETECTOR_INT8)) == []


@pytest.mark.parametrize("board", board_names())
def test_it_runs_whole_on_every_board(board: str) -> None:
    assert legality(place(read_network(DETECTOR_INT8, None), load_dpu(board, None))).passed
