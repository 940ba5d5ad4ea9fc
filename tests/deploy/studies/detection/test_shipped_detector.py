"""The shipped detector: it is what its recipe says, finds what is drawn, and
stays itself in INT8.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.checker.table import legality
from beers_deploy.dpu.reading import read_network
from beers_deploy.model.shipped import DETECTOR, DETECTOR_INT8
from beers_deploy.profiles.target import board_names
from beers_deploy.quant.encodings import encoding_faults
from beers_deploy.quant.onnx_file import load_onnx, metadata
from beers_deploy.studies.detection.average_precision import find_hits, map50
from beers_deploy.studies.detection.boxes import Boxes
from beers_deploy.studies.detection.detector import open_detector
from beers_deploy.studies.detection.scenes import CLASSES
from benchmarks.detector.training import DetectorRecipe, Picture, drawn_picture

HELD_OUT_SEED = 7


@cache
def pictures() -> list[Picture]:
    return [drawn_picture(256, HELD_OUT_SEED, number) for number in range(6)]


@cache
def score(int8: bool) -> float:
    """mAP50 on the pictures."""
    detector = open_detector(DETECTOR_INT8 if int8 else DETECTOR, 1)
    boxes = [
        detector.detect((picture.image.astype(np.float32) / 255).transpose(1, 2, 0))
        for picture in pictures()
    ]
    truths = [Boxes.of(picture.corners, picture.classes) for picture in pictures()]
    return float(
        map50(find_hits(truths, boxes, len(CLASSES)), np.ones((1, len(truths)), np.int64))[0]
    )


@pytest.mark.parametrize("path", [DETECTOR, DETECTOR_INT8])
def test_both_files_are_read_as_a_detector_of_our_classes(path: Path) -> None:
    detector = open_detector(path, 1)
    assert (detector.names, detector.size_px, detector.flag) == (CLASSES, 256, "")


def test_it_was_made_by_the_recipe_that_stands_here() -> None:
    assert metadata(load_onnx(DETECTOR))["recipe"] == str(DetectorRecipe(precision="bfloat16"))
    assert metadata(load_onnx(DETECTOR_INT8))["recipe"] == metadata(load_onnx(DETECTOR))["recipe"]


@pytest.mark.slow
def test_it_finds_most_of_what_it_never_saw() -> None:
    assert score(int8=False) > 0.75


def test_int8_finds_as_much() -> None:
    assert score(int8=True) == pytest.approx(score(int8=False), abs=0.03)
    assert encoding_faults(load_onnx(DETECTOR_INT8)) == []


@pytest.mark.parametrize("board", board_names())
def test_it_runs_whole_on_every_board(board: str) -> None:
    assert legality(place(read_network(DETECTOR_INT8, None), load_dpu(board, None))).passed
