"""The labelled scenes of a detection study: pictures of a folder, or drawn ones."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from deploy.detection.annotations import LabelledSet, read_labelled
from deploy.detection.boxes import Boxes
from deploy.detection.classes import ClassMap, class_map
from model.detection.scenes import labelled_scene
from model.io.files import sha256
from model.progress import steps
from model.simulator.sampling import read_scene
from profiles.sensor import Sensor

DRAWN_SIDE_PX = 768
"""Of a drawn scene: 256 pixels a side of a sensor that makes one of three, the input of the embedded detector."""


@dataclass(frozen=True)
class Subject:
    """A scene, and the objects in it that the detector knows.

    Attributes:
        name: of the file, or of the drawn scene.
        site: where it lies; scenes of one site are alike.
        truth: labelled boxes in scene pixels, of the detector's classes.
        digest: of what the scene is made from.
        path: of the file; None of a drawn scene.
        radiance: the scene (H, W) in W/m2/sr/um; a picture's white stands for the full scale of the sensor given.
    """

    name: str
    site: str
    truth: Boxes
    digest: str
    path: Path | None
    radiance: Callable[[Sensor], Tensor]


def drawn_subjects(count: int, seed: int, known: ClassMap) -> list[Subject]:
    """The first drawn scenes of a seed: the same however many are drawn. Arguments as of `drawn_subject`."""
    drawn = []
    with steps("drawing scenes", count) as bar:
        for number in range(count):
            drawn.append(drawn_subject(number, seed, known))
            bar.advance()
    return drawn


def drawn_subject(number: int, seed: int, known: ClassMap) -> Subject:
    """The drawn scene of a number, a site of its own; no two numbers or seeds share a generator.

    Args:
        number: of the scene.
        seed: other for other scenes of the same numbers.
        known: the drawn classes as the detector's.
    """
    scene = labelled_scene(np.random.default_rng([seed, number]), DRAWN_SIDE_PX, DRAWN_SIDE_PX)
    truth = Boxes.of(scene.corners, scene.classes).renamed(known.truth)
    radiance, name = torch.from_numpy(scene.radiance), f"drawn {number}"
    return Subject(name, name, truth, f"drawn {seed} {number}", None, lambda _: radiance)


def read_subjects(
    detector: Sequence[str],
    given: Mapping[str, str],
    images: Path,
    labels: Path | None = None,
    split: str | None = None,
) -> tuple[list[Subject], list[str]]:
    """The labelled pictures of a folder as scenes, and sentences on what is left out.

    Args:
        detector: names of the classes that it knows.
        given: of them by labelled ones, where letters do not match.
        images: as `read_labelled` takes it.
        labels: where they lie, if not beside the pictures.
        split: which part of a tree.

    Raises:
        BeersError: pictures or labels that cannot be used, or not one class in common.
    """
    labelled = read_labelled(images, labels, split)
    known = class_map(labelled.names, detector, given)
    return labelled_subjects(labelled, known), [*labelled.notes, *left_out(known)]


def left_out(known: ClassMap) -> list[str]:
    """A sentence on the labelled classes that the detector does not know, where there are such."""
    names = ", ".join(known.unknown)
    return [f"Not known to the detector and left out: {names}. What it finds there counts as false."] if names else []


def labelled_subjects(labelled: LabelledSet, known: ClassMap) -> list[Subject]:
    """The pictures of a folder as scenes, read when they are looked at.

    Args:
        labelled: pictures and their boxes.
        known: the labelled classes as the detector's; boxes of others are left out.
    """
    subjects = []
    for each in labelled.images:
        truth, radiance = each.truth.renamed(known.truth), partial(_read, each.path)
        subjects.append(Subject(each.path.name, each.site, truth, sha256(each.path), each.path, radiance))
    return subjects


def _read(path: Path, sensor: Sensor) -> Tensor:
    return read_scene(path, sensor).radiance
