"""Make the small detector: draw synthetic pictures, train, write its file, and evaluate it.

    OMP_NUM_THREADS=1 python -m benchmarks.detector.make [FILE]

The file is detector.onnx in this folder, or FILE. The same machine produces the same bytes.
Training takes most of the time: detector.md reports how long. --steps, --pictures and --held-out
shorten it for a trial.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from beers_deploy.model.progress import steps
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.studies.detection.average_precision import (
    find_hits,
    interval,
    score_rows,
    site_weights,
)
from beers_deploy.studies.detection.boxes import Boxes
from beers_deploy.studies.detection.detector import open_detector
from benchmarks.detector.network import DETECTOR, detector_to_onnx
from benchmarks.detector.scenes import CLASSES
from benchmarks.detector.training import DetectorRecipe, Picture, drawn_picture, train_detector

SIDE_PX = 256
RECIPE = DetectorRecipe(precision="bfloat16")


def main() -> None:
    """Draw the pictures, train the detector and evaluate it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("file", nargs="?", type=Path, default=DETECTOR)
    parser.add_argument("--pictures", type=int, default=400, help="drawn for training")
    parser.add_argument(
        "--held-out", type=int, default=60, help="of another seed, that it is judged on"
    )
    parser.add_argument("--steps", type=int, default=RECIPE.steps)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    recipe = replace(RECIPE, steps=arguments.steps)
    pictures = drawn(0, arguments.pictures)
    with steps("training", recipe.steps) as bar:
        network = train_detector(
            pictures, len(CLASSES), recipe, lambda loss: bar.advance(note=f"loss {loss:.2f}")
        )
    about = {
        "description": "vehicles, ships, aircraft and tanks of drawn scenes",
        "license": "Apache-2.0",
    }
    about["recipe"] = str(recipe)
    save_onnx(detector_to_onnx(network, CLASSES, SIDE_PX, about), arguments.file)
    judge(drawn(1, arguments.held_out), arguments.file)


def drawn(seed: int, count: int) -> list[Picture]:
    """Draw `count` pictures as the reference sensor sees them."""
    pictures = list[Picture]()
    with steps("drawing", count) as bar:
        for number in range(count):
            pictures.append(drawn_picture(SIDE_PX, seed, number))
            bar.advance()
    return pictures


def judge(pictures: Sequence[Picture], file: Path) -> None:
    """Print the average precisions with intervals, on pictures that were not used for training."""
    truths = [Boxes.of(picture.corners, picture.classes) for picture in pictures]
    detector = open_detector(file, 1)
    detections = [
        detector.detect((picture.image.astype(np.float32) / 255).transpose(1, 2, 0))
        for picture in pictures
    ]
    hits = {file.stem: find_hits(truths, detections, len(CLASSES))}
    sites = [str(number) for number in range(len(pictures))]
    rows, _ = score_rows(hits, CLASSES, site_weights(sites, 0))
    (values,) = rows.values()
    for key in ("mAP50", "mAP50-95", *(f"mAP50 of {name}" for name in CLASSES)):
        print(key, f"{values[key][0]:.4f}", interval(values[key], len(pictures)))


if __name__ == "__main__":
    main()
