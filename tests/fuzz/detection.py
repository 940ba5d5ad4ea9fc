"""Labels and detectors for the fuzzer to damage, and the functions that read them."""

import shutil
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image

from beers_deploy.studies.detection.detector import open_detector
from beers_deploy.studies.detection.labels import read_labelled
from tests.deploy.studies.detection.folders import OBJECTS, SIZE_PX
from tests.deploy.studies.detection.networks import detector, final, raw

GREY = np.full((*SIZE_PX, 3), 90, np.uint8)


def label_seeds(folder: Path, make: Callable[[Path], Path], suffix: str) -> list[bytes]:
    """Return the files of labels in a folder that `make` writes."""
    labels = sorted(
        path for path in make(folder / "made").rglob(f"*{suffix}") if path.stem != "data"
    )
    return [path.read_bytes() for path in labels]


def read_labels(path: Path) -> None:
    """Read labels next to their images: one JSON file for all images, or a copy for each image."""
    with TemporaryDirectory() as folder:
        for stem in OBJECTS:
            Image.fromarray(GREY).save(Path(folder) / f"{stem}.png")
            shutil.copy(
                path, Path(folder) / f"{'labels' if path.suffix == '.json' else stem}{path.suffix}"
            )
        read_labelled(Path(folder))


def detector_seeds(folder: Path) -> list[bytes]:
    """Return detectors of both layouts, of fixed and of any size, one with suppression inside."""
    row = (20.0, 30.0, 40.0, 50.0, 0.5, 0.0)
    kinds = [
        detector(folder / "a.onnx", raw(row)),
        detector(folder / "b.onnx", raw(row), size_px="side"),
    ]
    kinds.append(detector(folder / "c.onnx", final(row), cut=0.25))
    return [path.read_bytes() for path in kinds]


def detect(path: Path) -> None:
    open_detector(path).detect(GREY.astype(np.float32) / 255)
