"""Makes the shipped detector anew: drawn pictures, training, the file, the same in INT8, and what both find.

    OMP_NUM_THREADS=1 python docs/make/detector.py

The same bytes on the same machine. The training is most of it: see model/weights/detector.md for how long it took.
"""

from collections.abc import Sequence

import numpy as np
import torch

from deploy.detection.boxes import Boxes
from deploy.detection.detectors import open_detector
from deploy.detection.differences import differences
from deploy.detection.matching import Image, match
from model.detection.export import detector_to_onnx
from model.detection.objects import CLASSES
from model.detection.pictures import Picture, drawn_pictures
from model.detection.training import DetectorRecipe, train_detector
from model.progress import steps
from model.shipped import DETECTOR, DETECTOR_INT8
from profiles.sensor_file import REFERENCE, load_sensor
from quant.calibration import Patches, Remade
from quant.onnx_file import load_onnx, save_onnx
from quant.quantise import quantise_model, ticks

SIDE_PX, OVERSAMPLING = 256, 3
PICTURES, SEEN, HELD_OUT = 400, 64, 60
"""Drawn for training; of these, what INT8 is calibrated on; and of another seed, what both are judged on."""
RECIPE = DetectorRecipe(precision="bfloat16")


def main() -> None:
    """Draw, train, quantise, judge."""
    torch.set_num_threads(1)
    pictures = drawn(0, PICTURES)
    with steps("training", RECIPE.steps) as bar:
        network = train_detector(pictures, len(CLASSES), RECIPE, lambda loss: bar.advance(note=f"loss {loss:.2f}"))
    about = {"description": "vehicles, ships, aircraft and tanks of drawn scenes", "license": "Apache-2.0"}
    save_onnx(detector_to_onnx(network, CLASSES, SIDE_PX, {**about, "recipe": str(RECIPE)}), DETECTOR)
    quantise(pictures[:SEEN])
    judge(drawn(1, HELD_OUT))


def drawn(seed: int, count: int) -> list[Picture]:
    """Pictures of the reference sensor."""
    sensor, made = load_sensor(REFERENCE).nominal(), list[Picture]()
    with steps("drawing", count) as bar:
        for picture in drawn_pictures(sensor, OVERSAMPLING, SIDE_PX, seed, count):
            made.append(picture)
            bar.advance()
    return made


def quantise(pictures: Sequence[Picture]) -> None:
    """The file in INT8 under the DPU's rules, for the host."""
    images = [picture.image[None].astype(np.float32) / 255 for picture in pictures]
    patches = Patches(
        [], Remade(lambda k: (images[k], images[k]), len(images)), Remade(lambda k: images[k], len(images))
    )
    model = load_onnx(DETECTOR)
    with steps("quantising", ticks(model, len(images))) as bar:
        save_onnx(quantise_model(model, patches, {}, bar.advance).host, DETECTOR_INT8)


def judge(pictures: Sequence[Picture]) -> None:
    """Print average precisions with intervals, over pictures that nothing was trained on."""
    rows = {}
    for file in (DETECTOR, DETECTOR_INT8):
        detector, images = open_detector(file, 1), []
        for number, picture in enumerate(pictures):
            found = detector.detect((picture.image.astype(np.float32) / 255).transpose(1, 2, 0))
            images.append(Image(Boxes.of(picture.corners, picture.classes), found, str(number)))
        rows[file.stem] = match(images, CLASSES)
    result = differences(rows, np.random.default_rng(0))
    for figure in ("ap50", "ap", *(f"ap50 of {name}" for name in CLASSES)):
        for name in rows:
            print(name, figure, result.value(name, figure))
        print("INT8 less float", figure, result.difference(DETECTOR_INT8.stem, DETECTOR.stem, figure))


if __name__ == "__main__":
    main()
