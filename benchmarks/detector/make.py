"""Makes the shipped detector anew: synthetic pictures, training, the file, the same in INT8, and
what both find.

    OMP_NUM_THREADS=1 python -m benchmarks.detector.make [FOLDER]

The files go to model/weights, or to FOLDER; the same bytes on the same machine. The training is
most of it: see model/weights/detector.md for how long it took. --steps, --pictures and --held-out
make it shorter, to try it.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from beers_deploy.model.progress import steps
from beers_deploy.model.shipped import DETECTOR, DETECTOR_INT8
from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from beers_deploy.quant.quantise import quantise_model
from beers_deploy.quant.samples import Patches, Remade
from beers_deploy.studies.detection.average_precision import (
    find_hits,
    interval,
    score_rows,
    site_weights,
)
from beers_deploy.studies.detection.boxes import Boxes
from beers_deploy.studies.detection.detector import open_detector
from beers_deploy.studies.detection.scenes import CLASSES
from benchmarks.detector.network import detector_to_onnx
from benchmarks.detector.training import DetectorRecipe, Picture, drawn_picture, train_detector

SIDE_PX = 256
SEEN = 64
"""Pictures of the training that INT8 is calibrated on."""
RECIPE = DetectorRecipe(precision="bfloat16")


def main() -> None:
    """Draw, train, quantise, judge."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", nargs="?", type=Path, default=DETECTOR.parent)
    parser.add_argument("--pictures", type=int, default=400, help="drawn for training")
    parser.add_argument(
        "--held-out", type=int, default=60, help="of another seed, that both files are judged on"
    )
    parser.add_argument("--steps", type=int, default=RECIPE.steps)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    files = [arguments.folder / path.name for path in (DETECTOR, DETECTOR_INT8)]
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
    save_onnx(
        detector_to_onnx(network, CLASSES, SIDE_PX, {**about, "recipe": str(recipe)}), files[0]
    )
    quantise(pictures[:SEEN], *files)
    judge(drawn(1, arguments.held_out), files)


def drawn(seed: int, count: int) -> list[Picture]:
    """Pictures of the reference sensor."""
    pictures = list[Picture]()
    with steps("drawing", count) as bar:
        for number in range(count):
            pictures.append(drawn_picture(SIDE_PX, seed, number))
            bar.advance()
    return pictures


def quantise(pictures: Sequence[Picture], file: Path, int8: Path) -> None:
    """The file in INT8 under the DPU's rules, for the host."""
    images = [picture.image[None].astype(np.float32) / 255 for picture in pictures]
    patches = Patches(
        [],
        Remade(lambda k: (images[k], images[k]), len(images)),
        Remade(lambda k: images[k], len(images)),
    )
    save_onnx(quantise_model(load_onnx(file), patches, {}).host, int8)


def judge(pictures: Sequence[Picture], files: Sequence[Path]) -> None:
    """Print average precisions with intervals, over pictures that nothing was trained on."""
    truths = [Boxes.of(picture.corners, picture.classes) for picture in pictures]
    hits = {}
    for file in files:
        detector = open_detector(file, 1)
        detections = [
            detector.detect((picture.image.astype(np.float32) / 255).transpose(1, 2, 0))
            for picture in pictures
        ]
        hits[file.stem] = find_hits(truths, detections, len(CLASSES))
    rows, _ = score_rows(
        hits, CLASSES, site_weights([str(number) for number in range(len(pictures))], 0)
    )
    float32, int8 = rows.values()
    for key in ("mAP50", "mAP50-95", *(f"mAP50 of {name}" for name in CLASSES)):
        for name, values in (
            ("float32", float32[key]),
            ("INT8", int8[key]),
            ("INT8 less", int8[key] - float32[key]),
        ):
            print(name, key, f"{values[0]:.4f}", interval(values, len(pictures)))


if __name__ == "__main__":
    main()
