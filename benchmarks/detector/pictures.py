"""What a detector is trained on: pictures with boxes, of synthetic scenes or of any."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from beers_deploy.model.io.pictures import stretch_of
from beers_deploy.model.simulator.acquire import acquire_padded
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.profiles.sensor import Instrument
from beers_deploy.studies.detection.scenes import synthetic_scene

STREAM = 0x64726177
"""Keeps the scenes of training apart from those that a study draws, whatever the seeds."""


@dataclass(frozen=True)
class Picture:
    """An image as the detector reads it, and what is on it.

    Attributes:
        image: (3, H, W) uint8.
        corners: (N, 4) float64, x1, y1, x2, y2 in its pixels, pixel i from i to i + 1.
        classes: (N,) int64.
    """

    image: np.ndarray
    corners: np.ndarray
    classes: np.ndarray


def picture_of(rgb: np.ndarray, corners: np.ndarray, classes: np.ndarray) -> Picture:
    """A picture of an image (3, H, W) float32 in [0, 1]."""
    return Picture(np.rint(255 * rgb).astype(np.uint8), corners, classes)


def drawn_picture(sensor: Instrument, oversampling: int, side_px: int, seed: int, number: int) -> Picture:
    """A synthetic scene of its own number, seen by one sensor: `side_px` target pixels a side.

    Args:
        sensor: whose acquisition is shown, stretched by itself.
        oversampling: scene pixels a target pixel.
        side_px: of the picture.
        seed: of the scene, with its number.
        number: of the scene.
    """
    side = side_px * oversampling
    radiance, truth = synthetic_scene(np.random.default_rng([STREAM, seed, number]), side, side)
    draw = Draw(seed, number)
    dn = acquire_padded(radiance, sensor, oversampling, draw, "reference")
    rgb = stretch_of(dn).to_srgb(dn).transpose(2, 0, 1)
    return picture_of(rgb, truth.corners / oversampling, truth.classes)


def drawn_pictures(sensor: Instrument, oversampling: int, side_px: int, seed: int, count: int) -> Iterator[Picture]:
    """That many drawn pictures, one after the other: a third of a second each."""
    return (drawn_picture(sensor, oversampling, side_px, seed, number) for number in range(count))
